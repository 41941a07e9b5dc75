"""Files of an archive: patterns, header conditions, and paths outside the allowed folders."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import pytest
from pydantic import TypeAdapter, ValidationError

from psfcore.errors import DataError
from psfcore.fits.header import FitsLimits
from tests.conftest import write_image
from workers.contract.bulk import Where
from workers.files import archive as archive_files

LIMITS = FitsLimits(max_pixels=512 * 512)


@pytest.fixture
def archive(tmp_path: Path) -> Path:
    """Two years, a hidden file, and links that lead within the archive and out of it."""
    root = tmp_path / "archive"
    for name in ("2021/a.fits", "2022/03/b.fits", "2022/03/b.txt", "2022/03/.c.fits", "2022/c[1].fits"):
        (root / name).parent.mkdir(parents=True, exist_ok=True)
        (root / name).write_bytes(b"x")
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


@pytest.mark.parametrize(
    ("glob", "names"),
    [
        ("2021/a.fits", ["2021/a.fits"]),
        ("2021/nothing.fits", []),
        ("*/a.fits", ["2021/a.fits", "again/a.fits"]),
        ("**/*.fits", ["2021/a.fits", "2022/03/b.fits", "2022/c[1].fits"]),
        ("**/.c.fits", ["2022/03/.c.fits"]),
        ("2022/**", ["2022/03/b.fits", "2022/03/b.txt", "2022/c[1].fits"]),
        ("202[23]/?3/b.*", ["2022/03/b.fits", "2022/03/b.txt"]),
        ("**/03/*.fits", ["2022/03/b.fits"]),
        ("out/*.fits", []),
        ("**/s.fits", []),
        ("**/**/*.fits", ["2021/a.fits", "2022/03/b.fits", "2022/c[1].fits"]),
        ("**/2*/**/*.fits", ["2021/a.fits", "2022/03/b.fits", "2022/c[1].fits"]),
        ("**/*/**/*.fits", ["2021/a.fits", "2022/03/b.fits", "2022/c[1].fits", "again/a.fits"]),
        ("**/2*/**/03/**/**", ["2022/03/b.fits", "2022/03/b.txt"]),
        ("**/0*/**/0*/**/*.fits", []),
    ],
)
def test_the_files_that_a_pattern_matches(archive: Path, glob: str, names: list[str]) -> None:
    if glob == "out/*.fits":
        with pytest.raises(DataError, match="expected a path below"):
            found(archive, glob)
        return
    assert sorted(found(archive, glob)) == names


def test_files_come_before_those_of_folders_below_each_by_name(archive: Path) -> None:
    for name in ("z.fits", "2022/b.fits", "2022/a/y.fits"):
        (archive / name).parent.mkdir(exist_ok=True)
        (archive / name).write_bytes(b"x")
    expected = ["z.fits", "2021/a.fits", "2022/b.fits", "2022/c[1].fits", "2022/03/b.fits", "2022/a/y.fits"]
    assert found(archive, "**/*.fits") == expected


@pytest.mark.parametrize("pattern", ["/**" * 12 + "/*.fits", "/**/d*" * 5 + "/**/*.fits", "/**/*" * 8])
def test_each_folder_is_read_once_with_several_double_stars(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, pattern: str
) -> None:
    root = tmp_path / "archive"
    deep = root.joinpath(*(f"d{n}" for n in range(12)))
    deep.mkdir(parents=True)
    (deep / "x.fits").write_bytes(b"x")
    looked: list[Path] = []
    real = os.scandir

    def counted(folder: Path) -> Any:
        looked.append(folder)
        return real(folder)

    monkeypatch.setattr(archive_files.os, "scandir", counted)
    steps = list(archive_files.find(f"{root}{pattern}", [root]))
    assert [step.path for step in steps if step.matches] == [deep / "x.fits"]
    assert sorted(looked) == sorted({root, deep, *(one for one in deep.parents if root in one.parents)})
    assert len(steps) == 13 + 13, "for each folder and each entry"


def test_a_search_that_finds_nothing_can_be_stopped_at_each_folder_before_it_is_read(
    archive: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    search = archive_files.find(f"{archive}/**/*.none", [archive])
    with monkeypatch.context() as patched:
        patched.setattr(archive_files.os, "scandir", lambda folder: pytest.fail(f"{folder} was read"))
        first = next(search)
    assert (first.path, first.place, first.matches) == (archive, ("",), False)


@pytest.mark.parametrize("glob", ["**/*.fits", "**/2*/**/*.fits", "*/*/*.fits", "**/*", "2022/**"])
def test_a_search_continues_after_every_place_where_it_can_stop(archive: Path, glob: str) -> None:
    """Files between folders by name, names with bytes before "/", and a folder that begins with another's name."""
    for name in (
        "2022/03!/d.fits",
        "2022/03.fits",
        "2022/03/z/e.fits",
        "2022-b/f.fits",
        "z.fits",
        "2022/zz/g.fits",
    ):
        (archive / name).parent.mkdir(exist_ok=True, parents=True)
        (archive / name).write_bytes(b"x")
    (archive / "2022" / os.fsdecode(b"\xff.fits")).write_bytes(b"x")
    whole = list(archive_files.find(f"{archive}/{glob}", [archive]))
    assert len({step.place for step in whole}) == len(whole)
    for number, step in enumerate(whole):
        rest = list(archive_files.find(f"{archive}/{glob}", [archive], step.place))
        assert rest == whole[number + 1 :], step.place


def test_a_search_that_continues_does_not_read_folders_that_it_has_finished(
    archive: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    looked: list[str] = []
    real = os.scandir
    monkeypatch.setattr(
        archive_files.os, "scandir", lambda folder: looked.append(str(folder)) or real(folder)
    )
    after = ("2022", "03", "b.fits")
    rest = [one.path.name for one in archive_files.find(f"{archive}/**/*.fits", [archive], after)]
    assert rest == ["b.txt"]
    assert looked == [str(archive), str(archive / "2022"), str(archive / "2022" / "03")], "not 2021"


def test_a_place_stays_valid_when_files_are_removed_and_added(archive: Path) -> None:
    after = ("2022", "03", "b.fits")
    (archive / "2022" / "03" / "b.fits").unlink()
    for name in ("2021/before.fits", "2022/03/c.fits", "2023/later.fits"):
        (archive / name).parent.mkdir(exist_ok=True)
        (archive / name).write_bytes(b"x")
    rest = list(archive_files.find(f"{archive}/**/*.fits", [archive], after))
    assert [one.path.name for one in rest if one.matches] == ["c.fits", "later.fits"]


@pytest.mark.parametrize("glob", ["*.fits", "**/*.fits", "*/*.fits"])
def test_a_circular_link_is_yielded_with_its_error_and_the_walk_continues(archive: Path, glob: str) -> None:
    for name in ("loop.fits", "2021/loop.fits"):
        (archive / name).symlink_to(archive / name)
    (archive / "z.fits").write_bytes(b"x")
    files = [one for one in archive_files.find(f"{archive}/{glob}", [archive]) if one.matches or one.error]
    wrong = [file for file in files if file.error is not None]
    assert wrong and all(file.path.name == "loop.fits" for file in wrong)
    for file in wrong:
        assert file.error is not None and file.error.code == "unreadable-file"
        assert "expected a file or folder" in file.error.message and "symbolic links" in file.error.message
    right = {str(file.path.relative_to(archive)) for file in files if file.error is None}
    assert right & {"z.fits", "2021/a.fits"}


def test_a_pattern_below_a_link_to_itself_is_refused(archive: Path) -> None:
    (archive / "loop").symlink_to(archive / "loop")
    with pytest.raises(DataError, match="symbolic links"):
        list(archive_files.find(f"{archive}/loop/*.fits", [archive]))


def test_paths_are_shown_as_text_that_can_be_stored(tmp_path: Path) -> None:
    assert archive_files.shown(Path("/a/Sönne.fits")) == "/a/Sönne.fits"
    assert archive_files.shown(Path(os.fsdecode(b"/a/S\xf6nne.fits"))) == "/a/S\\xf6nne.fits"


@pytest.mark.parametrize(
    ("glob", "code"),
    [
        ("relative/*.fits", "bad-path"),
        ("/tmp/../etc/*", "bad-path"),
        ("/etc/*", "path-not-allowed"),
        ("{archive}/../secret/*", "bad-path"),
        ("{archive}-too/*", "path-not-allowed"),
        ("{archive}/none/*", "unreadable-folder"),
        ("/*", "path-not-allowed"),
        ("/", "path-not-allowed"),
    ],
)
def test_paths_outside_the_allowed_folders_are_refused(archive: Path, glob: str, code: str) -> None:
    with pytest.raises(DataError) as caught:
        list(archive_files.find(glob.format(archive=archive), [archive]))
    assert caught.value.code == code


def test_without_allowed_folders_every_path_is_refused(archive: Path) -> None:
    assert archive_files.roots("") == ()
    with pytest.raises(DataError, match="no folder is set"):
        archive_files.check_glob(f"{archive}/*.fits", ())


def test_folders_of_a_setting_are_resolved(archive: Path, tmp_path: Path) -> None:
    (tmp_path / "link").symlink_to(archive)
    assert archive_files.roots(os.pathsep.join([str(tmp_path / "link"), str(tmp_path)])) == (
        archive.resolve(),
        tmp_path.resolve(),
    )


@pytest.mark.parametrize(
    ("where", "met"),
    [
        ({}, True),
        ({"INSTRUME": "EUI", "WAVELNTH": 174}, True),
        ({"WAVELNTH": 174.0}, True),
        ({"WAVELNTH": "174"}, False),
        ({"WAVELNTH": [171, 174]}, True),
        ({"WAVELNTH": [171, 193]}, False),
        ({"XPOSURE": {">=": 2, "<": 2.5}}, True),
        ({"XPOSURE": {">": 2}}, False),
        ({"DATE-BEG": {">=": "2022-03-01", "<": "2022-04-01"}}, True),
        ({"DATE-BEG": {"<": "2022-03-01"}}, False),
        ({"INSTRUME": {"!=": "AIA"}}, True),
        ({"INSTRUME": {"!=": "EUI"}}, False),
        ({"INSTRUME": {">": 3}}, False),
        ({"ONBOARD": True}, True),
        ({"ONBOARD": 1}, False),
        ({"ZERO": 0}, True),
        ({"NOTHERE": {"!=": 1}}, False),
    ],
)
def test_headers_that_meet_conditions(tmp_path: Path, where: dict[str, Any], met: bool) -> None:
    path = tmp_path / "i.fits"
    cards = {
        "INSTRUME": "EUI ",
        "WAVELNTH": 174,
        "DATE-BEG": "2022-03-17T03:18:00",
        "ONBOARD": True,
        "ZERO": 0,
    }
    write_image(path, **cards)
    asked = TypeAdapter(Where).validate_python(where)
    assert archive_files.matches(path, asked, LIMITS) is met


@pytest.mark.parametrize(
    "where", [{"instrume": 1}, {"A": {}}, {"A": []}, {"A": {"=~": "x"}}, {"A": None}, {"A": float("nan")}]
)
def test_invalid_conditions_are_refused(where: dict[str, Any]) -> None:
    with pytest.raises(ValidationError):
        TypeAdapter(Where).validate_python(where)


@pytest.mark.parametrize(
    ("name", "safe"),
    [
        ("solo_L2_eui-hrieuv174.fits.gz", "solo_L2_eui-hrieuv174"),
        ("../../etc/passwd", "passwd"),
        ("a b;rm -rf $HOME.FITS", "a_b_rm_-rf_HOME"),
        (".hidden.fits", "hidden"),
        ("...", "image"),
        ("Sönne\n.fits", "S_nne"),
        ("x" * 300, "x" * 80),
    ],
)
def test_names_of_products(name: str, safe: str) -> None:
    assert archive_files.safe_name(name, "ab" * 32) == f"{safe}-{'ab' * 8}.fits"


def test_a_file_that_is_too_large_is_not_copied_to_its_end(tmp_path: Path) -> None:
    (tmp_path / "large").write_bytes(b"x" * (3 * 2**20))
    with (tmp_path / "large").open("rb") as file, pytest.raises(DataError, match="at most 1048576 bytes"):
        archive_files.copy_hashed(file, tmp_path / "copy", 2**20)
    assert (tmp_path / "copy").stat().st_size <= 2**20
