"""PSFs that others published: where they are, what they contain and how to cite them; `get` brings one.

No PSF is shipped. `get` brings the published file through pooch, or takes it from a folder, checks it and keeps its weights as a
PSF file of heliopsf (float32), whose header names instrument, version, citation (PSFREF) and DOI (PSFDOI). A download must have
the checksum of the table, or else the one that the repository tells; it comes from the servers of the table alone, and ends at
twice the size that its pixels explain. A download that broke off is kept as NAME.part, and resumed by the next try, even of another
process, if the server still has the same file.

Sources of the addresses: AIA: data set doi:10.7910/DVN/DYT4ZL, numbers of the files as in the package pycatch, checksums by the
file API of Dataverse; XRT: the directories of SolarSoft and the SHA-256 that xrtpy 0.5.1 names. No public address of the files
for EUVI could be confirmed, and no checksum.
"""

from __future__ import annotations

import fcntl
import hashlib
import json
import os
import re
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Any
from urllib.parse import urljoin, urlsplit

from psfcore.errors import DataError, did_you_mean, module_of_extra
from psfcore.files import sha256_of
from psfcore.fits.blocks import LIMITS

if TYPE_CHECKING:
    from requests import Response

    from psfcore.psf import Psf

MIB = 2**20
TRIES_AGAIN = 4
_TIMEOUT_S = 60  # without a byte
_BLOCK_BYTES = 2**16
_BYTES_A_PIXEL = 8  # of the published files: doubles at most
_MOST_REDIRECTIONS = 5
# The names of checksums in Dataverse, and those of hashlib.
_ALGORITHMS = {"MD5": "md5", "SHA-1": "sha1", "SHA-256": "sha256", "SHA-512": "sha512"}
_CONTENT_RANGE = re.compile(r"bytes (\d+)-\d+/(\d+)")


@dataclass(frozen=True)
class Published:
    """A published PSF.

    channel: wavelength in angstrom, or the energy. contains: the parts of the PSF. citation, doi: of the publication; doi None: no
    DOI is known. file: name of the published file, (size_px, size_px) px. addresses: where it is, the next one is asked if one
    fails; empty: place says where to find it. origins: schemes and hosts of the servers that are asked, also those to which an
    answer leads. instrument: as cards name it. cards: further cards that images must agree with. file_mib: None if unknown. sha256:
    of the published file; None: the repository tells a checksum at checksum_address; if that is empty, none is known.
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
    origins: tuple[str, ...]
    place: str
    instrument: str
    plate_scale_arcsec: float
    wavelength_angstrom: float | None = None
    cards: dict[str, str] = field(default_factory=dict)
    file_mib: int | None = None
    sha256: str | None = None
    checksum_address: str = ""


_DATAVERSE, _DATAVERSE_FILES = "https://dataverse.harvard.edu", "https://dvn-cloud.s3.amazonaws.com"
_SOLARSOFT = {"https://sohoftp.nascom.nasa.gov": "solarsoft", "https://hesperia.gsfc.nasa.gov": "ssw"}


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
        addresses=(f"{_DATAVERSE}/api/access/datafile/{number}",),
        origins=(_DATAVERSE, _DATAVERSE_FILES),
        place="doi:10.7910/DVN/DYT4ZL",
        instrument=f"aia_{channel}",
        plate_scale_arcsec=0.6,
        wavelength_angstrom=float(channel),
        file_mib=512,
        checksum_address=f"{_DATAVERSE}/api/files/{number}",
    )


def _xrt(energy: str, file: str, sha256: str) -> Published:
    folder = "hinode/xrt/idl/util"
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
        addresses=tuple(f"{origin}/{root}/{folder}/{file}" for origin, root in _SOLARSOFT.items()),
        origins=tuple(_SOLARSOFT),
        place=f"SolarSoft, {folder}",
        instrument="XRT",
        plate_scale_arcsec=1.0286,
        cards={"TELESCOP": "HINODE"},
        sha256=sha256,
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
        origins=(),
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
        _xrt(
            "560 eV",
            "XRT20170324_151721.0.PSF560.fits",
            "0eaa5da6fb69661e7f46d1f0c463e4b3b1745426a399a4fbc53fc0c0ae87dd0d",
        ),
        _xrt(
            "1 keV",
            "XRT20170324_161721.0.PSF1000.fits",
            "95590a7174692977a2f111b932811c9c7ae105a59b93bfe6c96fba862cefacf1",
        ),
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

    source: a folder with the published file, for machines without internet; None: download it. A file of a folder is compared with
    the SHA-256 of the table, if that has one. progress(stage, done, of), in MiB. Raises DataError "unknown-published-psf", "no-address", "psf-not-downloaded", "no-such-file", "published-psf-changed", and the
    errors of a file that is no PSF; MissingExtra without pooch.
    """
    one = published(name)
    kept = folder / f"{name}.fits"
    if kept.is_file() and source is None:
        return kept
    folder.mkdir(parents=True, exist_ok=True)
    with TemporaryDirectory(prefix=f".{name}-", dir=folder) as temporary:
        file = _downloaded(one, Path(temporary), progress) if source is None else _file_in(one, source)
        sha256 = sha256_of(file)
        if one.sha256 not in (None, sha256):
            raise DataError(
                "published-psf-changed",
                f"expected {one.file} with the SHA-256 {one.sha256}; got {sha256}: get the published file again from {one.place}",
            )
        from psfcore.fits.psfs import write_kernel  # `psf published` loads no numerical libraries

        new = Path(temporary) / "kept.fits"
        write_kernel(new, _as_psf(one, file, sha256))
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
    failures = []
    for address in one.addresses:
        brought = pooch.create(
            folder, "", registry={one.file: None}, urls={one.file: address}, retry_if_failed=TRIES_AGAIN
        )
        try:
            download = _Download(one, *_checksum(one), folder.parent / f"{one.name}.part", progress)
            return Path(brought.fetch(one.file, downloader=download))
        except (OSError, ValueError) as error:  # those of requests are OSErrors
            failures.append(f"{address}: {error!s:.300}")
    raise DataError(
        "psf-not-downloaded",
        f"expected to download {one.file}; got {'; '.join(failures)}: try again, or without internet {by_hand}",
    )


def _checksum(one: Published) -> tuple[str, str]:
    """The algorithm and the checksum of the published file: those of the table, or else those that its repository tells.

    Raises OSError or ValueError if the repository does not tell them.
    """
    if one.sha256 is not None:
        return "sha256", one.sha256
    with _answer(one, one.checksum_address, {}) as answer:
        answer.raise_for_status()
        text = answer.raw.read(MIB, decode_content=True)
    try:
        checksum = json.loads(text)["data"]["dataFile"]["checksum"]
        return _ALGORITHMS[checksum["type"]], str(checksum["value"]).lower()
    except (KeyError, TypeError, ValueError) as error:
        raise ValueError(
            f"expected the checksum of {one.file} at {one.checksum_address}; got {text!r:.80}"
        ) from error


def _answer(one: Published, address: str, headers: dict[str, str]) -> Response:
    """The answer to a request, after its redirections. Raises OSError if an address is not at the origins of the PSF."""
    import requests  # pooch needs it

    for _ in range(_MOST_REDIRECTIONS + 1):
        parts = urlsplit(address)
        if f"{parts.scheme}://{parts.netloc}" not in one.origins:
            raise OSError(f"expected an address at {' or '.join(one.origins)}; got {address:.100}")
        answer = requests.get(
            address, headers=headers, stream=True, timeout=_TIMEOUT_S, allow_redirects=False
        )
        if not answer.is_redirect:
            return answer
        answer.close()
        address = urljoin(address, answer.headers["Location"])
    raise OSError(f"expected at most {_MOST_REDIRECTIONS} redirections; got one more, to {address:.100}")


@dataclass(frozen=True)
class _Download:
    """A downloader for pooch. It keeps what arrived in ``part``, and asks for the rest alone.

    The version of the file (ETag or date of the answer) is kept beside it: a server that has another file sends the whole one.
    algorithm, checksum: those of the published file. progress(stage, done, of), in MiB.
    """

    one: Published
    algorithm: str
    checksum: str
    part: Path
    progress: Callable[[str, int, int], None]

    def __call__(self, url: str, output_file: str, _: Any) -> None:
        import requests

        version = self.part.with_suffix(".version")
        with self.part.open("ab") as file:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)  # BlockingIOError: another process downloads it
            asked = done = file.tell() if version.is_file() else 0
            headers = {"Accept-Encoding": "identity"}
            if asked:
                headers |= {"Range": f"bytes={asked}-", "If-Range": version.read_text()}
            with _answer(self.one, url, headers) as answer:
                if answer.status_code != requests.codes.requested_range_not_satisfiable:
                    answer.raise_for_status()
                first, total = _extent(answer)
                if first != asked:
                    done = 0
                    version.unlink(missing_ok=True)
                file.truncate(done)
                if first != asked and answer.status_code != requests.codes.ok:
                    raise requests.RequestException(
                        f"expected the whole file or its rest; got status {answer.status_code} and Content-Range "
                        f"{answer.headers.get('Content-Range')}"
                    )
                if name := answer.headers.get("ETag") or answer.headers.get("Last-Modified"):
                    version.write_text(name)
                self._check_size(total)
                for block in answer.iter_content(_BLOCK_BYTES):
                    file.write(block)
                    done += len(block)
                    self._check_size(done)
                    self.progress(f"downloading {self.one.name} (MiB)", done // MIB, max(total // MIB, 1))
            if done < total:
                raise requests.RequestException(f"expected {total} bytes; got {done}")
            file.flush()
            self._check_content()
            os.replace(self.part, output_file)
        version.unlink(missing_ok=True)

    def _check_size(self, size: int) -> None:
        expected = _BYTES_A_PIXEL * self.one.size_px**2
        if size > 2 * expected:
            self._refuse(f"expected about {expected / MIB:.3g} MiB; the server sends more than twice as much")

    def _check_content(self) -> None:
        with self.part.open("rb") as file:
            checksum = hashlib.file_digest(file, self.algorithm).hexdigest()
        if checksum != self.checksum:
            self._refuse(f"expected the {self.algorithm} {self.checksum}; got {checksum}")

    def _refuse(self, reason: str) -> None:
        """Forget what arrived. An OSError, because pooch tries again after other errors."""
        self.part.unlink()
        self.part.with_suffix(".version").unlink(missing_ok=True)
        raise OSError(reason)


def _extent(answer: Response) -> tuple[int | None, int]:
    """The first byte of the file that an answer contains, None if it does not say; and the size of the file, 0 if unknown."""
    if answer.status_code == 200:
        return 0, int(answer.headers.get("Content-Length", 0))
    told = _CONTENT_RANGE.fullmatch(answer.headers.get("Content-Range", ""))
    return (int(told[1]), int(told[2])) if answer.status_code == 206 and told else (None, 0)


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
