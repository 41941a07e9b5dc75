"""Files by the hash of their content in S3 or a compatible store, with copies in a local folder of bounded size.

S3 shows an object only when its upload is complete, so an existing object is complete. Credentials, region and endpoint
come from the usual environment variables (``AWS_*``).

A 404 does not prove that an object is absent: a bucket that is not found during a failover, or another server at the
endpoint, answers the same. An object is absent if a listing of the bucket does not contain it. Everything else is
``StoreAway``: it could not be found out now.
"""

from __future__ import annotations

import math
import os
import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import aiohttp
import s3fs
from botocore.exceptions import BotoCoreError, ClientError, ConnectTimeoutError, ReadTimeoutError
from botocore.exceptions import ConnectionError as NotConnected
from botocore.parsers import ResponseParserError
from s3fs.core import set_custom_error_handler

from psfcore.files import sha256_of
from workers.files.store import DAMAGED, BadFile, Blob, Store, StoreAway, is_disk_full, sync

LOOK_AFTER_S = 10.0  # shortest time between two measurements of the size of the copies
IN_USE_S = 60.0  # a copy that was requested in the last minute is not removed: it may be opened soon
FILL = 0.8  # copies are removed until all copies together are smaller than this fraction of the allowed size
CONNECT_S = 5.0  # longest time until the store accepts a connection
PROBE_S = 4.0  # longest time of ``check``, shorter than ``workers.checks.CHECK_S``
SILENT = (ReadTimeoutError, ConnectTimeoutError, TimeoutError)


@dataclass(frozen=True)
class Patience:
    """How long a call waits for the store.

    Attributes
    ----------
    silence_s
        Longest time until the next byte of an answer, s.
    tries
        How many times a request is sent if it fails.
    pause_s
        The time for which all calls fail at once after a call that got no answer, s.
    """

    silence_s: float
    tries: int
    pause_s: float


# The calls of a worker must end long before ``garbage.SETTLED_AFTER_S``: until then, a file that was moved aside can
# come back.
WORKER = Patience(silence_s=30.0, tries=3, pause_s=0.0)
REQUEST = Patience(silence_s=10.0, tries=2, pause_s=5.0)


def _is_worth_repeating(error: Exception) -> bool:
    """Whether to repeat a request, beside the errors for which s3fs does so itself: silence and answers that were
    cut.
    """
    if isinstance(error, ClientError):
        return bool(error.response.get("ResponseMetadata", {}).get("HTTPStatusCode", 0) >= 500)
    return isinstance(error, NotConnected)


set_custom_error_handler(_is_worth_repeating)


class RemoteStore(Store):
    """Objects below a prefix of a bucket, named by the hash of their content. Readers get copies in the local
    folder.
    """

    def __init__(
        self, url: str, folder: Path, max_copies_bytes: int, *, within_requests: bool = False
    ) -> None:
        super().__init__(folder, blobs="copies")
        self._root = url.removeprefix("s3://").rstrip("/")
        self._max_copies_bytes = max_copies_bytes
        self._counted_at = 0.0
        self._patience = REQUEST if within_requests else WORKER
        self._silent_until = -math.inf
        # Listings are not cached, because objects of other processes must be visible at once. s3fs repeats requests,
        # and downloads from where they were cut; if botocore repeated them too, the numbers of tries would multiply.
        self._s3: Any = s3fs.S3FileSystem(
            use_listings_cache=False,
            skip_instance_cache=True,
            config_kwargs={
                "connect_timeout": CONNECT_S,
                "read_timeout": self._patience.silence_s,
                "retries": {"max_attempts": 0},
            },
        )
        self._s3.retries = self._patience.tries

    def path(self, digest: str) -> Path:
        """A local copy of the file with this SHA-256, downloaded if missing. Raises ``StoreAway``,
        FileNotFoundError.
        """
        copy = self._place(digest)
        try:
            os.utime(copy)
        except FileNotFoundError:
            self._fetch(digest, copy)
        return copy

    def size(self, digest: str) -> int | None:
        """The size of the file with this SHA-256, bytes; None if the store has no such file. Raises ``StoreAway``."""
        there = self._about(digest)
        if there is None:
            self.bring_back(digest)
            # Look again in any case: another process may have brought it back.
            there = self._about(digest)
        return None if there is None else there.bytes

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
        with self.temporary() as copy:
            try:
                self._download(digest, copy)
            except FileNotFoundError:
                return False
            if sha256_of(copy) == digest:
                return False
            with self._answering():
                self._s3.cp_file(self._key(digest), f"{self._root}/damaged/{digest}")
                self._s3.rm_file(self._key(digest))
        self._place(digest).unlink(missing_ok=True)
        return True

    def check(self) -> None:
        """As ``Store.check``, within ``PROBE_S`` seconds."""
        super().check()
        with self._answering():
            self._s3.pipe_file(f"{self._root}/probe", b"heliopsf", timeout=PROBE_S)

    def keep(self, temporary: Path, digest: str | None = None) -> str:
        """Upload a complete file and keep it as a local copy; returns its SHA-256. Raises ``StoreAway``."""
        digest = digest or sha256_of(temporary)
        with self._answering():
            self._s3.put_file(str(temporary), self._key(digest))
        self._keep_copy(temporary, self._place(digest))
        return digest

    def kept_at(self, digest: str) -> float | None:
        """The time when a file was last stored; None if it is not in the store. Raises ``StoreAway``."""
        there = self._about(digest)
        return None if there is None else there.kept_at

    def blobs(self) -> Iterator[Blob]:
        """All files of the store, in the order of the first digit of their hashes. Raises ``StoreAway``."""
        for digit in "0123456789abcdef":
            with self._answering():
                found = self._s3.find(f"{self._root}/blobs", prefix=digit, detail=True)
            yield from (_blob_of(found[name]) for name in sorted(found))

    def remove(self, digest: str, kept_before: float) -> bool:
        """As ``Store.remove``. Raises ``StoreAway``.

        S3 cannot check and move a file in one step: a file that is stored in between is lost, but not its copy aside.
        """
        copied = self._is_old(digest, kept_before) and self._copy(self._key(digest), self._key_aside(digest))
        # Check again, because it takes long to copy a large file.
        if not copied or not self._is_old(digest, kept_before):
            return False
        with self._answering():
            self._s3.rm_file(self._key(digest))
        self._place(digest).unlink(missing_ok=True)
        return True

    def aside(self, before: float = math.inf) -> set[str]:
        """As ``Store.aside``. Raises ``StoreAway``."""
        with self._answering():
            # With a prefix, s3fs does not take the folder for an object if a file is moved there just after an empty
            # listing.
            found = self._s3.find(self._root, prefix="aside/", detail=True)
        return {blob.digest for blob in map(_blob_of, found.values()) if blob.kept_at < before}

    def bring_back(self, digest: str) -> bool:
        """As ``Store.bring_back``; the copy aside stays until ``delete_aside``. Raises ``StoreAway``."""
        return self._about(digest) is None and self._copy(self._key_aside(digest), self._key(digest))

    def delete_aside(self, digest: str) -> None:
        """As ``Store.delete_aside``. Raises ``StoreAway``."""
        with self._answering():
            self._s3.rm_file(self._key_aside(digest))

    def _about(self, digest: str) -> Blob | None:
        """Size and time of a file; None if it is absent. Raises ``StoreAway``."""
        bucket, _, name = self._key(digest).partition("/")
        with self._answering(), suppress(FileNotFoundError):
            head = self._s3.call_s3("head_object", Bucket=bucket, Key=name)
            return Blob(digest, int(head["ContentLength"]), head["LastModified"].timestamp())
        return self._listed(self._key(digest))

    def _copy(self, source: str, target: str) -> bool:
        """Copy an object within the bucket; returns False if the source is absent."""
        try:
            with self._answering(source):
                self._s3.cp_file(source, target)
        except FileNotFoundError:
            return False
        return True

    def _listed(self, key: str) -> Blob | None:
        """Size and time of an object as a listing of the bucket shows them; None if it is absent. Raises
        ``StoreAway``.
        """
        bucket, _, name = key.partition("/")
        with self._answering():
            listed = self._s3.call_s3("list_objects_v2", Bucket=bucket, Prefix=name, MaxKeys=1)
        return next((_blob_of(one) for one in listed.get("Contents", ()) if one["Key"] == name), None)

    @contextmanager
    def _answering(self, key: str | None = None) -> Iterator[None]:
        """Turn errors of S3 and of the network into ``StoreAway``.

        Parameters
        ----------
        key
            The object that the block reads. FileNotFoundError leaves the block only if this object is absent.
        """
        if time.monotonic() < self._silent_until:
            raise StoreAway("the object store gave no answer a moment ago: try again later")
        try:
            yield
        except (BotoCoreError, ResponseParserError, aiohttp.ClientError, OSError) as error:
            if is_disk_full(error):  # the disk of the local copies is full
                raise
            if key is not None and isinstance(error, FileNotFoundError) and self._listed(key) is None:
                raise
            if isinstance(error, SILENT):
                self._silent_until = time.monotonic() + self._patience.pause_s
            raise StoreAway(
                f"the object store does not answer ({type(error).__name__}): try again later"
            ) from error

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
                self.bring_back(digest)
                self._download(digest, partial)  # in any case, as in ``size``
            if sha256_of(partial) != digest:
                self._download(digest, partial)  # the answer may have been wrong, and not the object
                if sha256_of(partial) != digest:
                    raise BadFile("file-damaged", f"expected the file {digest} as it was stored; {DAMAGED}")
            self._keep_copy(partial, copy)

    def _download(self, digest: str, to: Path) -> None:
        with self._answering(self._key(digest)):
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


def _blob_of(entry: Mapping[str, Any]) -> Blob:
    """The file of an entry of a listing of the bucket."""
    return Blob(entry["Key"].rsplit("/", 1)[1], int(entry["Size"]), entry["LastModified"].timestamp())
