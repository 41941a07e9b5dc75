"""Build, read, find and interpolate PSFs in this process."""

from __future__ import annotations

import base64
from dataclasses import fields, replace
from datetime import datetime
from html import escape
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeAlias, cast

import numpy as np
from astropy import units

from heliopsf.parameters import Progress, Steps, radii_px, reporter, whole
from psfcore.deconvolve.run import BUILDING
from psfcore.errors import DataError, MissingExtra, did_you_mean, module_of_extra
from psfcore.files import check_ending, sha256_of, whole_path
from psfcore.fits import psfs
from psfcore.fits.blocks import LIMITS
from psfcore.fits.header import utc_time
from psfcore.fits.images import read_mask_image
from psfcore.instruments.files import instrument_names, instrument_path, turned_text
from psfcore.instruments.model import Instrument, load_instrument, read_instrument_text
from psfcore.instruments.psf_statements import caveats, title
from psfcore.instruments.published import PUBLISHED
from psfcore.psf import Psf as CorePsf
from psfcore.psf import cumulative_curve
from psfcore.psf_cache import kept_psf
from psfcore.psf_sampling import rebinned
from psfcore.published_psfs import kept_file
from psfcore.recipe import Recipe
from psfcore.scatter.interpolation import Epoch, interpolated_psf
from workers.machine import cores, psf_cache, published_folder

if TYPE_CHECKING:
    from astropy.time import Time
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure
    from numpy.typing import ArrayLike, NDArray

AnyPsf: TypeAlias = "str | Path | CorePsf | NDArray[np.floating]"


class Shown:
    """A result that shows itself at a prompt and in a notebook: two lines, and its picture."""

    def lines(self) -> list[str]:
        """Describe the result in two lines."""
        raise NotImplementedError

    def quicklook(self) -> Figure:
        """Draw the result. Needs the extra "plot"."""
        raise NotImplementedError

    def __repr__(self) -> str:
        return "\n".join(self.lines())

    def _repr_html_(self) -> str:
        text = "<br>".join(map(escape, self.lines()))
        try:
            png: bytes = module_of_extra("psfcore.drawing.plots").png_of(self.quicklook())
        except MissingExtra as missing:
            return f"<p>{text}<br>{escape(str(missing))}</p>"
        data = base64.b64encode(png).decode("ascii")
        return f'<p>{text}</p><img style="max-width: 100%" alt="" src="data:image/png;base64,{data}">'


class Psf(Shown, CorePsf):
    """The weights of a PSF, and how they were obtained.

    A weight is the share of a point source's light that a pixel receives. The weights sum to 1 over 2048 x 2048 px
    around the centre, and to less on a smaller array.

    Parameters
    ----------
    kernel : ndarray of float64, shape (ny, nx)
        The weights [y, x]. The centre is the pixel [ny // 2, nx // 2].
    name, version : str
        Name and version of the PSF.
    instrument : str or None
        Name of the instrument, such as "hri_euv". None: unknown.
    status : str
        Status of the version, such as "draft", or "user" for weights in memory.
    plate_scale_arcsec : float, optional
        Plate scale, arcsec/px.
    wavelength_angstrom : float, optional
        Wavelength, angstrom.
    components : dict of str to ndarray, optional
        Weights of the components with the same centre, such as "DIFFRACTION" and "SCATTER".
    provenance : dict, optional
        How the PSF was made, as texts and numbers for JSON.
    fitted : FittedShape, optional
        The fitted formula of "SCATTER", with its covariance.
    cards : mapping of str to str, optional
        Texts of the cards TELESCOP, INSTRUME, DETECTOR and FILTER: the images for which the PSF is valid.
    turn_deg : float, optional
        Angle from the +x axis of the detector to that of the kernel, degrees.
    field_terms : tuple of psfcore.psf_field.FieldTerm, optional
        The terms of a PSF that changes over the field; the kernel is then that of the centre of the detector.
    place : psfcore.psf_field.Place, optional
        Where the pixels lie on the detector; required if there are terms.

    Raises
    ------
    DataError
        "psf-not-2d", "psf-too-small", "psf-nonfinite", "psf-negative", "psf-sum", "psf-not-centred",
        "psf-off-centre" or "psf-field".
    """

    def light_beyond(self, radii: ArrayLike | units.Quantity) -> NDArray[np.generic]:
        """Measure the light beyond radii: 1 - encircled energy.

        Parameters
        ----------
        radii : array_like or Quantity
            Radii, px. A quantity may be in px or, if the plate scale is known, an angle.

        Returns
        -------
        ndarray of float64
            Light beyond each radius, percent of all light.

        Raises
        ------
        DataError
            "bad-quantity", or "bad-radius" for a negative radius and one that is not finite.
        """
        return cumulative_curve(self.kernel, radii_px(radii, self.plate_scale_arcsec))

    def rebinned(self, factor: int) -> Psf:
        """Derive the PSF for binned pixels.

        Parameters
        ----------
        factor : int
            A new pixel is the mean of factor x factor pixels.

        Returns
        -------
        Psf
            The PSF on the new pixels.

        Raises
        ------
        DataError
            "bad-binning".
        """
        return Psf.of(rebinned(self, whole("factor", factor, "bad-binning")))

    def write(self, path: str | Path) -> None:
        """Write the PSF and its components to a FITS file, which every function and command reads.

        Parameters
        ----------
        path : str or path
            The file. If its name ends in .gz, it is written in gzip.

        Raises
        ------
        OSError
            The file cannot be written, or its name ends in .fz.
        """
        toml = self.provenance.get("instrument_toml")
        check_ending(Path(path))
        with whole_path(Path(path)) as partial:
            psfs.write_psf(partial, self, instrument_file=None if toml is None else str(toml).encode())

    def plot(self, axes: Axes | None = None, *, size: int = 129) -> Axes:
        """Draw the centre of the PSF on a logarithmic scale.

        Parameters
        ----------
        axes : Axes, optional
            Where to draw. Default: new axes.
        size : int, optional
            Width and height of the central part, px.

        Returns
        -------
        Axes
            The axes with the weights.

        Raises
        ------
        MissingExtra
            The extra "plot" is not installed.
        """
        return cast("Axes", module_of_extra("heliopsf.plots").draw_psf(self, axes, size=size))

    def plot_curve(self, axes: Axes | None = None) -> Axes:
        """Draw 1 - encircled energy by radius, of the PSF and of its components.

        Parameters
        ----------
        axes : Axes, optional
            Where to draw. Default: new axes.

        Returns
        -------
        Axes
            The axes with the curves.

        Raises
        ------
        MissingExtra
            The extra "plot" is not installed.
        """
        return cast("Axes", module_of_extra("heliopsf.plots").draw_curves(self, axes))

    def quicklook(self) -> Figure:
        """Draw the centre, the mean weight by radius and the light beyond a radius.

        Returns
        -------
        Figure
            Three panels.

        Raises
        ------
        MissingExtra
            The extra "plot" is not installed.
        """
        return cast("Figure", module_of_extra("psfcore.drawing.plots").psf_figure(self))

    def lines(self) -> list[str]:
        """Describe the PSF in two lines.

        Returns
        -------
        list of str
            Which PSF it is; then its shape, where its light is, its components, what is assumed in it, and the
            scattered light that it leaves in an image.
        """
        origin = [self.instrument or "instrument unknown"]
        origin += [f"{self.wavelength_angstrom:g} angstrom"] if self.wavelength_angstrom else []
        origin += [f"{self.plate_scale_arcsec:.4g} arcsec/px"] if self.plate_scale_arcsec else []
        radii = [radius for radius in (1, 10, 100) if radius < self.reach_px]
        beyond = ", ".join(
            f"{pct:.3g} % beyond {radius} px"
            for radius, pct in zip(radii, self.light_beyond(radii), strict=True)
        )
        ny, nx = self.kernel.shape
        return [
            f"{title(self.name, self.version, self.status)}: {', '.join(origin)}",
            "; ".join(
                (
                    f"{nx} x {ny} px, central pixel {self.kernel.max():.3g}, {beyond}",
                    f"components: {', '.join(self.components).lower() or 'none'}",
                    *caveats(self.name, self.instrument, self.provenance),
                )
            ),
        ]

    @classmethod
    def of(cls, psf: CorePsf) -> Psf:
        """Give a PSF of ``psfcore`` the methods of this class.

        Parameters
        ----------
        psf : psfcore.psf.Psf
            Any PSF.

        Returns
        -------
        Psf
            A PSF with the same fields.
        """
        return cls(**{field.name: getattr(psf, field.name) for field in fields(CorePsf)})


def build_psf(
    instrument: str | Path,
    *,
    size: int = 2048,
    component: str | None = None,
    threads: int | None = None,
    progress: Progress = None,
) -> Psf:
    """Build the PSF of an instrument.

    The PSF is kept in the user's cache folder (``heliopsf cache``); the next call reads it there.

    Parameters
    ----------
    instrument : str or path
        The name of a known instrument, such as "hri_euv", or an instrument file (TOML). If the file names a mask
        image of the mount, that image is read too.
    size : int, optional
        Width and height, px: an even number from 64 to 4096.
    component : str, optional
        Build only this component, such as "DIFFRACTION".
    threads : int, optional
        Number of threads. Default: all cores.
    progress : bool or function, optional
        True: show a line. A function: it is called with (step, steps).

    Returns
    -------
    Psf
        With its ``kernel`` [y, x] of (size, size) px and its ``components``.

    Raises
    ------
    DataError
        "unknown-instrument", "bad-size", "unknown-component" or "bad-mount", and the errors of
        ``psfcore.instruments.model.load_instrument``.
    """
    return built_psf(
        instrument,
        size=whole("size", size, "bad-size", units.pix),
        component=component,
        threads=threads,
        progress=reporter(progress, BUILDING),
    )


def given_psf(psf: object, *, threads: int, progress: Steps | None) -> Psf:
    """The PSF that a user gives: a PSF, a file, the name or the file of an instrument, the name of a published PSF, or
    weights.

    Raises ``DataError`` "bad-input", "no-such-file", and the errors of reading and building.
    """
    if isinstance(psf, CorePsf):
        return psf if isinstance(psf, Psf) else Psf.of(psf)
    if isinstance(psf, str | Path):
        if instrument_named(psf) is not None:
            return built_psf(psf, parts=False, threads=threads, progress=progress)
        if str(psf) in PUBLISHED and not Path(psf).exists():
            return read_psf(kept_file(published_folder(), str(psf)))
        return read_psf(psf)
    weights = getattr(psf, "data", None) if hasattr(psf, "uncertainty") else psf
    try:
        kernel = np.asarray(weights, np.float64)
        if not isinstance(weights, np.ndarray):
            raise TypeError
    except (TypeError, ValueError):
        expected = "a Psf, a FITS file, an instrument (its name or file), or an array"
        raise DataError("bad-input", f"psf: expected {expected}; got {type(psf).__name__}") from None
    return Psf(kernel=kernel, name="array", version="unversioned", instrument=None, status="user")


def instrument_named(psf: object) -> Instrument | None:
    """The instrument whose name or file (TOML) a user gives as the PSF; None for other PSFs.

    Raises ``DataError`` of ``psfcore.instruments.model.load_instrument``.
    """
    if not isinstance(psf, str | Path):
        return None
    named = str(psf) in instrument_names() and not Path(psf).exists()
    return load_instrument(psf) if named or str(psf).endswith(".toml") else None


def existing_file(path: str | Path) -> Path:
    """The path of a file. Raises ``DataError`` "no-such-file", which names the instrument that may be meant."""
    if Path(path).is_file():
        return Path(path)
    what = "it is a folder" if Path(path).is_dir() else "there is none"
    meant = did_you_mean(str(path), [*instrument_names(), *PUBLISHED])
    raise DataError("no-such-file", f"expected a FITS file; got {str(path)!r:.200}, and {what}{meant}")


def built_psf(
    instrument: str | Path,
    *,
    size: int = 2048,
    component: str | None = None,
    turn_deg: float = 0.0,
    parts: bool = True,
    threads: int | None = None,
    progress: Steps | None = None,
) -> Psf:
    """The PSF of an instrument, as ``build_psf`` builds it.

    Parameters
    ----------
    turn_deg
        Angle by which the images are turned against the detector of a known instrument.
    parts
        Whether the PSF has its components, which a deconvolution does not need.
    """
    if not isinstance(instrument, str | Path):
        names = ", ".join(instrument_names())
        raise DataError(
            "unknown-instrument",
            f"expected the name of an instrument ({names}) or its file; got {instrument!r:.80}",
        )
    description = load_instrument(instrument)
    own = isinstance(instrument, Path) or instrument.endswith(".toml")
    text = (
        turned_text(str(instrument), turn_deg)
        if turn_deg
        else read_instrument_text(Path(instrument) if own else instrument_path(str(instrument)))
    )
    mask, mask_id = None, None
    if description.mount is not None and description.mount.mask_image is not None:
        file = Path(instrument).parent / description.mount.mask_image.file
        mask, mask_id = read_mask_image(file), sha256_of(file)
    recipe = Recipe(
        text=text,
        name=None if own or turn_deg else str(instrument),
        mask_id=mask_id,
        size=size,
        component=None if component is None else component.lower(),
    )
    return Psf.of(
        kept_psf(
            psf_cache(),
            recipe,
            LIMITS,
            parts=parts,
            mount_image=mask,
            threads=threads or cores(),
            progress=progress,
        )
    )


def read_psf(path: str | Path) -> Psf:
    """Read a PSF from a FITS file.

    Parameters
    ----------
    path : str or path
        The file.

    Returns
    -------
    Psf
        With its ``kernel`` [y, x], and its ``components`` if the file has any.

    Raises
    ------
    DataError
        "no-such-file", "not-fits" or another error of the file, and the errors of `Psf`.

    Notes
    -----
    The weights sum to 1 over the reach, and to less on a smaller array.
    """
    path = existing_file(path)
    psf = Psf.of(psfs.read_psf(path, LIMITS))
    # The id that a service would give to this file after an upload: a built PSF keeps the id that its file states.
    identity = psfs.stated_id(path, LIMITS) or sha256_of(path)
    return replace(psf, provenance={**psf.provenance, "psf_id": identity})


def interpolate_psf(
    before: CorePsf | str | Path,
    after: CorePsf | str | Path,
    *,
    before_time: datetime | Time | str,
    after_time: datetime | Time | str,
    time: datetime | Time | str,
    threads: int | None = None,
) -> Psf:
    """Interpolate between two fitted PSFs in time.

    Parameters
    ----------
    before, after : Psf, str or path
        PSFs (``ScatterFit.psf()``) or their files, fitted with the same shape and the same diffraction PSF.
    before_time, after_time : datetime, Time or str
        When the PSFs hold, such as "2024-03-01T12:00:00". A time without a zone is UTC.
    time : datetime, Time or str
        The time of the new PSF, not before ``before_time`` and not after ``after_time``.
    threads : int, optional
        Number of threads. Default: all cores.

    Returns
    -------
    Psf
        The PSF at ``time``. Its ``fitted`` has the interpolated coordinates of the shape with their covariance.

    Raises
    ------
    DataError
        "bad-time", "psf-not-fitted", "shapes-differ", "psfs-differ", "diffraction-differs", "psf-not-of-its-shape",
        "epochs-not-in-order", "time-outside-epochs", and the errors of ``read_psf``.

    Notes
    -----
    The coordinates of the fitted shape are interpolated linearly (equations: ``psfcore.scatter.interpolation``).
    """
    first, second = (
        Epoch(one if isinstance(one, CorePsf) else read_psf(one), utc_time(_moment(at), name))
        for one, at, name in ((before, before_time, "before_time"), (after, after_time, "after_time"))
    )
    return Psf.of(
        interpolated_psf(
            first,
            second,
            utc_time(_moment(time), "time"),
            name=f"{first.psf.instrument or 'psf'}-interpolated",
            version="0.1.0",
            provenance={},
            threads=threads or cores(),
        )
    )


def _moment(time: Any) -> Any:
    """A time of astropy as a text in UTC; others unchanged."""
    return str(time.utc.isot) if hasattr(time, "isot") else time
