"""Results of a deconvolution: as a ``Deconvolution``, or in the form of the user's image."""

from __future__ import annotations

import copy
import hashlib
import re
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

import numpy as np
from astropy import units
from astropy.io import fits
from astropy.io.fits import Header
from astropy.utils.masked import Masked
from numpy.typing import NDArray

from heliopsf.inputs import hdu_of, is_hdu, is_map, is_nddata, is_pair
from heliopsf.psfs import Psf, Shown
from psfcore.deconvolve import forward, run
from psfcore.deconvolve.forward import Convolved
from psfcore.deconvolve.methods.registry import properties_of
from psfcore.deconvolve.run import (
    Cards,
    Identities,
    Product,
    UsedPsf,
    deconvolution_cards,
    deconvolution_history,
)
from psfcore.deconvolve.summary import summary_lines
from psfcore.errors import DataError, module_of_extra
from psfcore.files import check_ending, whole_path
from psfcore.fits.images import CARD_OF_PASS, STATISTICS, passes_of
from psfcore.image import Image

if TYPE_CHECKING:
    from astropy.nddata import NDData, StdDevUncertainty
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

# Cards that are wrong for the result: statistics of the input, and the DOI of an earlier PSF.
_REMOVED = re.compile(rf"{STATISTICS}|PSFDOI", re.IGNORECASE)


class _BeforeAndAfter(Shown):
    """A result with an image before and after."""

    def quicklook(self) -> Figure:
        """Draw the image before and after, and the change.

        Returns
        -------
        Figure
            Three panels.

        Raises
        ------
        MissingExtra
            The extra "plot" is not installed.
        """
        return cast("Figure", module_of_extra("heliopsf.plots").before_and_after(self))


@dataclass(frozen=True, kw_only=True, repr=False)
class Deconvolution(_BeforeAndAfter, Product):
    """A deconvolved image with its inputs, errors and warnings.

    Attributes
    ----------
    pixels : ndarray of float64, shape (ny, nx)
        The deconvolved image [y, x] in the unit of the image. NaN: the image has no finite value there.
    image : Image
        The input with its mask and header; the box of it if a region was deconvolved.
    psf : Psf
        The PSF on the pixels of the image. It has no components if it was built for the telescope in the header.
    errors : ErrorPlanes or None
        Planes with the standard deviation of each pixel. None: not asked for.
    noise : CameraNoise or None
        The noise of the camera. None: errors were not asked for.
    warnings : mapping of str to str
        Sentences by their codes, the most harmful first.
    method : str
        Name of the method, such as "richardson-lucy".
    steps_done : int
        Number of steps.
    stopped_because : str
        Why the iteration ended.
    last_change : float
        Rms of the change in the last step, divided by the rms of the result.
    flux_in : float
        Sum of the valid pixels of the image, in its unit.
    flux_out : float
        Sum of the same pixels of the result.
    negative_pixels : int
        Number of valid pixels below 0 in the image.
    edges : {"zero", "symmetric", "extended", "periodic"}
        Assumption about the scene beyond the field of view.
    margin_px : int
        Width of the margin in which the scene was also estimated, px.
    edge_band_px : int
        Width of the band along the edges in which the result depends on light from beyond the field, px.
    noise_amplification : float or None
        Rms noise of the result divided by that of the image, for uncorrelated noise. None: the method is not linear.
    chi2_per_pixel : float or None
        Chi2 of the fit divided by the number of judged pixels. None: the noise is not known.
    of_box : OfBox or None
        How a region was deconvolved. None: the whole image was deconvolved.
    work : Work or BoxWork
        The computation, from which the measured changes and QUALITY are derived.
    """

    psf: Psf

    @property
    def mask(self) -> NDArray[np.bool_]:
        """Pixels without a measurement, [y, x]: QUALITY 1 or 2 (not finite, masked or saturated)."""
        return np.asarray(self.image.mask != 0)

    @property
    def error(self) -> NDArray[np.float64] | None:
        """Standard deviation of each pixel, [y, x], in the unit of the image; None: not asked for.

        The noise contributes, and the PSF too if its errors are known.
        """
        if self.errors is None or self.errors.psf_error is None:
            return None if self.errors is None else self.errors.error
        return np.hypot(self.errors.error, self.errors.psf_error)

    @property
    def quality(self) -> NDArray[np.uint8]:
        """The plane QUALITY of products (docs/products.md), [y, x]; 0: a good pixel."""
        return self.assessed.quality

    @property
    def changes(self) -> dict[str, Any]:
        """The measured changes: flux, bright and dark structures, and signs of artefacts (JSON)."""
        return self.assessed.changes.as_json()

    def lines(self) -> list[str]:
        """Describe the result in two lines.

        Returns
        -------
        list of str
            Image, PSF and its doubts; then shape, steps, changes and warnings.
        """
        ny, nx = self.pixels.shape
        first, *others = summary_lines(self.details())
        warned = f"; warnings: {', '.join(self.warnings)}" if self.warnings else ""
        return [f"Deconvolution of {first}", f"{nx} x {ny} px, {'; '.join(others)}{warned}"]

    def plot(self, axes: Axes | None = None) -> Axes:
        """Draw the deconvolved image.

        Parameters
        ----------
        axes : Axes, optional
            Where to draw. Default: new axes.

        Returns
        -------
        Axes
            The axes with the image.

        Raises
        ------
        MissingExtra
            The extra "plot" is not installed.
        """
        return cast("Axes", module_of_extra("heliopsf.plots").draw_image(self, axes))

    def plot_change(self, axes: Axes | None = None) -> Axes:
        """Draw the change of each pixel in percent of the input.

        Parameters
        ----------
        axes : Axes, optional
            Where to draw. Default: new axes.

        Returns
        -------
        Axes
            The axes with the change.

        Raises
        ------
        MissingExtra
            The extra "plot" is not installed.
        """
        return cast("Axes", module_of_extra("heliopsf.plots").draw_change(self, axes))

    def write(self, path: str | Path, overwrite: bool = False) -> None:
        """Write the FITS file that ``heliopsf deconvolve`` writes, with planes and HISTORY.

        The file has no id of a product (PRODID) and no hash of its input (INPSHA), which come from a request.

        Parameters
        ----------
        path : str or path
            The file; a name that ends in .gz gets a file in gzip.
        overwrite : bool
            Whether a file of this name is replaced.

        Raises
        ------
        DataError
            "output-exists": there is a file of this name, and ``overwrite`` is false.
        OSError
            The file cannot be written, or its name ends in .fz.
        """
        target = Path(path)
        if target.exists() and not overwrite:
            raise DataError(
                "output-exists",
                f"expected the name of a new file; {target} exists: name another file, or replace it with "
                "overwrite=True",
            )
        check_ending(target)
        ids = Identities(None, None, properties_of(self.method).algorithm_version, target.name)
        with whole_path(target) as file:
            run.write(self, file, used_psf(self.psf), ids)


@dataclass(frozen=True, kw_only=True, repr=False)
class Convolution(_BeforeAndAfter, Convolved):
    """A model image as a telescope records it.

    Attributes
    ----------
    pixels : ndarray of float64, shape (ny, nx)
        The convolved image [y, x] in the unit of the image. NaN: the image has no finite value there.
    image : Image
        The model image with its header.
    psf : Psf
        The PSF on the pixels of the image.
    edges : {"zero", "symmetric"}
        Assumption about the scene beyond the image.
    warnings : mapping of str to str
        Sentences by their codes.
    """

    psf: Psf

    @property
    def mask(self) -> NDArray[np.bool_]:
        """Pixels without a value in the model image, [y, x]."""
        return ~self.image.finite

    @property
    def error(self) -> None:
        """None: a convolved model image has no errors."""

    @property
    def planes(self) -> dict[str, NDArray[np.generic]]:
        """No planes, unlike a ``Deconvolution``."""
        return {}

    def lines(self) -> list[str]:
        """Describe the result in lines.

        Returns
        -------
        list of str
            PSF and edges; then the caveats of the PSF, if it has some; then shape, brightest pixel, and the share of
            the light that stays in the field.
        """
        return forward.lines(self, used_psf(self.psf))

    def write(self, path: str | Path) -> None:
        """Write a FITS file. A file of this name is replaced.

        Parameters
        ----------
        path : str or path
            The file; a name that ends in .gz gets a file in gzip.

        Raises
        ------
        OSError
            The file cannot be written.
        """
        with whole_path(Path(path)) as file:
            forward.write(self, file, used_psf(self.psf))


def in_form_of(image: object, result: Deconvolution | Convolution) -> object:
    """The result in the form of the user's image: a Map for a Map, an HDU for an HDU, an array for an array."""
    if is_map(image):
        return _as_map(image, result)
    if is_nddata(image):
        return _as_nddata(image, result)
    if isinstance(image, fits.HDUList):
        planes = [fits.ImageHDU(_stored(plane), name=name) for name, plane in result.planes.items()]
        return fits.HDUList(
            [fits.PrimaryHDU(result.pixels, _described(hdu_of(image).header, result)), *planes]
        )
    if is_hdu(image):
        kind = fits.PrimaryHDU if isinstance(image, fits.PrimaryHDU) else fits.ImageHDU
        return kind(result.pixels, _described(image.header, result))
    if isinstance(image, str | Path | Image):
        return result
    if is_pair(image):
        return in_form_of(image[0], result), _described(image[1], result)
    pixels = result.pixels
    if isinstance(image, np.ma.MaskedArray):
        return np.ma.MaskedArray(pixels, result.mask)
    if isinstance(image, units.Quantity):
        pixels = pixels * image.unit
    if isinstance(image, Masked):
        return Masked(pixels, result.mask)
    return pixels


def used_psf(psf: Psf) -> UsedPsf:
    """The PSF as the cards of a result name it, with the id that a service would use: the id of its recipe or of its
    file.
    """
    identity = psf.provenance.get("psf_id")
    if identity is None:  # weights in memory
        content = hashlib.sha256(f"{psf.kernel.shape}".encode() + psf.kernel.tobytes())
        for term in psf.field_terms:
            content.update(f"{term.kernel.shape} {term.x_power} {term.y_power} {psf.place}".encode())
            content.update(term.kernel.tobytes())
        identity = content.hexdigest()
    return UsedPsf(str(identity), psf.name, psf.version, psf.status)


def _cards_and_history(result: Deconvolution | Convolution) -> tuple[Cards, list[str]]:
    used = used_psf(result.psf)
    if isinstance(result, Convolution):
        return forward.cards(result, used), forward.history(result, used)
    passes = passes_of(result.image.header) + 1
    own = {CARD_OF_PASS: (passes, "deconvolutions of this image, with this one")}
    return deconvolution_cards(result, used) | own, deconvolution_history(result, used)


def _as_map(image: NDData, result: Deconvolution | Convolution) -> NDData:
    meta = _described(image.meta, result)
    smap = type(image)(result.pixels, meta, mask=_mask(image, result), uncertainty=_uncertainty(result))
    # The settings are set last, because the class of a Map may choose other settings for a new Map.
    smap.plot_settings.update(copy.deepcopy(image.plot_settings))
    return smap


def _as_nddata(image: NDData, result: Deconvolution | Convolution) -> NDData:
    return type(image)(
        result.pixels,
        mask=_mask(image, result),
        uncertainty=_uncertainty(result),
        meta=_described(image.meta, result),
        wcs=image.wcs,
        unit=image.unit,
    )


def _mask(image: NDData, result: Deconvolution | Convolution) -> NDArray[np.bool_] | None:
    return result.mask if image.mask is not None or result.mask.any() else None


def _uncertainty(result: Deconvolution | Convolution) -> StdDevUncertainty | None:
    if result.error is None:
        return None
    from astropy.nddata import StdDevUncertainty

    return StdDevUncertainty(result.error)


def _stored(plane: NDArray[np.generic]) -> NDArray[np.generic]:
    return plane.astype(np.float32) if plane.dtype.kind == "f" else plane


def _described(of_image: Any, result: Deconvolution | Convolution) -> Any:
    """The metadata of the image with the cards and the history of the result."""
    meta = copy.deepcopy(of_image)
    is_header = isinstance(meta, Header)
    for key in [key for key in meta if _REMOVED.fullmatch(str(key))]:
        del meta[key]
    cards, lines = _cards_and_history(result)
    for key, (value, comment) in cards.items():
        meta[key] = (value, comment) if is_header else value
    if is_header:
        for line in lines:
            meta.add_history(line)
    else:
        # sunpy keeps HISTORY as one text with a line for each card.
        before = [str(meta[key]) for key in ("history",) if key in meta]
        meta["history"] = "\n".join([*before, *lines])
    return meta
