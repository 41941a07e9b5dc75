"""PSFs that others published: where they are, what they contain and how to cite them; `get` brings one.

No PSF is shipped; `published_psfs.toml` lists them. `get` brings the published file through pooch, or takes it from a
folder, checks it and keeps its weights as a PSF file of heliopsf (float32), whose header names instrument, version,
citation (PSFREF) and DOI (PSFDOI). A download must have the checksum of the table, or else the one that the repository
tells; it comes from the servers of the table alone, and ends at twice the size that its pixels explain. A download that
broke off is kept as NAME.CHECKSUM.part, and resumed by the next try, even of another process.
"""

from __future__ import annotations

import fcntl
import json
import os
from collections.abc import Callable
from functools import partial
from itertools import chain
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING
from urllib.parse import urljoin, urlsplit

from psfcore.errors import DataError, did_you_mean, module_of_extra
from psfcore.files import sha256_of
from psfcore.fits.blocks import LIMITS
from psfcore.instruments.files import telescope_of
from psfcore.instruments.published import PUBLISHED, Published

if TYPE_CHECKING:
    from requests import Response

    from psfcore.fits.cards import Cards
    from psfcore.psf import Psf

PUBLISHED_OF_IMAGE = "published"  # names the published PSF of an image
MIB = 2**20
TRIES_AGAIN = 4
_TIMEOUT_S = 60  # without a byte
_BLOCK_BYTES = 2**16
_BYTES_A_PIXEL = 8  # of the published files: doubles at most
_MOST_REDIRECTIONS = 5
# The names of checksums in Dataverse, and those of pooch.
_ALGORITHMS = {"MD5": "md5", "SHA-1": "sha1", "SHA-256": "sha256", "SHA-512": "sha512"}


def published(name: str) -> Published:
    """The published PSF of this name. Raises DataError "unknown-published-psf"."""
    if name not in PUBLISHED:
        raise DataError(
            "unknown-published-psf",
            f"expected the name of a published PSF; got {name!r:.80}{did_you_mean(name, list(PUBLISHED))}: "
            "`heliopsf psf published` lists them",
        )
    return PUBLISHED[name]


def published_of(header: Cards) -> Published:
    """The published PSF for an image with this header. Raises DataError "no-published-psf" if none or several fit."""
    # `psf published` reads no header.
    from psfcore.fits.channel import PsfOrigin, channel_differences, same_words
    from psfcore.fits.header import known_instrument

    instrument = known_instrument(header)
    telescope = "" if instrument is None else telescope_of(instrument)

    def fits(one: Published) -> bool:
        if not same_words(telescope, one.telescope):
            return False
        scale, wavelength = one.plate_scale_arcsec, one.wavelength_angstrom
        return not channel_differences(
            PsfOrigin(one.name, one.instrument, wavelength, scale, one.cards), header
        )

    fitting = [one for one in PUBLISHED.values() if fits(one)]
    if len(fitting) != 1:
        names = ", ".join(one.name for one in fitting)
        raise DataError(
            "no-published-psf",
            f"expected an image for which one PSF is published; got an image for which {names or 'none'} could be "
            "used: name the PSF, `heliopsf psf published` lists them",
        )
    return fitting[0]


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

    Raises DataError "unknown-published-psf", "no-address", "psf-not-downloaded", "no-such-file",
    "published-psf-changed", and the errors of a file that is no PSF; MissingExtra without pooch.

    Parameters
    ----------
    source
        A folder with the published file, for machines without internet; None: the file is downloaded. A file of a
        folder is compared with the SHA-256 of the table, if the table has one.
    progress
        Function progress(stage, done, of) that is called during a download, with `done` and `of` in MiB.
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
                f"expected {one.file} with the SHA-256 {one.sha256}; got {sha256}: get the published file again from "
                f"{one.place}",
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
        # pooch gets no checksum, because it would download a file with another checksum again and again.
        brought = pooch.create(
            folder, "", registry={one.file: None}, urls={one.file: address}, retry_if_failed=TRIES_AGAIN
        )
        try:
            download = partial(_download, one, _checksum(one), folder.parent, progress)
            return Path(brought.fetch(one.file, downloader=download))
        except (OSError, ValueError) as error:  # those of requests are OSErrors
            failures.append(f"{address}: {error!s:.300}")
    raise DataError(
        "psf-not-downloaded",
        f"expected to download {one.file}; got {'; '.join(failures)}: try again, or without internet {by_hand}",
    )


def _checksum(one: Published) -> str:
    """ALGORITHM:CHECKSUM of the published file: of the table, or else what its repository tells.

    Raises OSError or ValueError if the repository does not tell them.
    """
    if one.sha256 is not None:
        return f"sha256:{one.sha256}"
    with _answer(one, one.checksum_address, {}) as answer:
        answer.raise_for_status()
        text = answer.raw.read(MIB, decode_content=True)
    try:
        checksum = json.loads(text)["data"]["dataFile"]["checksum"]
        return f"{_ALGORITHMS[checksum['type']]}:{bytes.fromhex(checksum['value']).hex()}"
    except (KeyError, TypeError, ValueError) as error:
        raise ValueError(
            f"expected the checksum of {one.file} at {one.checksum_address}; got {text!r:.80}"
        ) from error


def _answer(one: Published, address: str, headers: dict[str, str]) -> Response:
    """The answer to a request, after its redirections. Raises OSError if an address is not at the origins of the
    PSF.
    """
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


def _download(
    one: Published,
    checksum: str,
    folder: Path,
    progress: Callable[[str, int, int], None],
    url: str,
    output_file: str,
    _: object,
) -> None:
    """A downloader for pooch. It keeps in ``folder`` what arrived, and asks for the rest alone.

    Raises requests.RequestException, after which pooch tries again, and other OSErrors.
    """
    import requests

    algorithm, expected = checksum.split(":")
    most = 2 * _BYTES_A_PIXEL * one.size_px**2
    part = folder / f"{one.name}.{expected}.part"
    with part.open("ab") as file:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)  # BlockingIOError: another process downloads it
        done = file.tell()
        headers = {"Accept-Encoding": "identity"} | ({"Range": f"bytes={done}-"} if done else {})
        with _answer(one, url, headers) as answer:
            if answer.status_code != requests.codes.requested_range_not_satisfiable:
                answer.raise_for_status()
            done = 0 if answer.status_code == requests.codes.ok else done
            total = done + int(answer.headers.get("Content-Length", 0))
            extent = answer.headers.get("Content-Range")
            if done == 0 or extent != f"bytes {done}-{total - 1}/{total}":
                file.truncate(0)
                if answer.status_code != requests.codes.ok:
                    raise requests.RequestException(
                        f"expected the whole file or its rest; got status {answer.status_code} and Content-Range "
                        f"{extent}"
                    )
            # The empty block lets the announced size be checked first.
            for block in chain([b""], answer.iter_content(_BLOCK_BYTES)):
                done += file.write(block)
                if max(done, total) > most:
                    part.unlink()
                    raise OSError(
                        f"expected about {most / 2 / MIB:.3g} MiB; the server sends more than twice as much"
                    )
                progress(f"downloading {one.name} (MiB)", done // MIB, max(total // MIB, 1))
        if done < total:
            raise requests.RequestException(f"expected {total} bytes; got {done}")
        file.flush()
        got = module_of_extra("pooch").file_hash(str(part), alg=algorithm)
        if got != expected:
            part.unlink()
            raise OSError(f"expected the {algorithm} {expected}; got {got}")
        os.replace(part, output_file)
    for other in folder.glob(f"{one.name}.*.part"):  # of another version of the file
        other.unlink(missing_ok=True)


def _as_psf(one: Published, file: Path, sha256: str) -> Psf:
    """The PSF in a published file. Weights that sum to more than 1 are divided by their sum."""
    from psfcore.fits.images import read_plane
    from psfcore.psf import LARGEST_SUM, Psf

    kernel = read_plane(file, LIMITS)
    total = float(kernel.sum())
    provenance: dict[str, object] = {"doi": one.doi, "citation": one.citation, "contains": one.contains}
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
