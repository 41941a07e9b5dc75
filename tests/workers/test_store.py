"""Files by their hash."""

from __future__ import annotations

import hashlib
from pathlib import Path

from workers.store import Store


def test_a_kept_file_is_whole_under_its_hash_and_nothing_else_is_left(tmp_path: Path) -> None:
    store = Store(tmp_path)
    content = b"light" * 1000
    with store.temporary() as path:
        path.write_bytes(content)
        digest = store.keep(path)
    assert digest == hashlib.sha256(content).hexdigest()
    assert store.path(digest).read_bytes() == content
    assert [p for p in tmp_path.rglob("*") if p.is_file()] == [store.path(digest)]


def test_an_abandoned_file_is_removed(tmp_path: Path) -> None:
    store = Store(tmp_path)
    try:
        with store.temporary() as path:
            path.write_bytes(b"half")
            raise InterruptedError
    except InterruptedError:
        pass
    assert [p for p in tmp_path.rglob("*") if p.is_file()] == []
