"""The data folder is closed to other users, output folders follow the operator's umask, and links lead out of no
allowed folder."""

from __future__ import annotations

import logging
import os
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from psfcore.errors import DataError
from workers.files import archive, modes


def mode(path: Path) -> int:
    return path.stat().st_mode & 0o777


@pytest.fixture
def private(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """A process whose operator has the umask 027, and that keeps its files private."""
    monkeypatch.setattr(modes, "_operators_umask", None)
    before = os.umask(0o027)
    modes.keep_private()
    modes.keep_private()  # the second call forgets nothing
    yield
    os.umask(before)


@pytest.mark.usefixtures("private")
def test_new_files_are_private_and_outputs_are_not(tmp_path: Path) -> None:
    (tmp_path / "kept").write_text("x")
    assert mode(tmp_path / "kept") == 0o600
    (tmp_path / "there").mkdir()
    (tmp_path / "there").chmod(0o770)
    modes.open_folder(tmp_path / "there")
    assert mode(tmp_path / "there") == 0o770, "a folder that exists keeps its mode"
    modes.open_folder(tmp_path / "a" / "b")
    assert mode(tmp_path / "a") == mode(tmp_path / "a" / "b") == 0o750
    with (tmp_path / "a" / "output").open("wb") as file:
        modes.open_file(file)
    assert mode(tmp_path / "a" / "output") == 0o640


def test_other_processes_change_no_mode(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(modes, "_operators_umask", None)
    before = os.umask(0o022)
    try:
        modes.open_folder(tmp_path / "a")
        with (tmp_path / "a" / "output").open("wb") as file:
            modes.open_file(file)
    finally:
        os.umask(before)
    assert (mode(tmp_path / "a"), mode(tmp_path / "a" / "output")) == (0o755, 0o644)


def test_the_data_folder_is_closed_if_it_was_open(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level(logging.INFO)
    modes.private_folder(tmp_path / "new" / "data")
    assert mode(tmp_path / "new" / "data") == 0o700 and not caplog.records
    (tmp_path / "old").mkdir()
    (tmp_path / "old").chmod(0o755)
    for _ in range(2):
        modes.private_folder(tmp_path / "old")
    assert mode(tmp_path / "old") == 0o700
    assert len(caplog.records) == 1 and "closed the data folder" in caplog.text


def test_the_data_folder_of_another_user_is_told(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    tmp_path.chmod(0o755)
    monkeypatch.setattr(os, "geteuid", lambda: tmp_path.stat().st_uid + 1)
    modes.private_folder(tmp_path)
    assert mode(tmp_path) == 0o755 and "chmod 700" in caplog.text


@pytest.fixture
def root(tmp_path: Path) -> Path:
    """An allowed folder with the file ``sub/image``, and beside it a folder with the file ``secret/image``."""
    for folder, text in (("root/sub", "open"), ("secret", "secret")):
        (tmp_path / folder).mkdir(parents=True)
        (tmp_path / folder / "image").write_text(text)
    return (tmp_path / "root").resolve()


@pytest.fixture
def swapped(root: Path, monkeypatch: pytest.MonkeyPatch) -> Callable[[Path], None]:
    """A function that lets a path be replaced by a link out of the allowed folder directly after each check."""

    checked = archive.check_under

    def swap(part: Path) -> None:
        def check(path: Path, *arguments: object) -> Path:
            found = checked(path, *arguments)  # type: ignore[arg-type]
            if not part.is_symlink():
                target = root.parent / "secret" / ("image" if part.name == "image" else "")
                part.rename(root.parent / "moved")
                part.symlink_to(target)
            return found

        monkeypatch.setattr(archive, "check_under", check)

    return swap


def test_a_file_is_read_and_links_inside_are_followed(root: Path) -> None:
    (root / "link").symlink_to(root / "sub")
    for path in (root / "sub" / "image", root / "link" / "image"):
        with archive.opened(path, [root]) as file:
            assert archive.reopened(file).read_text() == "open" and file.read() == b"open"


@pytest.mark.parametrize("part", ["sub", "sub/image"])
def test_a_link_made_after_the_check(root: Path, swapped: Callable[[Path], None], part: str) -> None:
    swapped(root / part)
    with pytest.raises((OSError, DataError)), archive.opened(root / "sub" / "image", [root]):
        pass


def test_nothing_is_written_through_a_link(root: Path, swapped: Callable[[Path], None]) -> None:
    source, secret = root.parent / "source", root.parent / "secret"
    source.write_text("product")
    (root / "product").symlink_to(secret / "image")
    archive.put(source, root / "product", [root])
    assert (root / "product").read_text() == "product" and not (root / "product").is_symlink()
    source.write_text("another")
    swapped(root / "sub")
    with pytest.raises((OSError, DataError)):
        archive.put(source, root / "sub" / "product", [root])
    assert [(path.name, path.read_text()) for path in secret.iterdir()] == [("image", "secret")]


def test_a_product_is_written_into_new_folders_and_leaves_no_partial_file(root: Path) -> None:
    (root.parent / "source").write_text("product")
    archive.make_folder(root / "a" / "b", [root])
    archive.put(root.parent / "source", root / "a" / "b" / "c" / "product", [root])
    assert [path.name for path in (root / "a" / "b" / "c").iterdir()] == ["product"]
    partial = root / "a" / "b" / "c" / ".product.0123.part"
    for path in (partial, partial.with_name(".other.0123.part")):
        path.touch()
    archive.remove_partials(root / "a" / "b" / "c" / "product", [root])
    assert sorted(path.name for path in partial.parent.iterdir()) == [".other.0123.part", "product"]


def test_what_is_no_regular_file_is_refused_at_once(root: Path) -> None:
    os.mkfifo(root / "pipe")
    for path in (root / "pipe", root / "sub"):
        with pytest.raises(DataError, match="regular file"), archive.opened(path, [root]):
            pass


def test_a_path_outside_is_refused(root: Path) -> None:
    with pytest.raises(DataError) as refused, archive.opened(root.parent / "secret" / "image", [root]):
        pass
    assert refused.value.code == "path-not-allowed"
