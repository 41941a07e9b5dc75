"""Archives: listed, packed, and unpacked completely or not at all, whatever they declare; and a transit read in
place."""

from __future__ import annotations

import gzip
import io
import itertools
import shutil
import stat
import struct
import tarfile
import warnings
import zipfile
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from astropy.io import fits

from psfcore.errors import DataError
from psfcore.files import sha256_of
from psfcore.transit import admission
from psfcore.transit.archive import (
    START_BYTES,
    ArchiveLimits,
    archive_kind,
    could_be_archive,
    list_archive,
    pack,
    transit_in,
    unpack,
)
from tests.transit_files import write_transit

LIMITS = ArchiveLimits()
SMALL = ArchiveLimits(max_files=100, max_bytes=2**20, max_member_bytes=2**19)
MIB = 2**20
Member = tuple[str, bytes]
Maker = Callable[[Path, list[Member]], Path]


@pytest.fixture(scope="module")
def written(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_transit(tmp_path_factory.mktemp("written") / "transit", images=3)


@pytest.fixture
def folder(written: Path, tmp_path: Path) -> Path:
    """A transit for one test."""
    return shutil.copytree(written, tmp_path / "transit")


def members_of(folder: Path, top: str = "") -> list[Member]:
    return [(top + path.name, path.read_bytes()) for path in sorted(folder.iterdir())]


def as_zip(path: Path, members: list[Member]) -> Path:
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as out:
        for name, content in members:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore", UserWarning)  # a name that occurs twice
                out.writestr(zipfile.ZipInfo(name) if name.endswith("/") else name, content)
    return path


def as_tar(path: Path, members: list[Member], mode: str = "w", form: int = tarfile.PAX_FORMAT) -> Path:
    with tarfile.open(path, mode, format=form) as out:  # type: ignore[call-overload]
        for name, content in members:
            info = tarfile.TarInfo(name)
            info.size, info.type = len(content), tarfile.DIRTYPE if name.endswith("/") else tarfile.REGTYPE
            out.addfile(info, io.BytesIO(content))
    return path


def as_tar_gz(path: Path, members: list[Member]) -> Path:
    return as_tar(path, members, "w:gz")


KINDS: dict[str, Maker] = {"zip": as_zip, "tar": as_tar, "tar.gz": as_tar_gz}


def refused(
    path: Path, target: Path, code: str, limits: ArchiveLimits = LIMITS, *, listed: bool = True
) -> str:
    """Check that unpacking, and listing if `listed`, refuses an archive and leaves nothing. Returns the message."""
    for look in (
        *([lambda: list_archive(path, limits)] if listed else []),
        lambda: unpack(path, target, limits),
    ):
        with pytest.raises(DataError) as caught:
            look()
        assert caught.value.code == code and "expected" in caught.value.message, caught.value
    assert not target.exists(), "files were left behind"
    return caught.value.message


# --- accepted --------------------------------------------------------------------------------------------

FROM_SYSTEMS = (
    ".DS_Store",
    "__MACOSX/._000.fits",
    "p1/.DS_Store",
    "p1/.git/config",
    "PaxHeader/000.fits",
    "p1/._a",
)


@pytest.mark.parametrize("kind", KINDS)
def test_the_files_of_the_transit_are_unpacked_and_no_others(folder: Path, tmp_path: Path, kind: str) -> None:
    """They are at the top level or in one folder. Hidden files and those of folders beside them are skipped, in any
    order."""
    (folder / "large.fits").write_bytes(bytes(range(256)) * 5000)  # more than is read at once
    content = {path.name: path.read_bytes() for path in folder.iterdir()}
    for top, order in itertools.product(("", "p1/", "./", "./p1/"), ("alone", "first", "last")):
        others = [
            (f"{top}noise_free/", b""),
            (f"{top}noise_free/000.fits", b"other"),
            (f"{top}scenes/x", b"x"),
        ]
        others += [(name, b"x") for name in FROM_SYSTEMS]
        members = members_of(folder, top)
        if top not in ("", "./"):
            members.insert(0, (top, b""))
        members = {"alone": members, "first": others + members, "last": members + others}[order]
        path, out = KINDS[kind](tmp_path / "no-ending", members), tmp_path / f"{top}{order}"
        listed = list_archive(path, LIMITS)
        assert (listed.kind, len(listed.manifest.images)) == (kind, 3)
        assert listed.files == {name: len(of_file) for name, of_file in content.items()}, (top, order)
        assert sorted(unpack(path, out, LIMITS)) == sorted(content)
        assert {p.name: p.read_bytes() for p in out.iterdir()} == content, (top, order)
        shutil.rmtree(out)


def test_pixels_are_counted_in_compressed_files_too(folder: Path, tmp_path: Path) -> None:
    pixels = np.arange(60 * 40, dtype=np.int16).reshape(60, 40)
    fits.CompImageHDU(pixels).writeto(folder / "000.fits", overwrite=True)
    fits.PrimaryHDU(pixels).writeto(tmp_path / "plain.fits")
    (folder / "001.fits").write_bytes(gzip.compress((tmp_path / "plain.fits").read_bytes()))
    (folder / "002.fits").write_bytes(b"SIMPLE  =" + bytes(4 * 60 * 40 - 9))
    for kind, make in KINDS.items():
        assert list_archive(make(tmp_path / kind, members_of(folder)), LIMITS).pixels == 3 * pixels.size, kind
    assert transit_in(folder).contents.pixels == 3 * pixels.size


def test_long_and_foreign_names_in_a_tar(tmp_path: Path) -> None:
    long = ["a" * 200 + ".fits", "Ü.fits"]
    forms = {tarfile.PAX_FORMAT: long, tarfile.GNU_FORMAT: long, tarfile.USTAR_FORMAT: ["a" * 90 + ".fits"]}
    for form, names in forms.items():
        path = as_tar(tmp_path / "a.tar", [(name, b"1234") for name in names], form=form)
        assert unpack(path, tmp_path / f"{form}", LIMITS) == tuple(names)
        assert (tmp_path / f"{form}" / names[0]).read_bytes() == b"1234"


def test_the_first_bytes_tell_the_kind(folder: Path, tmp_path: Path) -> None:
    for kind, make in (("zip", as_zip), ("tar", as_tar), ("gzip", as_tar_gz)):
        start = make(tmp_path / kind, members_of(folder)).read_bytes()[:START_BYTES]
        assert archive_kind(start) == kind
        assert all(could_be_archive(start[:count]) for count in range(START_BYTES + 1))
    assert archive_kind(b"SIMPLE  =" + bytes(300)) is None
    assert not could_be_archive(b"SIMPLE  =" + bytes(300))


# --- refused --------------------------------------------------------------------------------------------

CLIMBING = (
    "../evil.fits", "p1/../../evil.fits", "/etc/evil", "a\\..\\evil", "C:evil", "p1/C:/evil", "..", "__MACOSX/../e"
)  # fmt: skip
NOT_PLAIN = ("a/b/x.fits", "a/b/", "000.fits", "bell\x07.fits", " .fits", "x" * 300)


@pytest.mark.parametrize("kind", KINDS)
def test_names_out_of_the_folder_and_names_that_are_not_plain_are_refused(
    folder: Path, tmp_path: Path, kind: str
) -> None:
    for name in CLIMBING:
        path = KINDS[kind](tmp_path / "a", [*members_of(folder), (name, b"evil")])
        assert ascii(name) in refused(path, tmp_path / "deep/er/out", "archive-climbs")
        assert not list(tmp_path.rglob("*evil*"))
    for name in NOT_PLAIN:
        path = KINDS[kind](tmp_path / "a", [*members_of(folder), (name, b"")])
        refused(path, tmp_path / "out", "archive-not-plain")


@pytest.mark.parametrize("kind", KINDS)
def test_one_description_beside_the_other_files_in_one_folder(
    folder: Path, tmp_path: Path, kind: str
) -> None:
    plain, apart = members_of(folder), [("p2/x.fits", b"")]
    moved = [(f"p1/{name}" if name == "transit.json" else name, text) for name, text in plain]
    cases = [("a description elsewhere", moved), ("two folders", [*members_of(folder, "p1/"), *apart])]
    for top in ("", "p1/"):
        members, other = members_of(folder, top), [(f"{top}old/transit.json", b"{}")]
        cases += [("a second description", other + members), ("a second description", members + other)]
    for what, members in cases:
        message = refused(KINDS[kind](tmp_path / "a", members), tmp_path / "out", "archive-not-plain")
        assert ("transit.json" in message) == ("description" in what), what


@pytest.mark.parametrize("kind", KINDS)
def test_too_many_and_too_large_members_are_refused(folder: Path, tmp_path: Path, kind: str) -> None:
    """Files of other folders count too, and so does the number of hidden files."""
    for beside in ("", "beside/"):
        large = [*members_of(folder), (f"{beside}x.fits", bytes(600_000))]
        together = [*members_of(folder), *((f"{beside}{i}.x", bytes(400_000)) for i in range(3))]
        for members in (large, together):
            refused(KINDS[kind](tmp_path / "a", members), tmp_path / "out", "archive-too-large", SMALL)
    hidden = KINDS[kind](tmp_path / "a", [(f".{i}", b"") for i in range(101)])
    refused(hidden, tmp_path / "out", "archive-too-large", SMALL)


def test_links_and_devices_are_refused(folder: Path, tmp_path: Path) -> None:
    path = tmp_path / "a.tar"
    links, devices = (tarfile.SYMTYPE, tarfile.LNKTYPE), (tarfile.CHRTYPE, tarfile.BLKTYPE, tarfile.FIFOTYPE)
    for kind in (*links, *devices, b"S", b"Z"):
        as_tar(path, members_of(folder))
        with tarfile.open(path, "a") as out:
            link = tarfile.TarInfo("x.fits")
            link.type, link.linkname = kind, "/etc/passwd"
            out.addfile(link)
        refused(path, tmp_path / "out", "archive-not-plain")
    # In a folder beside the transit, too.
    kinds, names = (stat.S_IFLNK, stat.S_IFCHR, stat.S_IFIFO), ("x.fits", "x/", "beside/x.fits")
    for kind, name in itertools.product(kinds, names):
        path = as_zip(tmp_path / "a.zip", members_of(folder))
        with zipfile.ZipFile(path, "a") as out:
            info = zipfile.ZipInfo(name)
            info.external_attr, info.create_system = (kind | 0o777) << 16, 3
            out.writestr(info, "/etc/passwd")
        refused(path, tmp_path / "out", "archive-not-plain")


def patched(path: Path, member: str, offset_central: int, offset_local: int, form: str, value: int) -> Path:
    """Overwrite a field of one member of a zip, in the table of contents and in the local header."""
    with zipfile.ZipFile(path) as out:
        at_local = out.getinfo(member).header_offset
    content = bytearray(path.read_bytes())
    at_central = content.rindex(member.encode()) - 46
    struct.pack_into(form, content, at_central + offset_central, value)
    struct.pack_into(form, content, at_local + offset_local, value)
    path.write_bytes(content)
    return path


def test_a_zip_of_another_kind_is_refused(folder: Path, tmp_path: Path) -> None:
    for central, local, value, word in ((8, 6, 1, "encrypted"), (10, 8, 12, "deflated")):
        path = patched(
            as_zip(tmp_path / "a.zip", members_of(folder)), "001.fits", central, local, "<H", value
        )
        assert word in refused(path, tmp_path / "out", "archive-not-plain")


# --- bombs ------------------------------------------------------------------------------------------------


def test_the_ratio_of_unpacked_to_packed_bytes_is_limited(
    folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for make in (as_zip, as_tar_gz):
        path = make(tmp_path / "a", [*members_of(folder), ("x.fits", bytes(5 * MIB))])
        assert len(list_archive(path, LIMITS).files) == 6, "the ratio does not count for small output"
        with monkeypatch.context() as patch:
            patch.setattr(admission, "RATIO_FLOOR_BYTES", MIB)
            refused(path, tmp_path / "out", "archive-too-large", ArchiveLimits(max_ratio=20))


def endless_gz(path: Path, start: bytes, mib: int) -> Path:
    """A gzip of ``start``, followed by zeros."""
    with gzip.open(path, "wb", compresslevel=1) as out:
        out.write(start)
        for _ in range(mib):
            out.write(bytes(MIB))
    return path


def tar_header(name: str, size: int, kind: bytes = tarfile.REGTYPE) -> bytes:
    info = tarfile.TarInfo(name)
    info.size, info.type = size, kind
    return info.tobuf(tarfile.GNU_FORMAT)


def test_endless_gzips_are_read_only_to_the_limit(tmp_path: Path) -> None:
    limits = ArchiveLimits(max_bytes=4 * MIB, max_member_bytes=2**60)
    for name in ("x.fits", ".hidden"):
        path = endless_gz(tmp_path / "a.tar.gz", tar_header(name, 2**50), mib=48)
        refused(path, tmp_path / "out", "archive-too-large", limits)
    for kind in (b"x", b"g", b"L"):
        path = endless_gz(tmp_path / "a.tar.gz", tar_header("x", 2**33, kind), mib=32)
        refused(path, tmp_path / "out", "archive-broken")


def extended(kind: bytes, text: bytes) -> bytes:
    """An extended header of a tar and its text, filled up to whole blocks."""
    return tar_header("x", len(text), kind) + text + bytes(-len(text) % 512)


def record(key: bytes, value: bytes) -> bytes:
    """A pax record, whose length counts itself."""
    length = len(key) + len(value) + 3
    while len(b"%d" % length) + len(key) + len(value) + 3 != length:
        length += 1
    return b"%d %s=%s\n" % (length, key, value)


A_FILE = tar_header("x.fits", 4) + b"1234" + bytes(508)
SPARSE_MAP = record(b"GNU.sparse.major", b"1") + record(b"GNU.sparse.minor", b"0")
BROKEN = {
    "many headers before one member": extended(b"x", record(b"comment", b"a")) * 400 + A_FILE,
    "records inside each other": extended(b"x", b"2 " * 30_000 + b"=") + A_FILE,
    "a negative header": tar_header("x", -4096, b"x") + A_FILE,
    "a size beyond the file": extended(b"x", record(b"size", b"99999")) + A_FILE,
    "a sparse map": extended(b"x", SPARSE_MAP) + tar_header("x.fits", 2**30) + b"9999999\n" + b"1\n" * 2**20,
    "a damaged second header": A_FILE + b"x" * 512 + A_FILE,
    "half a header": A_FILE + tar_header("y.fits", 0)[:300],
    "no end": A_FILE,
}
NOT_PLAIN_FILES = {
    "many long names": extended(b"L", b"a" * 5000) * 50 + A_FILE,
    "a negative file": tar_header("x", -4096) + A_FILE,
    "a negative size in a record": extended(b"x", record(b"size", b"-99999")) + A_FILE,
    "a sparse file of GNU": tar_header("x.fits", 512, b"S") + b"9" * 2**20,
    "a sparse name": extended(b"x", record(b"GNU.sparse.name", b"y")) + A_FILE,
    "a sparse size": extended(b"g", record(b"GNU.sparse.realsize", b"9")) + A_FILE,
}
CLIMBING_PATHS = {
    "a path in a record": extended(b"x", record(b"path", b"../x.fits")) + A_FILE,
    "a path for all": extended(b"g", record(b"path", b"/x.fits")) + A_FILE,
}
TAR_ATTACKS = {
    "archive-broken": BROKEN,
    "archive-not-plain": NOT_PLAIN_FILES,
    "archive-climbs": CLIMBING_PATHS,
}


@pytest.mark.parametrize("packed", [False, True], ids=["tar", "tar.gz"])
def test_headers_of_a_tar_cannot_mislead_tarfile(tmp_path: Path, packed: bool) -> None:
    path = tmp_path / "a"
    for code, attack in ((code, attack) for code, attacks in TAR_ATTACKS.items() for attack in attacks):
        content = TAR_ATTACKS[code][attack]
        end = b"" if attack in ("no end", "half a header") else bytes(1024)
        path.write_bytes(gzip.compress(content + end, 1) if packed else content + end)
        refused(path, tmp_path / "out", code)


def test_ordinary_extended_headers_are_read(tmp_path: Path) -> None:
    """A global comment (git archive), times and attributes, a long name of GNU tar."""
    content = (
        extended(b"g", record(b"comment", b"0123abcd" * 5))
        + extended(b"x", record(b"mtime", b"1700000000.25") + record(b"LIBARCHIVE.xattr.a", b"Q" * 5000))
        + A_FILE
        + extended(b"x", record(b"path", b"y.fits") + record(b"size", b"4"))
        + A_FILE
        + extended(b"L", b"z" * 150 + b"\0")
        + A_FILE
    )
    path = tmp_path / "a.tar"
    path.write_bytes(content + bytes(1024))
    assert unpack(path, tmp_path / "out", LIMITS) == ("x.fits", "y.fits", "z" * 150)
    assert {file.read_bytes() for file in (tmp_path / "out").iterdir()} == {b"1234"}


def test_entries_of_a_zip_are_counted_and_may_not_share_bytes(
    tmp_path: Path,
) -> None:
    """100 000 entries in the table of contents, of 52 bytes each; the number that the archive declares is small."""
    path = as_zip(tmp_path / "a.zip", [(".00000", b"")])
    content = path.read_bytes()
    at, end = content.index(b"PK\1\2"), content.index(b"PK\5\6")
    entries = b"".join(content[at:end].replace(b".00000", b".%05d" % i) for i in range(100_000))
    tail = struct.pack("<4sHHHHIIH", b"PK\5\6", 0, 0, 1, 1, len(entries), at, 0)
    path.write_bytes(content[:at] + entries + tail)
    assert "members" in refused(path, tmp_path / "out", "archive-too-large")
    # All entries of the table of contents point to the bytes of one member, whose own name zipfile compares.
    path = as_zip(tmp_path / "a.zip", [("000.fits", bytes(MIB))])
    content = path.read_bytes()
    at, end = content.index(b"PK\1\2"), content.index(b"PK\5\6")
    entries = b"".join(content[at:end].replace(b"000.fits", b"%03d.fits" % i) for i in range(50))
    tail = struct.pack("<4sHHHHIIH", b"PK\5\6", 0, 0, 50, 50, len(entries), at, 0)
    path.write_bytes(content[:at] + entries + tail)
    refused(path, tmp_path / "out", "archive-broken")


def test_a_zip_that_declares_a_wrong_size_is_refused(folder: Path, tmp_path: Path) -> None:
    """50 KiB that hold 48 MiB: reading stops at the declared size. A size below that of a header is refused when
    listed."""
    content = as_zip(tmp_path / "a.zip", [("x.fits", bytes(48 * MIB))]).read_bytes()
    assert len(content) > 40_000
    for declared in (10_000, 30_000):
        (tmp_path / "a.zip").write_bytes(content)
        path = patched(tmp_path / "a.zip", "x.fits", 24, 22, "<I", declared)
        refused(path, tmp_path / "out", "archive-broken", listed=declared == 10_000)
    too_large = patched(as_zip(tmp_path / "a.zip", members_of(folder)), "001.fits", 24, 22, "<I", 10**6)
    refused(too_large, tmp_path / "out", "archive-broken", listed=False)


# --- damage -----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("kind", KINDS)
def test_a_truncated_archive_is_refused(folder: Path, tmp_path: Path, kind: str) -> None:
    path = KINDS[kind](tmp_path / "a", members_of(folder))
    content = path.read_bytes().rstrip(b"\0")
    for share in (0.05, 0.5, 0.9, 0.97):
        path.write_bytes(content[: int(share * len(content))])
        refused(path, tmp_path / "out", "archive-broken")


def test_unpacking_a_zip_finds_a_wrong_byte(folder: Path, tmp_path: Path) -> None:
    noise = np.random.default_rng(1).bytes(100_000)
    path = as_zip(tmp_path / "a.zip", [*members_of(folder), ("x.fits", noise)])
    content = bytearray(path.read_bytes())
    content[content.index(b"x.fits") + 50_000] ^= 0xFF
    path.write_bytes(content)
    list_archive(path, LIMITS)
    refused(path, tmp_path / "out", "archive-broken", listed=False)


def test_other_files_are_refused(tmp_path: Path) -> None:
    image = b"SIMPLE  =" + bytes(5000)
    for content in (b"", b"x", b"PK", image, bytes(1024), gzip.compress(image)):
        (tmp_path / "a").write_bytes(content)
        refused(tmp_path / "a", tmp_path / "out", "not-an-archive")


@pytest.mark.parametrize("kind", KINDS)
def test_random_damage_is_reported_and_leaves_nothing_behind(tmp_path: Path, kind: str) -> None:
    path = KINDS[kind](tmp_path / "a", [("transit.json", b"{}"), ("000.fits", bytes(range(256)) * 3)])
    whole = path.read_bytes()
    rng = np.random.default_rng(5)
    codes = set()
    for _ in range(40):
        content = bytearray(whole)
        for at in rng.integers(0, len(content), size=rng.integers(1, 4)):
            content[at] = rng.integers(256)
        path.write_bytes(content)
        for look in (list_archive, lambda p, limits: unpack(p, tmp_path / "out", limits)):
            try:
                look(path, SMALL)
                shutil.rmtree(tmp_path / "out", ignore_errors=True)
            except DataError as error:
                codes.add(error.code)
        assert not (tmp_path / "out").exists()
    assert "archive-broken" in codes


def test_errors_of_the_disk_are_passed_on(folder: Path, tmp_path: Path) -> None:
    path = as_tar(tmp_path / "a", members_of(folder))
    out = tmp_path / "out"
    out.mkdir()
    (out / "001.fits").write_text("was here before")
    with pytest.raises(FileExistsError):
        unpack(path, out, LIMITS)
    assert [p.name for p in out.iterdir()] == ["001.fits"], "existing files stay, new ones are removed"


# --- the table of contents --------------------------------------------------------------------------------


@pytest.mark.parametrize("kind", KINDS)
def test_missing_and_wrong_files_are_named(folder: Path, tmp_path: Path, kind: str) -> None:
    whole = dict(members_of(folder))
    cases = [
        ("no-manifest", "transit.json", None),
        ("missing-file", "001.fits", None),
        ("missing-file", "diffraction.fits", None),
        ("not-fits", "001.fits", b"hello"),
        ("bad-manifest", "transit.json", b"{}"),
        ("bad-manifest", "transit.json", b" " * (5 * MIB)),
    ]
    for code, name, content in cases:
        members = [(one, text) for one, text in (whole | {name: content}).items() if text is not None]
        with pytest.raises(DataError) as caught:
            list_archive(KINDS[kind](tmp_path / "a", members), LIMITS)
        assert caught.value.code == code and name in caught.value.message


# --- in place --------------------------------------------------------------------------------------------


def test_equal_folders_are_packed_to_equal_bytes(folder: Path, tmp_path: Path) -> None:
    before = sorted(path.name for path in folder.iterdir())
    found = transit_in(folder)
    assert sorted(path.name for path in folder.iterdir()) == before
    pack(folder, tmp_path / "transit.tar")
    assert found.sha256 == sha256_of(tmp_path / "transit.tar")
    assert found.bytes == (tmp_path / "transit.tar").stat().st_size
    assert found.contents == list_archive(tmp_path / "transit.tar", ArchiveLimits())
    assert found.folder == folder.resolve()
    (folder / "notes.txt").write_text("not named in transit.json")
    pack(folder, tmp_path / "a.tar")
    again = tmp_path / "elsewhere"
    shutil.copytree(folder, again, copy_function=shutil.copyfile)
    (again / "notes.txt").unlink()
    (again / "000.fits").chmod(0o600)
    pack(again, tmp_path / "b.tar")
    assert (tmp_path / "a.tar").read_bytes() == (tmp_path / "b.tar").read_bytes()
    unpack(tmp_path / "a.tar", tmp_path / "out", LIMITS)
    assert (tmp_path / "out/002.fits").read_bytes() == (folder / "002.fits").read_bytes()
    assert not (tmp_path / "out/notes.txt").exists()


def test_all_bad_files_are_named_in_one_error_and_nothing_is_written(folder: Path, tmp_path: Path) -> None:
    (folder / "002.fits").write_text("a letter")
    for name in ("001.fits", "diffraction.fits"):
        (folder / name).unlink()
    for check in (transit_in, lambda folder: pack(folder, tmp_path / "t.tar")):
        with pytest.raises(DataError, match=r"missing-file: 3 files cannot be used") as caught:
            check(folder)
        names = [
            name for name in ("000", "001", "002", "diffraction") if f"{name}.fits" in caught.value.message
        ]
        assert names == ["001", "002", "diffraction"]
    assert not (tmp_path / "t.tar").exists()
    with pytest.raises(DataError, match="no-manifest"):
        transit_in(tmp_path)
