"""PSFs that others published: where they are, what they contain and how to cite them; `get` brings one.

No PSF is shipped. `get` brings the published file through pooch, or takes it from a folder, checks it and keeps its weights as a
PSF file of heliopsf (float32), whose header names instrument, version, citation (PSFREF) and DOI (PSFDOI). The SHA-256 of the
published file is recorded at the first time; later files must have the same one. A download that broke off is kept as
NAME.part, and resumed by the next try, even of another process, if the server still has the same file.

Sources of the addresses: AIA: data set doi:10.7910/DVN/DYT4ZL, numbers of the files as in the package pycatch; XRT: the
directories of SolarSoft that xrtpy names. No public address of the files for EUVI could be confirmed.
"""

from __future__ import annotations

import fcntl
import json
import os
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Any

from psfcore.errors import DataError, did_you_mean, module_of_extra
from psfcore.files import sha256_of
from psfcore.fits.blocks import LIMITS

if TYPE_CHECKING:
    from psfcore.psf import Psf

MIB = 2**20
TRIES_AGAIN = 4
_TIMEOUT_S = 60  # without a byte
_BLOCK_BYTES = 2**16


@dataclass(frozen=True)
class Published:
    """A published PSF.

    channel: wavelength in angstrom, or the energy. contains: the parts of the PSF. citation, doi: of the publication; doi None: no
    DOI is known. file: name of the published file, (size_px, size_px) px. addresses: where it is, the next one is asked if one
    fails; empty: place says where to find it. instrument: as cards name it. cards: further cards that images must agree with.
    file_mib: None if unknown.
    """

    name: str
    telescope: str
    channel: str
    contains: str
    citation: str
    doi: str | None
    version: str
    file: str
    size_px: int
    addresses: tuple[str, ...]
    place: str
    instrument: str
    plate_scale_arcsec: float
    wavelength_angstrom: float | None = None
    cards: dict[str, str] = field(default_factory=dict)
    file_mib: int | None = None


def _aia(channel: int, number: int) -> Published:
    return Published(
        name=f"aia_{channel}_2025",
        telescope="SDO/AIA",
        channel=f"{channel} A",
        contains="diffraction, diffuse scatter (two power laws)",
        citation="Hofmeister, Savin & Hahn (2025), ApJS 278, 8; data doi:10.7910/DVN/DYT4ZL",
        doi="10.3847/1538-4365/adbaed",
        version="2025",
        file=f"psf_aia_{channel}.fits",
        size_px=8192,
        addresses=(f"https://dataverse.harvard.edu/api/access/datafile/{number}",),
        place="doi:10.7910/DVN/DYT4ZL",
        instrument=f"aia_{channel}",
        plate_scale_arcsec=0.6,
        wavelength_angstrom=float(channel),
        file_mib=512,
    )


def _xrt(energy: str, file: str) -> Published:
    folder = "hinode/xrt/idl/util"
    mirrors = ("https://sohoftp.nascom.nasa.gov/solarsoft", "https://hesperia.gsfc.nasa.gov/ssw")
    return Published(
        name=f"xrt_{energy.lower().replace(' ', '')}_2017",
        telescope="Hinode/XRT",
        channel=energy,
        contains="model of the mirror",
        citation=f"SolarSoft, {folder}/{file}",
        doi=None,
        version="2017",
        file=file,
        size_px=2048,
        addresses=tuple(f"{mirror}/{folder}/{file}" for mirror in mirrors),
        place=f"SolarSoft, {folder}",
        instrument="XRT",
        plate_scale_arcsec=1.0286,
        cards={"TELESCOP": "HINODE"},
    )


def _euvi(channel: int, spacecraft: str) -> Published:
    return Published(
        name=f"euvi_{channel}_{spacecraft.lower()}_2012",
        telescope=f"STEREO-{spacecraft}/EUVI",
        channel=f"{channel} A",
        contains="long-range scatter, from a transit of the Moon",
        citation="Shearer, Frazin, Hero & Gilbert (2012), ApJ 749, L8",
        doi="10.1088/2041-8205/749/1/L8",
        version="2012",
        file=f"psf_{channel}_{spacecraft}_2048.fts",
        size_px=2048,
        addresses=(),
        place="SolarSoft, package euvdeconpak",
        instrument="EUVI",
        plate_scale_arcsec=1.588,
        wavelength_angstrom=float(channel),
        cards={"OBSRVTRY": f"STEREO_{spacecraft}", "DETECTOR": "EUVI"},
    )


_AIA_FILES = {94: 10615239, 131: 10615236, 171: 10615233, 193: 10615234, 211: 10615238, 304: 10615237}
_AIA_FILES |= {335: 10615235}
PUBLISHED = {
    one.name: one
    for one in (
        *(_aia(channel, number) for channel, number in _AIA_FILES.items()),
        _xrt("560 eV", "XRT20170324_151721.0.PSF560.fits"),
        _xrt("1 keV", "XRT20170324_161721.0.PSF1000.fits"),
        *(_euvi(channel, spacecraft) for spacecraft in "AB" for channel in (171, 195, 284, 304)),
    )
}


def published(name: str) -> Published:
    """The published PSF of this name. Raises DataError "unknown-published-psf"."""
    if name not in PUBLISHED:
        raise DataError(
            "unknown-published-psf",
            f"expected the name of a published PSF; got {name!r:.80}{did_you_mean(name, list(PUBLISHED))}: "
            "`heliopsf psf published` lists them",
        )
    return PUBLISHED[name]


def kept_file(folder: Path, name: str) -> Path:
    """The file of a published PSF that `get` kept. Raises DataError "psf-not-fetched" and "unknown-published-psf"."""
    kept = folder / f"{published(name).name}.fits"
    if not kept.is_file():
        raise DataError(
            "psf-not-fetched",
            f"expected the published PSF {name} in {folder}; it is not there: `heliopsf psf get {name}` brings it",
        )
    return kept


def get(
    folder: Path,
    name: str,
    *,
    source: Path | None = None,
    progress: Callable[[str, int, int], None] = lambda stage, step, steps: None,
) -> Path:
    """Bring a published PSF, if ``folder`` does not have it yet; returns its file.

    source: a folder with the published file, for machines without internet; None: download it. progress(stage, done, of), in MiB.
    Raises DataError "unknown-published-psf", "no-address", "psf-not-downloaded", "no-such-file", "published-psf-changed", and the
    errors of a file that is no PSF; MissingExtra without pooch.
    """
    one = published(name)
    kept, record = folder / f"{name}.fits", folder / f"{name}.json"
    if kept.is_file() and source is None:
        return kept
    folder.mkdir(parents=True, exist_ok=True)
    with TemporaryDirectory(prefix=f".{name}-", dir=folder) as temporary:
        file = _downloaded(one, Path(temporary), progress) if source is None else _file_in(one, source)
        sha256 = sha256_of(file)
        first = json.loads(record.read_bytes())["sha256"] if record.is_file() else sha256
        if sha256 != first:
            raise DataError(
                "published-psf-changed",
                f"expected {one.file} with the SHA-256 of the first time, {first}; got {sha256}: get the first file again, or if "
                f"the authors replaced it, remove {record} and {kept}",
            )
        from psfcore.fits.psfs import write_kernel  # `psf published` loads no numerical libraries

        new = Path(temporary) / "kept.fits"
        write_kernel(new, _as_psf(one, file, sha256))
        record.write_text(json.dumps({"file": one.file, "sha256": sha256}))
        os.replace(new, kept)
    return kept


def _file_in(one: Published, source: Path) -> Path:
    if not (source / one.file).is_file():
        raise DataError(
            "no-such-file", f"expected {one.file} in {source}; it is not there: get it from {one.place}"
        )
    return source / one.file


def _downloaded(one: Published, folder: Path, progress: Callable[[str, int, int], None]) -> Path:
    """Download the published file into a folder; a broken download is tried again, then the next address is asked."""
    by_hand = f"get {one.file} from {one.place}, and name its folder with --from"
    if not one.addresses:
        raise DataError(
            "no-address",
            f"expected a public address of {one.name}; none could be confirmed: {by_hand}",
        )
    pooch = module_of_extra("pooch")
    pooch.get_logger().setLevel("WARNING")
    part = folder.parent / f"{one.name}.part"
    resuming = _Resuming(
        part, lambda done, of: progress(f"downloading {one.name} (MiB)", done // MIB, max(of // MIB, 1))
    )
    failures = []
    for address in one.addresses:
        brought = pooch.create(
            folder, "", registry={one.file: None}, urls={one.file: address}, retry_if_failed=TRIES_AGAIN
        )
        try:
            return Path(brought.fetch(one.file, downloader=resuming))
        except (OSError, ValueError) as error:  # those of requests are OSErrors
            failures.append(f"{address}: {error!s:.200}")
    raise DataError(
        "psf-not-downloaded",
        f"expected to download {one.file}; got {'; '.join(failures)}: try again, or without internet {by_hand}",
    )


@dataclass(frozen=True)
class _Resuming:
    """A downloader for pooch. It keeps what arrived in ``part``, and asks for the rest alone.

    The version of the file (ETag or date of the answer) is kept beside it: a server that has another file sends the whole one.
    say(done, of): the progress in bytes.
    """

    part: Path
    say: Callable[[int, int], None]

    def __call__(self, url: str, output_file: str, _: Any) -> None:
        import requests  # pooch needs it

        version = self.part.with_suffix(".version")
        with self.part.open("ab") as file:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)  # BlockingIOError: another process downloads it
            done = file.tell() if version.is_file() else 0
            headers = {"Accept-Encoding": "identity"}
            if done:
                headers |= {"Range": f"bytes={done}-", "If-Range": version.read_text()}
            with requests.get(url, headers=headers, stream=True, timeout=_TIMEOUT_S) as answer:
                if answer.status_code in (requests.codes.ok, requests.codes.requested_range_not_satisfiable):
                    done = 0
                    file.truncate(0)
                    version.unlink(missing_ok=True)
                answer.raise_for_status()
                total = done + int(answer.headers.get("Content-Length", 0))
                if name := answer.headers.get("ETag") or answer.headers.get("Last-Modified"):
                    version.write_text(name)
                for block in answer.iter_content(_BLOCK_BYTES):
                    file.write(block)
                    done += len(block)
                    self.say(done, total)
            os.replace(self.part, output_file)
        version.unlink(missing_ok=True)


def _as_psf(one: Published, file: Path, sha256: str) -> Psf:
    """The PSF in a published file. Weights that sum to more than 1 are divided by their sum."""
    from psfcore.fits.images import read_plane
    from psfcore.psf import LARGEST_SUM, Psf

    kernel = read_plane(file, LIMITS)
    total = float(kernel.sum())
    provenance: dict[str, Any] = {"doi": one.doi, "citation": one.citation, "contains": one.contains}
    provenance |= {"published_file": one.file, "published_sha256": sha256}
    if total > LARGEST_SUM:
        kernel /= total
        provenance["divided_by"] = f"the sum of the published weights, {total:.8g}"
    return Psf(
        kernel=kernel,
        name=one.name,
        version=one.version,
        instrument=one.instrument,
        status="published",
        plate_scale_arcsec=one.plate_scale_arcsec,
        wavelength_angstrom=one.wavelength_angstrom,
        provenance={key: value for key, value in provenance.items() if value is not None},
        cards=one.cards,
    )
