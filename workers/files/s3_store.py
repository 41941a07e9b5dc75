"""Files by the hash of their content in S3 or a compatible store, with copies in a local folder of bounded size.

S3 shows an object only when its upload is complete, so an existing object is complete. Credentials, region and endpoint
come from the usual environment variables (``AWS_*``).
"""

from __future__ import annotations

import math
import os
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

import aiohttp
import s3fs
from botocore.exceptions import BotoCoreError

from psfcore.files import sha256_of
from workers.files.store import DAMAGED, BadFile, Blob, Store, StoreAway, is_disk_full, sync

LOOK_AFTER_S = 10.0  # shortest time between two measurements of the size of the copies
IN_USE_S = 60.0  # a copy that was requested in the last minute is not removed: it may be opened soon
FILL = 0.8  # copies are removed until all copies together are smaller than this fraction of the allowed size
RETRIES = 3  # number of times that a request is repeated after a transient failure, about once a second


class RemoteStore(Store):
    """Objects below a prefix of a bucket, named by the hash of their content. Readers get copies in the local folder."""

    def __init__(self, url: str, folder: Path, max_copies_bytes: int) -> None:
        super().__init__(folder, blobs="copies")
        self._root = url.removeprefix("s3://").rstrip("/")
        self._max_copies_bytes = max_copies_bytes
        self._counted_at = 0.0
        # Listings are not cached, because objects of other processes must be visible at once.
        self._s3: Any = s3fs.S3FileSystem(
            use_listings_cache=False,
            skip_instance_cache=True,
            config_kwargs={"connect_timeout": 5, "read_timeout": 60, "retries": {"max_attempts": RETRIES}},
        )

    def path(self, digest: str) -> Path:
        """A local copy of the file with this SHA-256, downloaded if missing. Raises ``StoreAway``, FileNotFoundError."""
        copy = self._place(digest)
        try:
            os.utime(copy)
        except FileNotFoundError:
            self._fetch(digest, copy)
        return copy

    def size(self, digest: str) -> int | None:
        """The size of the file with this SHA-256, bytes; None if the store has no such file. Raises ``StoreAway``."""
        there = self._about(digest)
        if there is None and self.bring_back(digest):
            there = self._about(digest)
        return None if there is None else int(there["size"])

    def _content_sha256(self, digest: str) -> str:
        """SHA-256 of the object itself.

        The copy in the local folder is not used, because this copy may be good although the object is damaged.
        """
        with self.temporary() as copy:
            self._download(digest, copy)
            return sha256_of(copy)

    def verified(self, digest: str) -> Path:
        """As ``Store.verified``. A damaged local copy is downloaded again. Also raises ``StoreAway``."""
        try:
            return super().verified(digest)
        except BadFile as error:
            if error.code == "file-lost":
                raise
        self._place(digest).unlink(missing_ok=True)
        return super().verified(digest)

    def set_aside(self, digest: str) -> bool:
        """As ``Store.set_aside``, below the prefix ``damaged`` of the bucket. Raises ``StoreAway``."""
        with self.temporary() as copy, _answering():
            try:
                self._s3.get_file(self._key(digest), str(copy))
            except FileNotFoundError:
                return False
            if sha256_of(copy) == digest:
                return False
            self._s3.cp_file(self._key(digest), f"{self._root}/damaged/{digest}")
            self._s3.rm_file(self._key(digest))
        self._place(digest).unlink(missing_ok=True)
        return True

    def check(self) -> None:
        """Raise OSError if files cannot be stored now."""
        super().check()
        with _answering():
            self._s3.pipe_file(f"{self._root}/probe", b"heliopsf")

    def keep(self, temporary: Path, digest: str | None = None) -> str:
        """Upload a complete file and keep it as a local copy; returns its SHA-256. Raises ``StoreAway``."""
        digest = digest or sha256_of(temporary)
        with _answering():
            self._s3.put_file(str(temporary), self._key(digest))
        self._keep_copy(temporary, self._place(digest))
        return digest

    def kept_at(self, digest: str) -> float | None:
        """The time when a file was last stored; None if it is not in the store. Raises ``StoreAway``."""
        there = self._about(digest)
        return None if there is None else float(there["LastModified"].timestamp())

    def blobs(self) -> Iterator[Blob]:
        """All files of the store, in the order of the first digit of their hashes. Raises ``StoreAway``."""
        for digit in "0123456789abcdef":
            with _answering():
                found = self._s3.find(f"{self._root}/blobs", prefix=digit, detail=True)
            for name, about in sorted(found.items()):
                yield Blob(name.rsplit("/", 1)[1], int(about["size"]), about["LastModified"].timestamp())

    def remove(self, digest: str, kept_before: float) -> bool:
        """As ``Store.remove``. Raises ``StoreAway``.

        S3 cannot check and move a file in one step: a file that is stored in between is lost, but not its copy aside.
        """
        with _answering():
            if not self._is_old(digest, kept_before):
                return False
            try:
                self._s3.cp_file(self._key(digest), self._key_aside(digest))
            except FileNotFoundError:
                return False
            # Check again, because it takes long to copy a large file.
            if not self._is_old(digest, kept_before):
                return False
            self._s3.rm_file(self._key(digest))
        self._place(digest).unlink(missing_ok=True)
        return True

    def aside(self, before: float = math.inf) -> set[str]:
        """As ``Store.aside``. Raises ``StoreAway``."""
        with _answering():
            found = self._s3.find(f"{self._root}/aside", detail=True)
        moved = {name: about["LastModified"].timestamp() for name, about in found.items()}
        return {name.rsplit("/", 1)[1] for name, moved_at in moved.items() if moved_at < before}

    def bring_back(self, digest: str) -> bool:
        """As ``Store.bring_back``; the copy aside stays until ``delete_aside``. Raises ``StoreAway``."""
        with _answering():
            if self._s3.exists(self._key(digest)):
                return False
            try:
                self._s3.cp_file(self._key_aside(digest), self._key(digest))
            except FileNotFoundError:
                return False
        return True

    def delete_aside(self, digest: str) -> None:
        """As ``Store.delete_aside``. Raises ``StoreAway``."""
        with _answering(), suppress(FileNotFoundError):
            self._s3.rm_file(self._key_aside(digest))

    def _about(self, digest: str) -> dict[str, Any] | None:
        """The size and the time of the object; None if there is no such object."""
        with _answering():
            try:
                return dict(self._s3.info(self._key(digest), refresh=True))
            except FileNotFoundError:
                return None

    def _is_old(self, digest: str, kept_before: float) -> bool:
        """Whether the file exists and was last stored before this time."""
        kept_at = self.kept_at(digest)
        return kept_at is not None and kept_at < kept_before

    def _key(self, digest: str) -> str:
        return f"{self._root}/blobs/{digest[:2]}/{digest}"

    def _key_aside(self, digest: str) -> str:
        return f"{self._root}/aside/{digest}"

    def _fetch(self, digest: str, copy: Path) -> None:
        with self.temporary() as partial:
            try:
                self._download(digest, partial)
            except FileNotFoundError:
                if not self.bring_back(digest):
                    raise
                self._download(digest, partial)
            if sha256_of(partial) != digest:
                raise BadFile("file-damaged", f"expected the file {digest} as it was stored; {DAMAGED}")
            self._keep_copy(partial, copy)

    def _download(self, digest: str, to: Path) -> None:
        with _answering():
            self._s3.get_file(self._key(digest), str(to))

    def _keep_copy(self, temporary: Path, copy: Path) -> None:
        copy.parent.mkdir(exist_ok=True)
        os.utime(temporary)
        sync(temporary)  # force the copy to the disk, because its content is not checked again
        os.replace(temporary, copy)
        if time.monotonic() - self._counted_at > LOOK_AFTER_S:
            self._make_room()
            self._counted_at = time.monotonic()

    def _make_room(self) -> None:
        """Remove the least recently used copies if all copies together are too large.

        Other processes may do the same at the same moment.
        """
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
    """Turn errors of S3 and of the network into ``StoreAway``. FileNotFoundError for a missing object is not changed."""
    try:
        yield
    except FileNotFoundError:
        raise
    except (BotoCoreError, aiohttp.ClientError, OSError) as error:
        if is_disk_full(error):  # the disk of the local copies is full
            raise
        raise StoreAway(
            f"the object store does not answer ({type(error).__name__}): try again later"
        ) from error
