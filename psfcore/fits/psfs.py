"""Read and write point-spread functions (PSFs) as FITS files.

In memory, weights are float64 [y, x]. Files that this module writes hold float32. Equal content gives equal bytes.
"""

from __future__ import annotations

import math
import os
import re
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from astropy.io import fits
from numpy.typing import NDArray

from psfcore.errors import DataError
from psfcore.fits.blocks import FitsLimits, Hdu
from psfcore.fits.cards import card_count, optional_number, optional_text
from psfcore.fits.frame import plate_scale_arcsec
from psfcore.fits.hdus import as_written, ascii_text, read_pixels, readable_pixels, write_hdus
from psfcore.fits.header import FIELD, all_hdus, field_hdus, origin_of, wavelength_angstrom
from psfcore.limited import run_limited, scratch_file
from psfcore.psf import FittedShape, Psf, cumulative_curve, encircled_energy, radial_profile
from psfcore.psf_field import MOST_TERMS, FieldTerm, Place

# The cards of the publication of a PSF, by their names in the provenance.
_PUBLICATION = {"doi": ("PSFDOI", "DOI of its publication"), "citation": ("PSFREF", "")}
_STATED = re.compile(r"psf_id: ([0-9a-f]{64})")


def write_psf(path: str | Path, psf: Psf, *, instrument_file: bytes | None = None) -> None:
    """Write a PSF: the kernel in the primary HDU, one image HDU per component and per term of the field, and tables.

    The tables are PROFILE (weight by radius), FIT (the fitted shape, if any) and INSTRUMENT. Weights are stored as
    float32. The rounding changes each weight by at most 6e-8 of its value, and the sum by less than 1e-7.

    Parameters
    ----------
    instrument_file
        The TOML text from which the PSF was built. It is stored unchanged in INSTRUMENT.
    """
    hdus: list[fits.PrimaryHDU | fits.ImageHDU] = [
        fits.PrimaryHDU(psf.kernel.astype(np.float32), _psf_header(psf))
    ]
    for name, kernel in psf.components.items():
        component = fits.ImageHDU(kernel.astype(np.float32), name=ascii_text(name).upper())
        component.header["PSFSUM"] = (float(kernel.sum()), "sum of weights on this array")
        hdus.append(component)
    hdus.extend(_field_hdus(psf))
    hdus.append(_profile_hdu(psf))
    if psf.fitted is not None:
        hdus.append(_fitted_hdu(psf.fitted))
    if instrument_file is not None:
        text = np.frombuffer(instrument_file, dtype=np.uint8)[None]
        columns = [fits.Column(name="TOML", format=f"{text.size}B", array=text)]
        hdus.append(fits.BinTableHDU.from_columns(columns, name="INSTRUMENT"))
    write_hdus(path, hdus)


def write_kernel(path: str | Path, psf: Psf) -> None:
    """Write the kernel of a PSF and its header, as `write_psf`, but no tables, which a large PSF would need much memory
    for.
    """
    write_hdus(path, [fits.PrimaryHDU(psf.kernel.astype(np.float32), _psf_header(psf)), *_field_hdus(psf)])


def _field_hdus(psf: Psf) -> list[fits.ImageHDU]:
    """One HDU for each term of the field. The place of the PSF must be that of a whole detector; if this detector is
    binned, its outermost pixels have coordinates below 1 in size, for which the factor corrects.
    """
    hdus = []
    for term in psf.field_terms:
        assert psf.place is not None
        (nx, ny), (u, v) = psf.place.detector, (-psf.place.x[0], -psf.place.y[0])
        factor = u**term.x_power * v**term.y_power
        hdu = fits.ImageHDU((factor * term.kernel).astype(np.float32), name=FIELD)
        for axis, power, size in (("X", term.x_power, nx), ("Y", term.y_power, ny)):
            hdu.header[f"{axis}POWER"] = (power, f"power of the {axis.lower()} coordinate, -1 to 1")
            hdu.header[f"FIELDN{axis}"] = (size, "[pixel] size of the detector")
        hdus.append(hdu)
    return hdus


def _psf_header(psf: Psf) -> fits.Header:
    header = fits.Header(
        [
            ("PSFNAME", ascii_text(psf.name), "name of this point-spread function"),
            ("PSFVERS", ascii_text(psf.version), "its version"),
            ("PSFSTAT", ascii_text(psf.status), "draft or released"),
            ("PSFSUM", psf.total, "sum of weights on this array"),
            ("REACH", psf.reach_px, "[pixel] farthest pixel from the centre"),
        ]
    )
    if psf.field_terms:
        header["NFIELD"] = (len(psf.field_terms), "extensions FIELD: it changes over the field")
    if psf.instrument is not None:
        header["INSTRUME"] = (ascii_text(psf.instrument), "instrument description")
    for key, text in psf.cards.items():
        if key not in header:
            header[key] = ascii_text(text)
    for key, (card, comment) in _PUBLICATION.items():
        if key in psf.provenance:
            header[card] = (ascii_text(psf.provenance[key]), comment)
    if psf.turn_deg:
        header["PSFTURN"] = (psf.turn_deg, "[deg] from +x of the detector to +x of the PSF")
    if psf.wavelength_angstrom is not None:
        header["WAVELNTH"] = (psf.wavelength_angstrom, "[Angstrom] wavelength")
    for axis, size in ((1, psf.kernel.shape[1]), (2, psf.kernel.shape[0])):
        header[f"CRPIX{axis}"] = (size // 2 + 1.0, "[pixel] centre, counted from 1")
        if psf.plate_scale_arcsec is not None:
            header[f"CDELT{axis}"] = (psf.plate_scale_arcsec, "[arcsec] pixel scale")
            header[f"CUNIT{axis}"] = "arcsec"
    for key, value in psf.provenance.items():
        if key != "instrument_toml" and key not in _PUBLICATION:
            header.add_history(ascii_text(f"{key}: {value}"))
    return header


def _profile_hdu(psf: Psf) -> fits.BinTableHDU:
    """Table of mean weight and encircled energy by radius, for the total PSF and for each component."""
    radius, weight = radial_profile(psf.kernel)
    columns = {
        "radius_px": radius,
        "mean_weight": weight,
        "encircled": encircled_energy(psf.kernel, radius),
        "cumulative_pct": cumulative_curve(psf.kernel, radius),
    }
    units = {"radius_px": "pixel", "cumulative_pct": "%"}
    for name, kernel in psf.components.items():
        if kernel.shape == psf.kernel.shape:
            label = ascii_text(name).lower()
            columns[f"{label}_mean_weight"] = radial_profile(kernel)[1]
            columns[f"{label}_encircled"] = encircled_energy(kernel, radius)
    return fits.BinTableHDU.from_columns(
        [
            fits.Column(name=name, format="D", unit=units.get(name), array=column)
            for name, column in columns.items()
        ],
        name="PROFILE",
    )


def _fitted_hdu(fitted: FittedShape) -> fits.BinTableHDU:
    """Table with one row for each parameter: its name, its fitted coordinate, and its row of the covariance matrix."""
    hdu = fits.BinTableHDU.from_columns(
        [
            fits.Column(name="parameter", format="16A", array=np.array(fitted.parameters)),
            fits.Column(name="coordinate", format="D", array=np.array(fitted.coordinates)),
            fits.Column(
                name="covariance", format=f"{len(fitted.parameters)}D", array=np.array(fitted.covariance)
            ),
        ],
        name="FIT",
    )
    hdu.header["SHAPE"] = (ascii_text(fitted.shape), "formula that SCATTER was fitted with")
    return hdu


def read_psf(path: str | Path, limits: FitsLimits, *, parts: bool = True) -> Psf:
    """Read a PSF from the first 2-D image of a file, and its metadata from the header.

    Weights are not changed. The file must have the centre of the PSF at [ny // 2, nx // 2]. If the card PSFNAME is
    missing, the PSF is named after the file. The provenance has "doi" and "citation", if the file says how to cite the
    PSF.

    The terms of a PSF that changes over the field are always read. Raises HeaderError; DataError "unreadable-pixels",
    "psf-field" and the errors of `Psf` ("psf-not-centred", "psf-sum", ...).

    Parameters
    ----------
    parts
        Whether to read also the components, the instrument description and the fitted shape, if `write_psf` wrote the
        file. A convolution does not need them.
    """
    stored = read_pixels(path, limits)
    kernel, header = stored.pixels, stored.header
    components, provenance, fitted = (
        _read_extras(path, limits, kernel.shape) if parts and "PSFNAME" in header else ({}, {}, None)
    )
    terms, place = _read_field(path, limits, stored.number, optional_number(header, "NFIELD"))
    instrument, cards = origin_of(header)
    publication = {
        key: text
        for key, (card, _) in _PUBLICATION.items()
        if (text := optional_text(header, card)) is not None
    }
    return Psf(
        kernel=kernel,
        name=optional_text(header, "PSFNAME") or Path(path).name.split(".")[0],
        version=optional_text(header, "PSFVERS") or "unversioned",
        instrument=instrument,
        status=optional_text(header, "PSFSTAT") or "user",
        plate_scale_arcsec=plate_scale_arcsec(header),
        wavelength_angstrom=wavelength_angstrom(header),
        components=components,
        provenance={"file": Path(path).name, **publication, **provenance},
        fitted=fitted,
        cards=cards,
        turn_deg=optional_number(header, "PSFTURN") or 0.0,
        field_terms=terms,
        place=place,
    )


def _read_field(
    path: str | Path, limits: FitsLimits, image: int, stated: float | None
) -> tuple[tuple[FieldTerm, ...], Place | None]:
    """The terms of a PSF that changes over the field, and the place of the pixels of the detector.

    Parameters
    ----------
    image
        Number of the HDU of the kernel.
    stated
        The number of terms that the file states; None: it states none.
    """
    hdus = [hdu for hdu in field_hdus(path, limits) if hdu.number != image]
    powers = [tuple(card_count(hdu.header, key) for key in ("XPOWER", "YPOWER")) for hdu in hdus]
    sizes = {tuple(card_count(hdu.header, f"FIELDN{axis}") for axis in "XY") for hdu in hdus}
    problem = (
        f"expected the {stated:.0f} extensions FIELD that the card NFIELD states; got {len(hdus)}"
        if stated is not None and stated != len(hdus)
        else f"expected at most {MOST_TERMS} extensions FIELD, each with other powers; got {powers}"
        if len(set(powers)) < len(powers) or len(powers) > MOST_TERMS
        else f"expected one size of the detector (FIELDNX, FIELDNY) in all extensions FIELD; got {sorted(sizes)}"
        if len(sizes) > 1
        else None
    )
    if problem is not None:
        raise DataError("psf-field", f"{problem}: copy or make the file again")
    terms = tuple(
        FieldTerm(read_pixels(path, limits, hdu=hdu.number).pixels, *power)
        for hdu, power in zip(hdus, powers, strict=True)
    )
    return terms, Place.of_detector(*sizes.pop()) if sizes else None


def stated_id(path: str | Path, limits: FitsLimits) -> str | None:
    """The id that heliopsf gave to the PSF in a file, from its HISTORY; None if HISTORY contains no id.

    Also None if the file was changed after `write_psf` wrote it (CHECKSUM and DATASUM of every HDU are checked), or if
    it was derived from the file of another PSF. Raises HeaderError.
    """
    hdus = all_hdus(path, limits)
    lines = [str(line) for line in hdus[0].header.get("HISTORY", [])]
    stated = [match[1] for line in lines if (match := _STATED.fullmatch(line))]
    # `read_psf` keeps the HISTORY of a file under this name, and `write_psf` writes it into files derived from it.
    if len(stated) != 1 or any(line.startswith("history:") for line in lines):
        return None
    try:
        with open(os.devnull, "wb") as unused:
            good = run_limited(check_written, path, unused, pixels=_pixels(hdus), count=len(hdus))["good"]
    except DataError:  # a damaged file, or one of other software; the job that uses it raises the error
        return None
    return stated[0] if good else None


def check_written(_target: BinaryIO, *, path: str, count: int) -> dict[str, object]:
    """Whether the first HDUs of a file are as `write_psf` wrote them ("good"). Call it in a limited process
    (`psfcore.limited`).
    """
    with readable_pixels(path, "the HDUs"), _first_hdus(path, count) as hdus:
        return {"good": all(map(as_written, hdus))}


def _read_extras(
    path: str | Path, limits: FitsLimits, shape: tuple[int, ...]
) -> tuple[dict[str, NDArray[np.float64]], dict[str, object], FittedShape | None]:
    """Components, provenance and fitted shape of a file that `write_psf` wrote."""
    # Any file can have a card PSFNAME. Therefore the size limits are checked for all HDUs.
    hdus = all_hdus(path, limits)
    with scratch_file() as target:
        extras = run_limited(
            write_extras, path, target, pixels=_pixels(hdus), count=len(hdus), shape=list(shape)
        )
        target.seek(0)
        components = {
            str(name): np.fromfile(target, np.float64, math.prod(shape)).reshape(shape)
            for name in extras["components"]
        }
    fitted = extras["fitted"]
    return components, extras["provenance"], None if fitted is None else _fitted(**fitted)


def write_extras(target: BinaryIO, *, path: str, count: int, shape: list[int]) -> dict[str, object]:
    """Write the components of a PSF to ``target``, float64; returns their names, the provenance and the fitted shape.

    HDUs that `write_psf` never writes are ignored: compressed components, components of another shape, and tables with
    data outside their rows. Call it in a limited process (`psfcore.limited`).
    """
    provenance: dict[str, object] = {}
    extras: dict[str, Any] = {"components": [], "provenance": provenance, "fitted": None}
    with readable_pixels(path, "the extensions"), _first_hdus(path, count) as hdus:
        provenance["history"] = [str(line) for line in hdus[0].header.get("HISTORY", [])]
        for hdu in hdus[1:]:
            if (
                isinstance(hdu, fits.ImageHDU)
                and hdu.shape == tuple(shape)
                and hdu.name != FIELD
                and hdu.name not in extras["components"]
            ):
                extras["components"].append(hdu.name)
                target.write(np.ascontiguousarray(hdu.data, dtype=np.float64).data)
            elif not isinstance(hdu, fits.BinTableHDU) or {"P", "Q"} & set("".join(hdu.columns.formats)):
                continue
            elif hdu.name == "INSTRUMENT":
                toml = np.asarray(hdu.data["TOML"][0], dtype=np.uint8)
                provenance["instrument_toml"] = toml.tobytes().decode("utf-8")
            elif hdu.name == "FIT":
                extras["fitted"] = {"shape": str(hdu.header["SHAPE"])} | {
                    f"{name}s": hdu.data[name].tolist() for name in ("parameter", "coordinate", "covariance")
                }
    return extras


def _fitted(
    shape: str, parameters: list[str], coordinates: list[float], covariances: list[list[float]]
) -> FittedShape:
    rows = np.reshape(covariances, (len(parameters), -1)).tolist()  # of one parameter, a row is a number
    return FittedShape(shape, tuple(parameters), tuple(coordinates), tuple(map(tuple, rows)))


def _pixels(hdus: Sequence[Hdu]) -> int:
    """The number of pixels that the data of HDUs explain, as floats."""
    return sum(hdu.end - hdu.start for hdu in hdus) // 4


@contextmanager
def _first_hdus(path: str, count: int) -> Iterator[list[fits.PrimaryHDU | fits.ImageHDU]]:
    """The first HDUs of a file.

    If a damaged size ends an HDU too early, astropy takes what follows for a header, and may read on without an end.

    Parameters
    ----------
    count
        The number of HDUs that `all_hdus` finds.
    """
    with fits.open(path, memmap=False, disable_image_compression=True) as hdus:
        yield [hdus[number] for number in range(count)]
