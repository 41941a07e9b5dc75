"""Files by the hash of their content in S3, or in what speaks its language; copies in a local folder of bounded size.

An object shows once all of it is there (S3 puts and completes uploads at once), so what exists is whole here too.
Credentials, region and endpoint are those of the usual environment (``AWS_*``).
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

LOOK_AFTER_S = 10.0  # how often the copies are counted, at most
IN_USE_S = 60.0  # a copy that was asked for is about to be opened
FILL = 0.8  # of the room, after some copies were removed
RETRIES = 3  # of a request that failed in passing, with a second or so between them


class RemoteStore(Store):
    """Content-addressed objects below a bucket's prefix; the folder's copies are read."""

    def __init__(self, url: str, folder: Path, max_copies_bytes: int) -> None:
        super().__init__(folder, blobs="copies")
        self._root = url.removeprefix("s3://").rstrip("/")
        self._max_copies_bytes = max_copies_bytes
        self._counted_at = 0.0
        # What others put there must show at once.
        self._s3: Any = s3fs.S3FileSystem(
            use_listings_cache=False,
            skip_instance_cache=True,
            config_kwargs={"connect_timeout": 5, "read_timeout": 60, "retries": {"max_attempts": RETRIES}},
        )

    def path(self, digest: str) -> Path:
        """A copy of the file of this SHA-256, fetched where there is none. Raises ``StoreAway``, FileNotFoundError."""
        copy = super().path(digest)
        try:
            os.utime(copy)
        except FileNotFoundError:
            self._fetch(digest, copy)
        return copy

    def check(self) -> None:
        """Raise OSError where files cannot be kept now."""
        super().check()
        with _answering():
            self._s3.pipe_file(f"{self._root}/probe", b"heliopsf")

    def keep(self, temporary: Path, digest: str | None = None) -> str:
        """Send a finished file; it stays here as a copy. Returns its SHA-256. Raises ``StoreAway``."""
        digest = digest or sha256_of(temporary)
        with _answering():
            self._s3.put_file(str(temporary), self._key(digest))
        self._keep_copy(temporary, super().path(digest))
        return digest

    def blobs(self) -> Iterator[Blob]:
        """All files that are kept, by their first digit at a time. Raises ``StoreAway``."""
        for digit in "0123456789abcdef":
            with _answering():
                found = self._s3.find(f"{self._root}/blobs", prefix=digit, detail=True)
            for name, about in sorted(found.items()):
                yield Blob(name.rsplit("/", 1)[1], int(about["size"]), about["LastModified"].timestamp())

    def remove(self, digest: str, kept_before: float) -> bool:
        """Remove a file, unless it is gone or was kept again since; whether it was removed. Raises ``StoreAway``.

        S3 cannot look and remove at once: a copy stays aside until ``settle``, for a file that is kept in between.
        """
        with _answering():
            if not self._is_old(digest, kept_before):
                return False
            try:
                self._s3.cp_file(self._key(digest), self._key_aside(digest))
            except FileNotFoundError:
                return False
            if not self._is_old(digest, kept_before):  # copying takes long where the file is large
                return False
            self._s3.rm_file(self._key(digest))
        super().path(digest).unlink(missing_ok=True)
        return True

    def settle(self, named: Iterable[str], after_s: float = 0.0) -> set[str]:
        """As in a folder; also what a process left aside that ended before it could settle. Raises ``StoreAway``."""
        with _answering():
            aside = {name.rsplit("/", 1)[1] for name in self._s3.find(f"{self._root}/aside")}
        if not aside:
            return set()
        time.sleep(after_s)
        wanted = aside.intersection(named)  # read after the listing: what was put aside since is left alone
        put_back = set()
        with _answering():
            for digest in wanted:
                if not self._s3.exists(self._key(digest)):
                    self._s3.cp_file(self._key_aside(digest), self._key(digest))
                    put_back.add(digest)
            # Not before all are back: whatever ends this early leaves the copies to the next.
            for digest in aside:
                self._s3.rm_file(self._key_aside(digest))
        return put_back

    def _is_old(self, digest: str, kept_before: float) -> bool:
        """Whether a file is there and was kept last before this time."""
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
                raise StoreAway(f"expected the file {digest}; what came has another hash")
            self._keep_copy(partial, copy)

    def _keep_copy(self, temporary: Path, copy: Path) -> None:
        copy.parent.mkdir(exist_ok=True)
        os.utime(temporary)
        sync(temporary)  # a copy is not looked into again
        os.replace(temporary, copy)
        if time.monotonic() - self._counted_at > LOOK_AFTER_S:
            self._make_room()
            self._counted_at = time.monotonic()

    def _make_room(self) -> None:
        """Remove the copies that were not asked for longest, where there are too many; other processes may be at it."""
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
    """What S3 and the way there raise, as ``StoreAway``; that an object is not there stays what it is."""
    try:
        yield
    except FileNotFoundError:
        raise
    except (BotoCoreError, aiohttp.ClientError, OSError) as error:
        raise StoreAway(f"the object store does not answer ({type(error).__name__})") from error
