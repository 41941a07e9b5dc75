"""FITS in and out: images, products of deconvolution, and point-spread functions.

Pixels cross this border as native float64 [y, x]. Files written hold float32, carry CHECKSUM and DATASUM,
and are the same bytes for the same content: no time of writing enters them.
"""

from __future__ import annotations

import re
import struct
import zlib
from collections.abc import Mapping, Sequence
from enum import IntFlag
from pathlib import Path
from typing import Any

import numpy as np
from astropy.io import fits
from astropy.io.fits.hdu.compressed._compression import CfitsioException
from astropy.io.fits.verify import VerifyError
from numpy.typing import NDArray

from psfcore.errors import DataError
from psfcore.fits.header import (
    FitsLimits,
    HeaderSummary,
    check_all_headers,
    optional_exposure_s,
    optional_number,
    optional_text,
    plate_scale_arcsec,
    read_summary,
)
from psfcore.fits.tiles import check_tiles
from psfcore.image import Image, MaskBit
from psfcore.psf import (
    FittedShape,
    Psf,
    cumulative_curve,
    encircled_energy,
    radial_profile,
)

CardValue = str | int | float | bool
Cards = Mapping[str, tuple[CardValue, str]]

_CHECKSUM_COMMENT = "computed when the file was written"
_SATURATION_KEYS = ("SATURATE", "DATASAT")
_TABLE_FORMAT = {np.dtype(np.uint8): "B", np.dtype(np.uint16): "I", np.dtype(np.float32): "E"}
_BITS_STORED = {1: np.uint8, 2: np.uint16}
_FULL_SCALES = tuple(2**bits - 1 for bits in (8, 10, 12, 14, 15, 16))
# Cards that describe how the input's pixels were stored, or figures of pixels that are no longer these.
_STORAGE_CARD = re.compile(
    r"SIMPLE|XTENSION|BITPIX|NAXIS\d*|PCOUNT|GCOUNT|EXTEND|GROUPS|INHERIT|EXTNAME|EXTVER|EXTLEVEL|END|"
    r"BSCALE|BZERO|BLANK|CHECKSUM|DATASUM|ZHECKSUM|ZDATASUM|"
    r"TFIELDS|THEAP|T(TYPE|FORM|UNIT|NULL|SCAL|ZERO|DISP|DIM)\d+|"
    r"ZIMAGE|ZSIMPLE|ZEXTEND|ZTENSION|ZBITPIX|ZNAXIS\d*|ZPCOUNT|ZGCOUNT|ZTILE\d+|ZCMPTYPE|ZNAME\d+|ZVAL\d+|"
    r"ZQUANTIZ|ZDITHER0|ZBLANK|ZSCALE|ZZERO|ZMASKCMP|ZBLOCKED|"
    r"DATAMIN|DATAMAX|DATAMEAN|DATAMEDN|DATARMS|DATASTD|DATASKEW|DATAKURT|DATACENT|DATAP\d\d"
)
# What opening or decompressing a damaged data unit raises, depending on where the damage is.
_PIXEL_TROUBLE = (
    CfitsioException,  # what RICE decoding raises; astropy has no public name for it
    VerifyError,
    OSError,
    EOFError,
    ValueError,
    TypeError,
    LookupError,
    AttributeError,
    ArithmeticError,
    RuntimeError,
    struct.error,
    zlib.error,
)
_CARD_TROUBLE = (VerifyError, ValueError, TypeError, IndexError, OverflowError)


# --- images -----------------------------------------------------------------------------------------------


def read_image(path: str | Path, limits: FitsLimits, *, saturation_dn: float | None = None) -> Image:
    """The first 2-D image of a file, with its mask.

    saturation_dn: level in DN from which a pixel counts as saturated, besides the header's SATURATE or
    DATASAT (in the image's own unit); divided by the exposure where the unit is DN/s.
    Raises HeaderError for what headers show, DataError: "unreadable-pixels", "tile-too-large", "no-exposure",
    "all-nan", "all-saturated", "no-signal", "too-small".
    """
    summary = read_summary(path, limits)
    pixels, header = _read_pixels(path, summary)
    unit, exposure_s = optional_text(header, "BUNIT"), optional_exposure_s(header)
    level = _saturation_level(header, unit, exposure_s, saturation_dn)
    mask = np.where(np.isfinite(pixels), 0, int(MaskBit.NONFINITE)).astype(np.uint8)
    if level is not None:
        mask[pixels >= level] |= int(MaskBit.SATURATED)  # False for NaN
    image = Image(pixels=pixels, mask=mask, header=header, unit=unit, exposure_s=exposure_s)
    _check_signal(image, stored_as_integer=summary.bitpix > 0)
    return image


def read_plane(path: str | Path, limits: FitsLimits) -> NDArray[np.float64]:
    """Pixels [y, x] of the first 2-D image of a file, whatever they mean; raises as read_image does for files."""
    return _read_pixels(path, read_summary(path, limits))[0]


def _read_pixels(path: str | Path, summary: HeaderSummary) -> tuple[NDArray[np.float64], fits.Header]:
    try:
        if summary.codec is not None:
            _check_tiles(path, summary)
        # uint=False: astropy would turn unsigned integers (BZERO 32768) before it looks for BLANK.
        with fits.open(path, mode="readonly", memmap=False, lazy_load_hdus=True, uint=False) as hdus:
            hdu = hdus[summary.hdu]
            header = hdu.header.copy()
            data = hdu.data
            pixels = np.array(data, dtype=np.float64)
    except DataError:
        raise
    except _PIXEL_TROUBLE as error:
        _raise_if_storage(error)
        message = f"expected pixels in HDU {summary.hdu} of {Path(path).name}; got: {error!s:.120}"
        raise DataError("unreadable-pixels", message) from None
    if pixels.shape != summary.shape:
        message = f"expected {summary.shape} pixels as the header declares; got {pixels.shape}"
        raise DataError("unreadable-pixels", message)
    return pixels, header


class _TableHeap:
    def __init__(self, hdu: fits.BinTableHDU) -> None:
        place = hdu.fileinfo()
        self._file = place["file"]
        rows_bytes = hdu.header["NAXIS1"] * hdu.header["NAXIS2"]
        self._first = place["datLoc"] + int(hdu.header.get("THEAP", rows_bytes))

    def read(self, offset: int, count: int) -> bytes:
        self._file.seek(self._first + offset)
        return bytes(self._file.read(count))


def _check_tiles(path: str | Path, summary: HeaderSummary) -> None:
    """Raise DataError "tile-too-large" where a tile unfolds to more than it may."""
    with fits.open(path, memmap=False, lazy_load_hdus=True, disable_image_compression=True) as hdus:
        table = hdus[summary.hdu]
        tile_pixels = int(table.header.get("ZTILE1", summary.shape[1])) * int(table.header.get("ZTILE2", 1))
        formats = {column.name: column.format for column in table.columns}
        rows = np.asarray(table.data).view(np.ndarray)
        assert summary.codec is not None
        check_tiles(rows, formats, _TableHeap(table), summary.codec, tile_pixels)


def _raise_if_storage(error: Exception) -> None:
    """Pass on what the operating system reports of a disk: it is no fault of the file's."""
    if isinstance(error, OSError) and error.errno is not None:
        raise error


def _saturation_level(
    header: fits.Header, unit: str | None, exposure_s: float | None, saturation_dn: float | None
) -> float | None:
    """Lowest saturated value in the image's own unit, or None where no level is known."""
    levels = [optional_number(header, key) for key in _SATURATION_KEYS]
    if saturation_dn is not None:
        if (unit or "").replace(" ", "").lower() != "dn/s":
            levels.append(saturation_dn)
        elif exposure_s is not None:
            levels.append(saturation_dn / exposure_s)
        else:
            message = (
                "expected XPOSURE or EXPTIME, to compare DN/s with a saturation level in DN; got neither"
            )
            raise DataError("no-exposure", message)
    known = [level for level in levels if level is not None and level > 0]
    return min(known, default=None)


def _check_signal(image: Image, *, stored_as_integer: bool) -> None:
    valid = image.pixels[image.valid]
    if valid.size == 0:
        finite = (image.mask & MaskBit.NONFINITE) == 0
        if not finite.any():
            raise DataError("all-nan", "expected finite pixels; got only NaN, infinite or BLANK")
        level = image.pixels[finite].min()
        raise DataError("all-saturated", f"expected pixels below saturation; all are at {level:g} or above")
    smallest, largest = float(valid.min()), float(valid.max())
    if largest <= 0:
        raise DataError("no-signal", f"expected pixels above zero; the largest is {largest:g}")
    if smallest == largest and stored_as_integer and largest in _FULL_SCALES:
        message = f"expected pixels below saturation; all are {largest:g}, a converter's full scale"
        raise DataError("all-saturated", message)


def write_image(
    path: str | Path,
    image: Image,
    *,
    cards: Cards,
    history: Sequence[str] = (),
    mask: NDArray[np.uint8] | None = None,
    planes: Mapping[str, NDArray[Any]] | None = None,
    plane_bits: Mapping[str, type[IntFlag]] | None = None,
) -> None:
    """Write a product: float32 pixels under the input's header and WCS, `cards`, `history`, mask and planes.

    mask: plane [y, x] to store instead of image.mask. Storage cards of the input are dropped and DATAMIN,
    DATAMAX and DATAMEAN are computed anew (median, rms and percentiles are dropped).
    planes: further planes [y, x] by name (ERROR, PSF_ERROR, QUALITY): bits are kept as uint8 or uint16,
    numbers as float32 in the image's unit. plane_bits: what the bits of a plane mean.
    Raises DataError "bad-plane" for another shape, type or a name that is taken.
    """
    header = _kept_header(image.header)
    pixels = image.pixels.astype(np.float32)
    finite = pixels[np.isfinite(pixels)]
    if finite.size:
        header["DATAMIN"] = (float(finite.min()), "smallest finite pixel")
        header["DATAMAX"] = (float(finite.max()), "largest finite pixel")
        header["DATAMEAN"] = (float(finite.mean(dtype=np.float64)), "mean of finite pixels")
    for key, (value, comment) in cards.items():
        header[key] = (_ascii(value) if isinstance(value, str) else value, _ascii(comment))
    for line in history:
        header.add_history(_ascii(line))
    plane = image.mask if mask is None else np.ascontiguousarray(mask, dtype=np.uint8)
    hdus = [fits.PrimaryHDU(pixels, header), _plane_hdu("MASK", plane, bits=MaskBit, bit_key="MBIT")]
    for name, extra in (planes or {}).items():
        _check_plane(name, extra, pixels.shape, taken=[hdu.name for hdu in hdus])
        hdus.append(_plane_hdu(name, extra, unit=image.unit, bits=(plane_bits or {}).get(name)))
    _write(path, hdus)


def write_plane(path: str | Path, pixels: NDArray[Any], *, cards: Cards) -> None:
    """Write pixels [y, x] and `cards`, nothing else: integers as int32, numbers as float32."""
    header = fits.Header()
    for key, (value, comment) in cards.items():
        header[key] = (_ascii(value) if isinstance(value, str) else value, _ascii(comment))
    stored = pixels.astype(np.int32 if pixels.dtype.kind in "iu" else np.float32)
    _write(path, [fits.PrimaryHDU(stored, header)])


def read_planes(path: str | Path) -> dict[str, NDArray[Any]]:
    """The planes [y, x] of a product by name, the mask not among them; floats are float32."""
    planes: dict[str, NDArray[Any]] = {}
    with fits.open(path, memmap=False) as hdus:
        for hdu in hdus[1:]:
            if isinstance(hdu, fits.BinTableHDU) and hdu.header.get("PLANE") is True:
                data = np.asarray(hdu.data[hdu.name][0])
                planes[hdu.name] = data.astype(data.dtype.newbyteorder("="))
    return planes


def read_mask(path: str | Path) -> NDArray[np.uint8] | None:
    """The mask plane [y, x] of a product, or None where the file has none."""
    with fits.open(path, memmap=False) as hdus:
        if "MASK" not in hdus:
            return None
        return np.array(hdus["MASK"].data["MASK"][0], dtype=np.uint8)


def _plane_hdu(
    name: str,
    plane: NDArray[Any],
    *,
    unit: str | None = None,
    bits: type[IntFlag] | None = None,
    bit_key: str = "QBIT",
) -> fits.BinTableHDU:
    # sunpy.map.Map makes a map of every HDU whose data has two axes or more, so an image extension would
    # turn the product into a list of maps. A table of one row has one axis to it, and TDIM keeps the shape.
    ny, nx = plane.shape
    is_bits = plane.dtype.kind in "ub"
    stored = plane.astype(_BITS_STORED.get(plane.dtype.itemsize, np.uint16) if is_bits else np.float32)
    column = fits.Column(
        name=name,
        format=f"{plane.size}{_TABLE_FORMAT[stored.dtype]}",
        dim=f"({nx},{ny})",
        unit=None if is_bits or unit is None else _ascii(unit),
        bzero=2**15 if stored.dtype == np.uint16 else None,
        array=stored[None],
    )
    hdu = fits.BinTableHDU.from_columns([column], name=name)
    if name != "MASK":
        hdu.header["PLANE"] = (True, "one value a pixel of the image")
    for bit in bits or ():
        hdu.header[f"{bit_key}{bit.bit_length() - 1}"] = (bit.name or "", f"meaning of value {int(bit)}")
    return hdu


def _check_plane(name: str, plane: NDArray[Any], shape: tuple[int, ...], *, taken: Sequence[str]) -> None:
    if not re.fullmatch(r"[A-Z][A-Z0-9_]{0,31}", name) or name in taken:
        message = f"expected a name in capitals that is not one of {', '.join(taken)}; got {name!r:.40}"
        raise DataError("bad-plane", message)
    if plane.shape != shape:
        raise DataError("bad-plane", f"expected {name} to have {shape} pixels; got {plane.shape}")
    if plane.dtype.kind not in "ubf" or (plane.dtype.kind == "u" and plane.dtype.itemsize > 2):
        raise DataError("bad-plane", f"expected {name} as floats, uint8 or uint16; got {plane.dtype}")


def _kept_header(source: fits.Header) -> fits.Header:
    """All cards but storage ones, in order; a card that cannot be read is kept as HISTORY text."""
    kept = fits.Header()
    for card in source.cards:
        if _STORAGE_CARD.fullmatch(card.keyword):
            continue
        readable = _readable(card)
        if readable is None:
            kept.add_history("card kept as text: " + _ascii(card.image.rstrip()))
        else:
            kept.append(readable, end=True)
    return kept


def _readable(card: fits.Card) -> fits.Card | None:
    """A copy that can be written: a value FITS does not know (NaN, "1 2 3") becomes a string."""
    try:
        value = _card_value(card)
        copy = fits.Card(
            card.keyword, _ascii(value) if isinstance(value, str) else value, _ascii(card.comment)
        )
        copy.verify("silentfix")
        fits.Card.fromstring(copy.image)
    except _CARD_TROUBLE:
        return None
    return copy


def _card_value(card: fits.Card) -> Any:
    try:
        value = card.value
    except VerifyError:
        value = fits.Card.fromstring(card.image).value  # making the image puts the value in quotes
    not_a_number = isinstance(value, (float, complex)) and not np.isfinite(value)
    return str(value) if not_a_number else value


def _ascii(text: str) -> str:
    """FITS allows printable ASCII only; anything else becomes '?', line ends become spaces."""
    return "".join(c if " " <= c <= "~" else " " if c.isspace() else "?" for c in text)


def _write(path: str | Path, hdus: list[Any]) -> None:
    hdus[0].header["EXTEND"] = True
    for hdu in hdus:
        hdu.verify("silentfix")
        hdu.add_checksum(when=_CHECKSUM_COMMENT)
    # An open file, because astropy would compress by the name's ending.
    with Path(path).open("wb") as file:
        fits.HDUList(hdus).writeto(file, output_verify="silentfix")


# --- point-spread functions -------------------------------------------------------------------------------


def write_psf(path: str | Path, psf: Psf, *, instrument_file: bytes | None = None) -> None:
    """Write a PSF: primary HDU the kernel, an image HDU a component, tables PROFILE and INSTRUMENT.

    Weights are float32: their rounding, 6e-8 of each, moves the sum by less than 1e-7.
    instrument_file: the TOML text that the PSF was built from, kept word for word.
    """
    hdus: list[Any] = [fits.PrimaryHDU(psf.kernel.astype(np.float32), _psf_header(psf))]
    for name, kernel in psf.components.items():
        component = fits.ImageHDU(kernel.astype(np.float32), name=_ascii(name).upper())
        component.header["PSFSUM"] = (float(kernel.sum()), "sum of weights on this array")
        hdus.append(component)
    hdus.append(_profile_hdu(psf))
    if psf.fitted is not None:
        hdus.append(_fitted_hdu(psf.fitted))
    if instrument_file is not None:
        hdus.append(_instrument_hdu(instrument_file))
    _write(path, hdus)


def _psf_header(psf: Psf) -> fits.Header:
    header = fits.Header()
    header["PSFNAME"] = (_ascii(psf.name), "name of this point-spread function")
    header["PSFVERS"] = (_ascii(psf.version), "its version")
    header["PSFSTAT"] = (_ascii(psf.status), "draft or released")
    header["PSFSUM"] = (psf.total, "sum of weights on this array")
    header["REACH"] = (psf.reach_px, "[pixel] farthest pixel from the centre")
    if psf.instrument is not None:
        header["INSTRUME"] = (_ascii(psf.instrument), "instrument description")
    if psf.wavelength_angstrom is not None:
        header["WAVELNTH"] = (psf.wavelength_angstrom, "[Angstrom] wavelength")
    for axis, size in ((1, psf.kernel.shape[1]), (2, psf.kernel.shape[0])):
        header[f"CRPIX{axis}"] = (size // 2 + 1.0, "[pixel] centre, counted from 1")
        if psf.plate_scale_arcsec is not None:
            header[f"CDELT{axis}"] = (psf.plate_scale_arcsec, "[arcsec] pixel scale")
            header[f"CUNIT{axis}"] = "arcsec"
    for key, value in psf.provenance.items():
        if key != "instrument_toml":
            header.add_history(_ascii(f"{key}: {value}"))
    return header


def _profile_hdu(psf: Psf) -> fits.BinTableHDU:
    """Mean weight by radius and light within it, of the total and of each component under its name."""
    radius, weight = radial_profile(psf.kernel)
    columns = [
        fits.Column(name="radius_px", format="D", unit="pixel", array=radius),
        fits.Column(name="mean_weight", format="D", array=weight),
        fits.Column(name="encircled", format="D", array=encircled_energy(psf.kernel, radius)),
        fits.Column(name="cumulative_pct", format="D", unit="%", array=cumulative_curve(psf.kernel, radius)),
    ]
    for name, kernel in psf.components.items():
        if kernel.shape == psf.kernel.shape:
            label = _ascii(name).lower()
            profile, within = radial_profile(kernel)[1], encircled_energy(kernel, radius)
            columns.append(fits.Column(name=f"{label}_mean_weight", format="D", array=profile))
            columns.append(fits.Column(name=f"{label}_encircled", format="D", array=within))
    return fits.BinTableHDU.from_columns(columns, name="PROFILE")


def _fitted_hdu(fitted: FittedShape) -> fits.BinTableHDU:
    """One row a parameter: its name, coordinate, and row of the coordinates' covariance."""
    count = len(fitted.parameters)
    columns = [
        fits.Column(name="parameter", format="16A", array=np.array(fitted.parameters)),
        fits.Column(name="coordinate", format="D", array=np.array(fitted.coordinates)),
        fits.Column(name="covariance", format=f"{count}D", array=np.array(fitted.covariance)),
    ]
    hdu = fits.BinTableHDU.from_columns(columns, name="FIT")
    hdu.header["SHAPE"] = (_ascii(fitted.shape), "formula that SCATTER was fitted with")
    return hdu


def _read_fitted(hdu: fits.BinTableHDU) -> FittedShape:
    table = hdu.data
    return FittedShape(
        shape=str(hdu.header["SHAPE"]),
        parameters=tuple(str(name) for name in table["parameter"]),
        coordinates=tuple(float(value) for value in table["coordinate"]),
        covariance=tuple(
            tuple(float(value) for value in row)
            for row in np.atleast_2d(table["covariance"]).reshape(len(table), -1)
        ),
    )


def _instrument_hdu(text: bytes) -> fits.BinTableHDU:
    values = np.frombuffer(text, dtype=np.uint8)[None]
    column = fits.Column(name="TOML", format=f"{values.size}B", array=values)
    return fits.BinTableHDU.from_columns([column], name="INSTRUMENT")


def read_psf(path: str | Path, limits: FitsLimits, *, parts: bool = True) -> Psf:
    """A PSF from the first 2-D image of a file; metadata from its cards, or the file's stem as its name.

    Weights are taken as they are, centre at [n // 2, n // 2]. parts: also read the components and the
    instrument's text of a file that write_psf wrote; a convolution needs neither. Raises HeaderError, DataError
    "unreadable-pixels", and what Psf checks ("psf-not-centred", "psf-sum", ...).
    """
    summary = read_summary(path, limits)
    kernel, header = _read_pixels(path, summary)
    own = "PSFNAME" in header
    components, provenance, fitted = (
        _read_extras(path, limits, kernel.shape) if own and parts else ({}, {}, None)
    )
    return Psf(
        kernel=kernel,
        name=optional_text(header, "PSFNAME") or Path(path).name.split(".")[0],
        version=optional_text(header, "PSFVERS") or "unversioned",
        instrument=optional_text(header, "INSTRUME") if own else summary.instrument,
        status=optional_text(header, "PSFSTAT") or "user",
        plate_scale_arcsec=plate_scale_arcsec(header),
        wavelength_angstrom=summary.wavelnth,
        components=components,
        provenance={"file": Path(path).name, **provenance},
        fitted=fitted,
    )


def _read_extras(
    path: str | Path, limits: FitsLimits, shape: tuple[int, ...]
) -> tuple[dict[str, NDArray[np.float64]], dict[str, Any], FittedShape | None]:
    """Components, the instrument's text and the fitted shape of a file that write_psf wrote."""
    fitted: FittedShape | None = None
    components: dict[str, NDArray[np.float64]] = {}
    provenance: dict[str, Any] = {}
    # Anybody may write PSFNAME into a header: what stands behind the kernel is bounded like all else, and what
    # write_psf never writes (compressed components, other shapes) is left alone.
    check_all_headers(path, limits)
    try:
        with fits.open(path, memmap=False, disable_image_compression=True) as hdus:
            provenance["history"] = [str(line) for line in hdus[0].header.get("HISTORY", [])]
            for hdu in hdus[1:]:
                if isinstance(hdu, fits.ImageHDU) and hdu.shape == shape:
                    components[hdu.name] = np.array(hdu.data, dtype=np.float64)
                elif hdu.name == "INSTRUMENT":
                    text = np.asarray(hdu.data["TOML"][0], dtype=np.uint8).tobytes()
                    provenance["instrument_toml"] = text.decode("utf-8")
                elif hdu.name == "FIT":
                    fitted = _read_fitted(hdu)
    except _PIXEL_TROUBLE as error:
        message = f"expected readable extensions in {Path(path).name}; got: {error!s:.120}"
        raise DataError("unreadable-pixels", message) from None
    return components, provenance, fitted
