"""Opens the store that the settings name: a local folder, or S3."""

from __future__ import annotations

from workers.files.store import Store
from workers.settings import Settings


def open_store(settings: Settings) -> Store:
    """The store that the settings name."""
    if settings.store_url is None:
        return Store(settings.data_dir)
    # What it needs is installed where it is used.
    from workers.files.s3_store import RemoteStore

    return RemoteStore(settings.store_url, settings.data_dir, settings.store_cache_mib * 2**20)
