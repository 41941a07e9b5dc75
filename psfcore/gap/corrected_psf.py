"""The PSF that is fitted together with the answer's effects; it contains those effects that belong to the optics.

H is the PSF fitted together with the effects, theta_k are their parameters, and dH_k is the change of a point source's
image for one unit of parameter k:

    H' = H + sum over effects of the optics of theta_k dH_k        Eq. (1)

to first order, with negative values set to zero and scaled to the sum of H. An effect of the detector or of the scene is
not part of a PSF. It changes the PSF only because the fit no longer takes it for scatter. An effect that varies across
the field has dH_k of the field's centre.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from psfcore.errors import DataError
from psfcore.gap.diagnose import Diagnosis
from psfcore.gap.verdict.correction import Corrected
from psfcore.gap.view import Field, View
from psfcore.psf import REACH_GRID_PX, FittedShape, Psf, crop_or_pad
from psfcore.scatter.optics import Blur, Lanes, Optics
from psfcore.scatter.total_psf import TotalPsf
from psfcore.transit.transit import Place

Kernel = NDArray[np.float64]


def corrected_psf(found: Diagnosis, name: str, version: str, provenance: dict[str, Any]) -> Psf:
    """The PSF with the answer's effects in the model, on the full reach, with the components DIFFRACTION and SCATTER.

    provenance: what made the PSF, and its parents; this function adds the effects, their parameters, the gap and the
    inputs. Raises DataError "no-answer" if no effect was added to the model, "bad-effects" if an added effect fails, and the
    errors of `Psf`.
    """
    if not found.corrected:
        raise DataError(
            "no-answer",
            "expected a diagnosis whose answer was fitted together with the PSF; got the verdict "
            f"{found.judgement.verdict}: there is no corrected PSF",
        )
    added = found.corrected[0]
    transit, inversion = added.solution.transit, added.solution.inversion
    return Psf(
        kernel=_kernel(added),
        name=name,
        version=version,
        instrument=transit.instrument,
        status="draft",
        plate_scale_arcsec=transit.plate_scale_arcsec,
        components={
            "DIFFRACTION": crop_or_pad(transit.diffraction, REACH_GRID_PX),
            "SCATTER": inversion.shape.kernel(inversion.coordinates, REACH_GRID_PX),
        },
        provenance={**provenance, **_history(found, added)},
        fitted=FittedShape(
            shape=inversion.shape.name,
            parameters=inversion.shape.names,
            coordinates=tuple(inversion.coordinates.tolist()),
            covariance=tuple(tuple(row) for row in added.covariance.tolist()),
        ),
    )


def _history(found: Diagnosis, added: Corrected) -> dict[str, Any]:
    """The added effects, their parameters with errors, the gap before and after, and the input files."""
    return {
        "effects": [effect.name for effect in added.effects],
        "effect_in_kernel": [effect.name for effect in added.effects if effect.stage == "optics"],
        "effect_parameters": {
            parameter: {"value": value, "sigma": sigma, "unit": unit}
            for parameter, (value, sigma, unit) in added.values.items()
        },
        "verdict": found.judgement.verdict,
        "gap_before_pct": found.rms.to_json(),
        "gap_after_pct": found.after.to_json(),
        "inputs_sha256": found.solution.transit.sha256,
    }


def _kernel(added: Corrected) -> Kernel:
    """Eq. (1) [y, x] on the full reach."""
    solution = added.solution
    grid = (REACH_GRID_PX, REACH_GRID_PX)
    total = TotalPsf(solution.transit.diffraction, solution.inversion.shape, grid, threads=solution.threads)
    kernel = np.maximum(total.kernel(solution.inversion.coordinates), 0.0)
    optical = [effect for effect in added.effects if effect.stage == "optics"]
    if not optical:
        return kernel
    view = _point(added, total, kernel)
    values = iter(added.values.values())
    theta = {effect.name: [next(values)[0] for _ in effect.parameters] for effect in added.effects}
    changed = kernel.copy()
    for effect in optical:
        for value, change in zip(theta[effect.name], effect.changes(view), strict=True):
            changed += value * np.asarray(change.change(0, view.expected), dtype=np.float64)
    changed = np.maximum(changed, 0.0)
    return np.asarray(changed * (kernel.sum() / changed.sum()))


class _Point(View):
    """A point source in the centre of a field as large as the full reach, convolved with the PSF."""

    @cached_property
    def scenes(self) -> Sequence[Field]:
        """The point source: one unit of light."""
        point = np.zeros(self.solution.transit.shape, np.float32)
        point[point.shape[0] // 2, point.shape[1] // 2] = 1.0
        return [point]

    @cached_property
    def expected(self) -> Sequence[Field]:
        """The PSF."""
        return [frame.pixels for frame in self.solution.transit.frames]

    @cached_property
    def pointing_means(self) -> list[Field]:
        """The PSF."""
        return list(self.expected)

    def occulted_scene(self, n: int) -> Lanes:
        """The point source, in the engine's memory order."""
        return self.solution.optics.lanes(self.scenes[n])

    def blurred(self, n: int, slope: Blur, weight: Field | None = None) -> Field:
        """dH of the point source, times the weight at its place."""
        point = slope.lanes(self.scenes[n] if weight is None else self.scenes[n] * weight)
        return slope.field(slope.convolve(point))


def _point(added: Corrected, total: TotalPsf, kernel: Kernel) -> View:
    """The view of a solution whose only image is that of a point source."""
    solution = added.solution
    middle = REACH_GRID_PX // 2
    frame = replace(
        solution.transit.frames[0],
        pixels=kernel.astype(np.float32),
        place=Place(middle, middle, 1.0),
        filled=None,
    )
    return _Point(
        replace(
            solution,
            transit=replace(solution.transit, frames=(frame,)),
            total=total,
            optics=Optics(kernel, kernel.shape, threads=solution.threads),
        )
    )
