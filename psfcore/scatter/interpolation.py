"""A PSF between two fitted PSFs: the coordinates of the fitted shape are interpolated linearly in time.

Two PSFs of one telescope were fitted to transits of two epochs. Their diffraction PSF is the same; only the scatter
changes with time. q0, q1 are the coordinates of the shape at the epochs t0 and t1, and C0, C1 are their covariances. At
the time t,

    w = (t - t0) / (t1 - t0),  0 <= w <= 1                                    Eq. (1)
    q(w) = (1 - w) q0 + w q1                                                   Eq. (2)
    C(w) = (1 - w)^2 C0 + w^2 C1 + w (1 - w) d d^T,   d = q1 - q0             Eq. (3)

The coordinates are those of the fit: the logarithm of a positive parameter, the logit of a fraction
(`psfcore.scatter.shapes`). The total PSF is the scatter kernel at q(w), convolved with the diffraction PSF.

The first two terms of Eq. (3) are the errors of the two fits, which are independent. The third term stands for the
unknown course between the epochs. It is the variance of a sudden change from q0 to q1 at an unknown time t', which is
uniformly distributed between the epochs: with probability w, the change is before t, and Eq. (2) differs from the truth
by (1 - w) d; with probability 1 - w, it is after t, and Eq. (2) differs by w d. The mean square is
w (1 - w)^2 d^2 + (1 - w) w^2 d^2 = w (1 - w) d^2. In the middle, this error is half the difference of the epochs. A
random walk from q0 to q1 (Brownian bridge) has the same variance, if its rate is estimated by its one known step d. A
steady change agrees with Eq. (2); its stated error is then too large, never too small. Eq. (3) does not cover a course
that leaves the range between the epochs and returns, for example a contamination followed by a bakeout.

| symbol | name | unit |
|---|---|---|
| t, t0, t1 | time, before.time, after.time | - |
| w | weight of the later PSF; the weight of the earlier PSF is 1 - w | - |
| q | FittedShape.coordinates | - |
| C | FittedShape.covariance | - |
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from datetime import datetime

import numpy as np

from psfcore.arrays import Kernel, Vector
from psfcore.convolution.convolver import Convolver
from psfcore.errors import DataError
from psfcore.instruments.files import PLATE_SCALE_TOLERANCE, WAVELENGTH_TOLERANCE
from psfcore.psf import REACH_GRID_PX, FittedShape, Psf, crop_centred
from psfcore.scatter import total_psf
from psfcore.scatter.shapes import shape_named
from psfcore.scatter.total_psf import DIFFRACTION, SCATTER, fit_of

# Two kernels count as the same if the sum of the absolute differences of their weights is at most this fraction of the
# light. Files hold weights as float32, whose rounding changes this sum by less than 1e-7.
SAME_LIGHT = 1e-5


@dataclass(frozen=True)
class Epoch:
    """A fitted PSF and the time at which it holds.

    Attributes
    ----------
    psf
        The PSF, with its fitted shape and its component DIFFRACTION.
    origin
        Entries that name the PSF in the provenance of an interpolated PSF, for example its id and the hash of its file.
    """

    psf: Psf
    time: datetime
    origin: Mapping[str, str] = field(default_factory=dict)


def weight_at(before: datetime, after: datetime, time: datetime) -> float:
    """The weight w of the later epoch at a time: 0 at ``before``, 1 at ``after``.

    Raises DataError "epochs-not-in-order" if ``before`` is not earlier than ``after``, and "time-outside-epochs" if the
    time is not between them: nothing is extrapolated.
    """
    if not before < after:
        raise DataError(
            "epochs-not-in-order",
            f"expected the epoch of the first PSF before the epoch of the second; got {before.isoformat()} and "
            f"{after.isoformat()}: exchange the two PSFs, or correct the times",
        )
    if not before <= time <= after:
        raise DataError(
            "time-outside-epochs",
            f"expected a time from {before.isoformat()} to {after.isoformat()}, because PSFs are not extrapolated; got "
            f"{time.isoformat()}: choose PSFs whose epochs enclose this time",
        )
    return (time - before) / (after - before)


def interpolated_shape(before: FittedShape, after: FittedShape, weight: float) -> FittedShape:
    """The fitted shape between two fits, Eq. (2) and (3).

    Raises DataError "shapes-differ" if the two fits do not have the same shape and parameters.

    Parameters
    ----------
    weight
        The weight of ``after``, 0 to 1.
    """
    if (before.shape, before.parameters) != (after.shape, after.parameters):
        raise DataError(
            "shapes-differ",
            f"expected two PSFs that were fitted with the same shape; got {before.shape} "
            f"({', '.join(before.parameters)}) and {after.shape} ({', '.join(after.parameters)}): fit both transits "
            "with the same shape (`heliopsf psf fit --shape`)",
        )
    q0, q1 = np.array(before.coordinates), np.array(after.coordinates)
    c0, c1 = np.array(before.covariance), np.array(after.covariance)
    change = q1 - q0
    coordinates = (1 - weight) * q0 + weight * q1  # Eq. (2)
    course = weight * (1 - weight) * np.outer(change, change)
    covariance = (1 - weight) ** 2 * c0 + weight**2 * c1 + course  # Eq. (3)
    return FittedShape(
        shape=before.shape,
        parameters=before.parameters,
        coordinates=tuple(coordinates.tolist()),
        covariance=tuple(tuple(row) for row in covariance.tolist()),
    )


def interpolated_psf(
    before: Epoch,
    after: Epoch,
    time: datetime,
    *,
    name: str,
    version: str,
    provenance: Mapping[str, object],
    threads: int = 1,
) -> Psf:
    """The total PSF at a time between two epochs, on the array of the two PSFs, with its components and its errors.

    Its components are DIFFRACTION, that of the earlier PSF, and SCATTER; ``fitted`` holds Eq. (2) and (3). To
    ``provenance`` are added `interpolated_at` and `interpolated_between`: name, version, time, weight and origin of the
    two PSFs.

    Raises DataError: "psf-not-fitted" if a PSF has no fitted shape or no component DIFFRACTION; "psfs-differ" if the
    instruments, channels, cards, plate scales or arrays differ; "shapes-differ"; "diffraction-differs";
    "psf-not-of-its-shape" if a PSF contains more than its fitted shape and diffraction, such as a PSF that was
    corrected for a ghost; and the errors of `weight_at`.
    """
    weight = weight_at(before.time, after.time, time)
    first, second = fit_of(before.psf), fit_of(after.psf)
    _check_same_telescope(before.psf, after.psf)
    fitted = interpolated_shape(first, second, weight)
    diffraction = before.psf.components[DIFFRACTION]
    _check_same_diffraction(before.psf, after.psf)
    shape, size = shape_named(fitted.shape), before.psf.kernel.shape[0]
    # Kernels are computed on the full reach and then cropped: light from outside the square is diffracted into it.
    grid = max(size, REACH_GRID_PX)
    convolver = Convolver(diffraction, (grid, grid), dtype=np.float64, threads=threads)

    def total(fit: FittedShape) -> Kernel:
        whole = convolver.apply(shape.kernel(np.array(fit.coordinates), grid))
        return crop_centred(np.maximum(np.asarray(whole, np.float64), 0.0), (size, size))

    for psf, fit in ((before.psf, first), (after.psf, second)):
        _check_of_its_shape(psf, total(fit))
    return Psf(
        kernel=total(fitted),
        name=name,
        version=version,
        instrument=before.psf.instrument,
        status="draft",
        plate_scale_arcsec=before.psf.plate_scale_arcsec,
        wavelength_angstrom=before.psf.wavelength_angstrom,
        components={
            DIFFRACTION: diffraction,
            SCATTER: shape.kernel(np.array(fitted.coordinates), size),
        },
        provenance={
            **provenance,
            "interpolated_at": time.isoformat(),
            "interpolated_between": [
                {
                    **epoch.origin,
                    "name": epoch.psf.name,
                    "version": epoch.psf.version,
                    "time": epoch.time.isoformat(),
                    "weight": share,
                }
                for epoch, share in ((before, 1 - weight), (after, weight))
            ],
        },
        fitted=fitted,
        cards=before.psf.cards,
    )


def parameters_of(fitted: FittedShape) -> dict[str, dict[str, float | str]]:
    """The parameters of a fitted shape by name: value, standard error (sigma), unit and meaning."""
    shape, at = shape_named(fitted.shape), np.array(fitted.coordinates)
    return shape.described(shape.values(at), shape.value_sigma(at, np.array(fitted.covariance)))


def curve_sigma(psf: Psf, radii_px: Vector, *, threads: int = 1) -> Vector:
    """The standard error of C(R) = 100 (1 - encircled energy) of a fitted PSF, in percent, one for each radius (px).

    The covariance of the fitted coordinates is propagated through the derivatives of C(R). Raises DataError
    "psf-not-fitted".
    """
    fitted, size = fit_of(psf), psf.kernel.shape[0]
    shape, at = shape_named(fitted.shape), np.array(fitted.coordinates)
    # Single precision is sufficient for the derivatives and takes half the time.
    convolver = Convolver(psf.components[DIFFRACTION], (size, size), dtype=np.float32, threads=threads)
    slopes = (np.asarray(convolver.apply(shape.slope(at, k, size)), np.float64) for k in range(at.size))
    return total_psf.curve_sigma(slopes, np.array(fitted.covariance), radii_px)


def _check_same_telescope(before: Psf, after: Psf) -> None:
    """Raise DataError "psfs-differ" if the two PSFs are not of the same instrument, channel, filter and array."""
    pairs = {
        "instrument": (before.instrument, after.instrument, None),
        "cards": (dict(before.cards), dict(after.cards), None),
        "array": (before.kernel.shape, after.kernel.shape, None),
        "wavelength (angstrom)": (
            before.wavelength_angstrom,
            after.wavelength_angstrom,
            WAVELENGTH_TOLERANCE,
        ),
        "plate scale (arcsec/px)": (
            before.plate_scale_arcsec,
            after.plate_scale_arcsec,
            PLATE_SCALE_TOLERANCE,
        ),
    }
    differ = [
        f"{name} {one} and {other}"
        for name, (one, other, tolerance) in pairs.items()
        if not _same(one, other, tolerance)
    ]
    if before.field_terms or after.field_terms:
        raise DataError(
            "psfs-differ",
            "expected two PSFs without terms FIELD, because PSFs that change over the field are not interpolated in "
            "time; got at least one with terms: use the PSF of one of the two times",
        )
    if differ or before.kernel.shape[0] != before.kernel.shape[1]:
        raise DataError(
            "psfs-differ",
            "expected two PSFs of the same instrument, channel, filter and plate scale, on square arrays of the "
            f"same size; got {'; '.join(differ) or f'arrays of {before.kernel.shape}'}: choose two PSFs of one series",
        )


def _same(one: object, other: object, tolerance: float | None) -> bool:
    if (
        tolerance is not None
        and isinstance(one, int | float | np.floating)
        and isinstance(other, int | float | np.floating)
        and one
        and other
    ):
        return abs(float(one) / float(other) - 1) <= tolerance
    return one == other


def _check_same_diffraction(before: Psf, after: Psf) -> None:
    first, second = before.components[DIFFRACTION], after.components[DIFFRACTION]
    moved = float(np.abs(first - second).sum()) if first.shape == second.shape else 1.0
    if moved > SAME_LIGHT:
        raise DataError(
            "diffraction-differs",
            f"expected two PSFs with the same diffraction PSF; got {before.name} {before.version} and {after.name} "
            f"{after.version}, whose diffraction differs by {100 * moved:.3g} % of the light: fit both transits with "
            "the same diffraction PSF",
        )


def _check_of_its_shape(psf: Psf, model: Kernel) -> None:
    moved = float(np.abs(psf.kernel - model).sum())
    if moved > SAME_LIGHT:
        raise DataError(
            "psf-not-of-its-shape",
            f"expected a PSF that is its fitted shape convolved with its diffraction PSF; got {psf.name} "
            f"{psf.version}, which differs from that by {100 * moved:.3g} % of the light, for example because it "
            "contains a corrected effect: name a PSF for the image instead (--psf)",
        )
