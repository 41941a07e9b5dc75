"""Files by the hash of their content in S3 or a compatible store, with copies in a local folder of bounded size.

S3 shows an object only when its upload is complete, so an existing object is whole. Credentials, region and endpoint
come from the usual environment variables (``AWS_*``).
"""

from __future__ import annotations

import os
import time
from collections.abc import Iterable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

import aiohttp
import s3fs
from botocore.exceptions import BotoCoreError

from workers.files.store import Blob, Store, StoreAway, sha256_of, sync

LOOK_AFTER_S = 10.0  # at most this often the size of the copies is measured
IN_USE_S = 60.0  # a copy that was requested this recently may be about to be opened
FILL = 0.8  # of the allowed size, after copies were removed
RETRIES = 3  # of a request after a transient failure, with about a second in between


class RemoteStore(Store):
    """Content-addressed objects below a prefix of a bucket. Readers get copies in the local folder."""

    def __init__(self, url: str, folder: Path, max_copies_bytes: int) -> None:
        super().__init__(folder, blobs="copies")
        self._root = url.removeprefix("s3://").rstrip("/")
        self._max_copies_bytes = max_copies_bytes
        self._counted_at = 0.0
        # No cache of listings: objects that others store must be seen at once.
        self._s3: Any = s3fs.S3FileSystem(
            use_listings_cache=False,
            skip_instance_cache=True,
            config_kwargs={"connect_timeout": 5, "read_timeout": 60, "retries": {"max_attempts": RETRIES}},
        )

    def path(self, digest: str) -> Path:
        """A local copy of the file with this SHA-256, downloaded if missing. Raises ``StoreAway``, FileNotFoundError."""
        copy = super().path(digest)
        try:
            os.utime(copy)
        except FileNotFoundError:
            self._fetch(digest, copy)
        return copy

    def check(self) -> None:
        """Raise OSError if files cannot be stored now."""
        super().check()
        with _answering():
            self._s3.pipe_file(f"{self._root}/probe", b"heliopsf")

    def keep(self, temporary: Path, digest: str | None = None) -> str:
        """Upload a finished file and keep it as a local copy; returns its SHA-256. Raises ``StoreAway``."""
        digest = digest or sha256_of(temporary)
        with _answering():
            self._s3.put_file(str(temporary), self._key(digest))
        self._keep_copy(temporary, super().path(digest))
        return digest

    def blobs(self) -> Iterator[Blob]:
        """All files of the store, listed by their first digit. Raises ``StoreAway``."""
        for digit in "0123456789abcdef":
            with _answering():
                found = self._s3.find(f"{self._root}/blobs", prefix=digit, detail=True)
            for name, about in sorted(found.items()):
                yield Blob(name.rsplit("/", 1)[1], int(about["size"]), about["LastModified"].timestamp())

    def remove(self, digest: str, kept_before: float) -> bool:
        """Remove a file unless it is gone or was stored again; whether it was removed. Raises ``StoreAway``.

        S3 cannot check and remove in one step: a copy stays aside until ``settle``, in case the file is stored again in
        between.
        """
        with _answering():
            if not self._is_old(digest, kept_before):
                return False
            try:
                self._s3.cp_file(self._key(digest), self._key_aside(digest))
            except FileNotFoundError:
                return False
            if not self._is_old(digest, kept_before):  # copying a large file takes long
                return False
            self._s3.rm_file(self._key(digest))
        super().path(digest).unlink(missing_ok=True)
        return True

    def settle(self, named: Iterable[str], after_s: float = 0.0) -> set[str]:
        """As ``Store.settle``, also for copies that a killed process left aside. Raises ``StoreAway``."""
        with _answering():
            aside = {name.rsplit("/", 1)[1] for name in self._s3.find(f"{self._root}/aside")}
        if not aside:
            return set()
        time.sleep(after_s)
        wanted = aside.intersection(named)  # read after the listing: later copies stay aside
        put_back = set()
        with _answering():
            for digest in wanted:
                if not self._s3.exists(self._key(digest)):
                    self._s3.cp_file(self._key_aside(digest), self._key(digest))
                    put_back.add(digest)
            # Only after all are restored: if this is interrupted, the next call finds the copies.
            for digest in aside:
                self._s3.rm_file(self._key_aside(digest))
        return put_back

    def _is_old(self, digest: str, kept_before: float) -> bool:
        """Whether the file exists and was last stored before this time."""
        try:
            about = self._s3.info(self._key(digest), refresh=True)
        except FileNotFoundError:
            return False
        kept_at: float = about["LastModified"].timestamp()
        return kept_at < kept_before

    def _key(self, digest: str) -> str:
        return f"{self._root}/blobs/{digest[:2]}/{digest}"

    def _key_aside(self, digest: str) -> str:
        return f"{self._root}/aside/{digest}"

    def _fetch(self, digest: str, copy: Path) -> None:
        with self.temporary() as partial:
            with _answering():
                self._s3.get_file(self._key(digest), str(partial))
            if sha256_of(partial) != digest:
                raise StoreAway(
                    f"expected the file {digest} from the object store; the downloaded file has another hash: try again"
                )
            self._keep_copy(partial, copy)

    def _keep_copy(self, temporary: Path, copy: Path) -> None:
        copy.parent.mkdir(exist_ok=True)
        os.utime(temporary)
        sync(temporary)  # the content of a copy is not checked again
        os.replace(temporary, copy)
        if time.monotonic() - self._counted_at > LOOK_AFTER_S:
            self._make_room()
            self._counted_at = time.monotonic()

    def _make_room(self) -> None:
        """Remove the least recently used copies if they are too large; other processes may do the same now."""
        found: list[tuple[float, int, Path]] = []
        for path in self._blobs.glob("??/*"):
            with suppress(FileNotFoundError):
                about = path.stat()
                found.append((about.st_mtime, about.st_size, path))
        total = sum(size for _, size, _ in found)
        if total <= self._max_copies_bytes:
            return
        for used_at, size, path in sorted(found):
            if total <= FILL * self._max_copies_bytes or used_at > time.time() - IN_USE_S:
                return
            path.unlink(missing_ok=True)
            total -= size


@contextmanager
def _answering() -> Iterator[None]:
    """Turn errors of S3 and of the network into ``StoreAway``, but not FileNotFoundError for a missing object."""
    try:
        yield
    except FileNotFoundError:
        raise
    except (BotoCoreError, aiohttp.ClientError, OSError) as error:
        raise StoreAway(
            f"the object store does not answer ({type(error).__name__}): try again later"
        ) from error
