"""Files of an archive: patterns, header conditions, and paths outside the allowed folders."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import pytest
from pydantic import TypeAdapter, ValidationError

from psfcore.errors import DataError
from psfcore.fits.blocks import FitsLimits
from tests.conftest import write_image
from tests.workers.psf_examples import refused
from workers.contract.bulk import Where
from workers.files import archive as archive_files

LIMITS = FitsLimits(max_pixels=512 * 512)


@pytest.fixture
def archive(tmp_path: Path) -> Path:
    """Two years, a hidden file, and links that lead within the archive and out of it."""
    root = tmp_path / "archive"
    put(root, "2021/a.fits", "2022/03/b.fits", "2022/03/b.txt", "2022/03/.c.fits", "2022/c[1].fits")
    (tmp_path / "secret").mkdir()
    (tmp_path / "secret" / "s.fits").write_bytes(b"s")
    (root / "out").symlink_to(tmp_path / "secret")
    (root / "2021" / "s.fits").symlink_to(tmp_path / "secret" / "s.fits")
    (root / "again").symlink_to(root / "2021")
    return root


def found(archive: Path, glob: str) -> list[str]:
    looked = list(archive_files.find(f"{archive}/{glob}", [archive]))
    assert all(one.error is None for one in looked)
    return [str(one.path.relative_to(archive)) for one in looked if one.matches]


def put(archive: Path, *names: str) -> None:
    for name in names:
        (archive / name).parent.mkdir(parents=True, exist_ok=True)
        (archive / name).write_bytes(b"x")


MATCHES: tuple[tuple[str, list[str]], ...] = (
    ("2021/a.fits", ["2021/a.fits"]),
    ("2021/nothing.fits", []),
    ("*/a.fits", ["2021/a.fits", "again/a.fits"]),
    ("**/*.fits", ["2021/a.fits", "2022/03/b.fits", "2022/c[1].fits"]),
    ("**/.c.fits", ["2022/03/.c.fits"]),
    ("2022/**", ["2022/03/b.fits", "2022/03/b.txt", "2022/c[1].fits"]),
    ("202[23]/?3/b.*", ["2022/03/b.fits", "2022/03/b.txt"]),
    ("**/03/*.fits", ["2022/03/b.fits"]),
    ("**/s.fits", []),
    ("**/**/*.fits", ["2021/a.fits", "2022/03/b.fits", "2022/c[1].fits"]),
    ("**/2*/**/*.fits", ["2021/a.fits", "2022/03/b.fits", "2022/c[1].fits"]),
    ("**/*/**/*.fits", ["2021/a.fits", "2022/03/b.fits", "2022/c[1].fits", "again/a.fits"]),
    ("**/2*/**/03/**/**", ["2022/03/b.fits", "2022/03/b.txt"]),
    ("**/0*/**/0*/**/*.fits", []),
)


def test_the_files_that_a_pattern_matches(archive: Path) -> None:
    for glob, names in MATCHES:
        assert sorted(found(archive, glob)) == names, glob
    with pytest.raises(DataError, match="expected a path below"):
        found(archive, "out/*.fits")


def test_files_come_before_those_of_folders_below_each_by_name(archive: Path) -> None:
    put(archive, "z.fits", "2022/b.fits", "2022/a/y.fits")
    expected = ["z.fits", "2021/a.fits", "2022/b.fits", "2022/c[1].fits", "2022/03/b.fits", "2022/a/y.fits"]
    assert found(archive, "**/*.fits") == expected


def reads(monkeypatch: pytest.MonkeyPatch) -> list[Path]:
    """The folders that are read from now on."""
    folders: list[Path] = []
    real = os.scandir
    monkeypatch.setattr(archive_files.os, "scandir", lambda folder: folders.append(folder) or real(folder))
    return folders


def test_each_folder_is_read_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    root = tmp_path / "archive"
    deep = root.joinpath(*(f"d{n}" for n in range(12)))
    deep.mkdir(parents=True)
    (deep / "x.fits").write_bytes(b"x")
    folders = reads(monkeypatch)
    first = next(archive_files.find(f"{root}/**/*.none", [root]))
    assert (first.path, first.position, first.matches, folders) == (root, ("",), False, []), (
        "a position to stop"
    )
    for pattern in ("/**" * 12 + "/*.fits", "/**/d*" * 5 + "/**/*.fits", "/**/*" * 8):
        folders.clear()
        steps = list(archive_files.find(f"{root}{pattern}", [root]))
        assert [step.path for step in steps if step.matches] == [deep / "x.fits"]
        below = {root, deep, *(one for one in deep.parents if root in one.parents)}
        assert sorted(folders) == sorted(below), pattern
        assert len(steps) == 13 + 13, "for each folder and each entry"


def test_a_search_continues_after_every_place_where_it_can_stop(archive: Path) -> None:
    """Files between folders by name, names with bytes before "/", and a folder that begins with another's name."""
    put(
        archive,
        "2022/03!/d.fits",
        "2022/03.fits",
        "2022/03/z/e.fits",
        "2022-b/f.fits",
        "z.fits",
        "2022/zz/g.fits",
    )
    (archive / "2022" / os.fsdecode(b"\xff.fits")).write_bytes(b"x")
    for glob in ("**/*.fits", "**/2*/**/*.fits", "*/*/*.fits", "**/*", "2022/**"):
        whole = list(archive_files.find(f"{archive}/{glob}", [archive]))
        assert len({step.position for step in whole}) == len(whole)
        for number, step in enumerate(whole):
            rest = list(archive_files.find(f"{archive}/{glob}", [archive], step.position))
            assert rest == whole[number + 1 :], (glob, step.position)


def test_a_continued_search_reads_no_finished_folder(archive: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    folders, after = reads(monkeypatch), ("2022", "03", "b.fits")
    rest = [one.path.name for one in archive_files.find(f"{archive}/**/*.fits", [archive], after)]
    assert rest == ["b.txt"]
    assert folders == [archive, archive / "2022", archive / "2022" / "03"], "not 2021"
    (archive / "2022" / "03" / "b.fits").unlink()
    put(archive, "2021/before.fits", "2022/03/c.fits", "2023/later.fits")
    steps = list(archive_files.find(f"{archive}/**/*.fits", [archive], after))
    assert [one.path.name for one in steps if one.matches] == ["c.fits", "later.fits"]


def test_a_circular_link_is_yielded_with_its_error_and_the_walk_continues(archive: Path) -> None:
    for name in ("loop.fits", "2021/loop.fits"):
        (archive / name).symlink_to(archive / name)
    put(archive, "z.fits")
    for glob in ("*.fits", "**/*.fits", "*/*.fits"):
        steps = list(archive_files.find(f"{archive}/{glob}", [archive]))
        wrong = [step for step in steps if step.error is not None]
        assert wrong and all(step.path.name == "loop.fits" for step in wrong), glob
        for step in wrong:
            assert step.error is not None and step.error.code == "unreadable-file"
            assert "symbolic links" in step.error.message
        right = {str(step.path.relative_to(archive)) for step in steps if step.matches and not step.error}
        assert right & {"z.fits", "2021/a.fits"}, glob
    (archive / "loop").symlink_to(archive / "loop")
    with pytest.raises(DataError, match="symbolic links"):
        list(archive_files.find(f"{archive}/loop/*.fits", [archive]))


def test_paths_are_shown_as_text_that_can_be_stored(tmp_path: Path) -> None:
    assert archive_files.shown(Path("/a/Sönne.fits")) == "/a/Sönne.fits"
    assert archive_files.shown(Path(os.fsdecode(b"/a/S\xf6nne.fits"))) == "/a/S\\xf6nne.fits"


OUTSIDE = (
    ("relative/*.fits", "bad-path"),
    ("/tmp/../etc/*", "bad-path"),
    ("/etc/*", "path-not-allowed"),
    ("{archive}/../secret/*", "bad-path"),
    ("{archive}-too/*", "path-not-allowed"),
    ("{archive}/none/*", "unreadable-folder"),
    ("/*", "path-not-allowed"),
    ("/", "path-not-allowed"),
)


def test_paths_outside_the_allowed_folders_are_refused(archive: Path) -> None:
    for glob, code in OUTSIDE:
        refused(code, lambda glob=glob: list(archive_files.find(glob.format(archive=archive), [archive])))
    assert archive_files.roots("") == ()
    with pytest.raises(DataError, match="no folder is set"):
        archive_files.check_glob(f"{archive}/*.fits", ())


def test_folders_of_a_setting_are_resolved(archive: Path, tmp_path: Path) -> None:
    (tmp_path / "link").symlink_to(archive)
    assert archive_files.roots(os.pathsep.join([str(tmp_path / "link"), str(tmp_path)])) == (
        archive.resolve(),
        tmp_path.resolve(),
    )


CONDITIONS: tuple[tuple[dict[str, Any], bool], ...] = (
    ({}, True),
    ({"INSTRUME": "EUI", "WAVELNTH": 174}, True),
    ({"WAVELNTH": 174.0}, True),
    ({"WAVELNTH": "174"}, False),
    ({"WAVELNTH": [171, 174]}, True),
    ({"WAVELNTH": [171, 193]}, False),
    ({"XPOSURE": {">=": 2, "<": 2.5}}, True),
    ({"XPOSURE": {">": 2}}, False),
    ({"XPOSURE": {"<": 2}}, False),
    ({"XPOSURE": {"<=": 2}}, True),
    ({"DATE-BEG": {">=": "2022-03-01", "<": "2022-04-01"}}, True),
    ({"DATE-BEG": {"<": "2022-03-01"}}, False),
    ({"INSTRUME": {"!=": "AIA"}}, True),
    ({"INSTRUME": {"!=": "EUI"}}, False),
    ({"INSTRUME": {">": 3}}, False),
    ({"ONBOARD": True}, True),
    ({"ONBOARD": 1}, False),
    ({"ZERO": 0}, True),
    ({"NOTHERE": {"!=": 1}}, False),
)
INVALID: tuple[dict[str, Any], ...] = (
    {"instrume": 1}, {"A": {}}, {"A": []}, {"A": {"=~": "x"}}, {"A": None}, {"A": float("nan")},
)  # fmt: skip


def test_headers_that_meet_conditions(tmp_path: Path) -> None:
    path, where = tmp_path / "i.fits", TypeAdapter[Where](Where)
    date = "2022-03-17T03:18:00"
    cards = {"INSTRUME": "EUI ", "WAVELNTH": 174, "DATE-BEG": date, "ONBOARD": True, "ZERO": 0}
    write_image(path, **cards)
    for conditions, met in CONDITIONS:
        assert archive_files.matches(path, where.validate_python(conditions), LIMITS) is met, conditions
    for conditions in INVALID:
        with pytest.raises(ValidationError):
            where.validate_python(conditions)


def test_names_of_products() -> None:
    for name, safe in (
        ("solo_L2_eui-hrieuv174.fits.gz", "solo_L2_eui-hrieuv174"),
        ("a.fits.fz", "a"),
        ("b.FTS.GZ", "b"),
        ("../../etc/passwd", "passwd"),
        ("a b;rm -rf $HOME.FITS", "a_b_rm_-rf_HOME"),
        (".hidden.fits", "hidden"),
        ("...", "image"),
        ("Sönne\n.fits", "S_nne"),
        ("x" * 300, "x" * 80),
    ):
        assert archive_files.safe_name(name, "ab" * 32) == f"{safe}-{'ab' * 8}.fits"


def test_a_file_that_is_too_large_is_not_copied_to_its_end(tmp_path: Path) -> None:
    (tmp_path / "large").write_bytes(b"x" * (3 * 2**20))
    with (tmp_path / "large").open("rb") as file, pytest.raises(DataError, match="at most 1048576 bytes"):
        archive_files.copy_hashed(file, tmp_path / "copy", 2**20)
    assert (tmp_path / "copy").stat().st_size <= 2**20
