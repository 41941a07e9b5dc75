"""Output files are checked before the work, and written whole or not at all."""

from __future__ import annotations

import gzip
import os
from pathlib import Path

import pytest

from service.client.errors import ServiceError
from service.client.outputs import check_output_folder, check_outputs, written


def code(*outputs: Path | None, inputs: tuple[Path, ...] = (), overwrite: bool = False) -> str | None:
    """The code with which the outputs are refused; None if they are accepted."""
    try:
        check_outputs(outputs, inputs=inputs, overwrite=overwrite)
    except ServiceError as error:
        return error.code
    return None


def test_an_output_is_no_input_however_it_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    image = tmp_path / "image.fits"
    image.write_bytes(b"x")
    (tmp_path / "soft.fits").symlink_to(image)
    os.link(image, tmp_path / "hard.fits")
    (tmp_path / "folder").symlink_to(tmp_path, target_is_directory=True)
    monkeypatch.chdir(tmp_path)
    for name in (image, "soft.fits", "hard.fits", "folder/image.fits", "./image.fits"):
        assert code(Path(name), inputs=(image,), overwrite=True) == "output-is-input", name
        assert code(image, inputs=(Path(name),), overwrite=True) == "output-is-input", name
    assert code(tmp_path / "soft.fits", inputs=(tmp_path,), overwrite=True) == "output-is-input"
    assert code(tmp_path / "other.fits", inputs=(image, tmp_path)) is None


def test_two_outputs_are_two_files(tmp_path: Path) -> None:
    (tmp_path / "link").symlink_to(tmp_path / "new")
    assert code(tmp_path / "new", None, tmp_path / "link") == "outputs-equal"
    assert code(tmp_path / "new", tmp_path / "newer") is None
    assert code(Path(os.devnull), Path(os.devnull)) is None


def test_a_file_that_exists_is_replaced_only_if_told(tmp_path: Path) -> None:
    old = tmp_path / "old"
    old.write_text("old")
    assert code(old) == "output-exists"
    assert code(old, overwrite=True) is None
    with pytest.raises(ServiceError, match="--overwrite"), written(old):
        pytest.fail("the check comes before the work")
    with written(old, overwrite=True) as partial:
        partial.write_text("new")
        assert old.read_text() == "old"
    assert old.read_text() == "new" and list(tmp_path.iterdir()) == [old]


def test_work_that_fails_and_a_file_that_appears_meanwhile_leave_what_was_there(tmp_path: Path) -> None:
    target = tmp_path / "target"
    with pytest.raises(ServiceError) as caught, written(target) as partial:
        partial.write_text("mine")
        target.write_text("theirs")
    assert caught.value.code == "output-exists"
    with pytest.raises(OSError, match="broken"), written(target, overwrite=True) as partial:
        partial.write_text("half")
        raise OSError("broken")
    assert target.read_text() == "theirs" and list(tmp_path.iterdir()) == [target]


def test_a_link_stays_a_link_and_a_device_is_not_replaced(tmp_path: Path) -> None:
    (tmp_path / "link").symlink_to(tmp_path / "target")
    with written(tmp_path / "link") as partial:
        partial.write_text("content")
    assert (tmp_path / "link").is_symlink() and (tmp_path / "target").read_text() == "content"
    with written(tmp_path / "content.gz") as partial:
        partial.write_text("content")
    assert gzip.decompress((tmp_path / "content.gz").read_bytes()) == b"content"
    with written(os.devnull) as partial:
        assert partial == Path(os.devnull)
    assert Path(os.devnull).is_char_device()


def test_what_cannot_be_written_is_noticed_by_trying(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "file").touch()
    packed = tmp_path / "x.fits.fz"
    for place in (tmp_path / "no" / "x", tmp_path / "file" / "x", tmp_path, Path("/proc/x"), packed):
        assert code(place, overwrite=True) == "output-not-writable", place
    for folder in (tmp_path / "file", Path("/proc/x")):
        with pytest.raises(ServiceError) as caught:
            check_output_folder(folder)
        assert caught.value.code == "output-not-writable"
    check_output_folder(tmp_path / "a" / "b")

    def full(_descriptor: int) -> None:
        raise OSError(28, os.strerror(28))

    monkeypatch.setattr(os, "fsync", full)
    with pytest.raises(ServiceError, match="No space left"):
        check_outputs((tmp_path / "x",))
    assert sorted(path.name for path in tmp_path.iterdir()) == ["file"]
