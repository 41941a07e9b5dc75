"""Open the store that the settings name: a local folder, or S3."""

from __future__ import annotations

from workers.files.store import Store
from workers.settings import Settings


def open_store(settings: Settings) -> Store:
    """The store that the settings name."""
    if settings.store_url is None:
        return Store(settings.data_dir)
    # This import is inside the function, because its packages are installed only where S3 is used.
    from workers.files.s3_store import RemoteStore

    return RemoteStore(settings.store_url, settings.data_dir, settings.store_cache_mib * 2**20)
