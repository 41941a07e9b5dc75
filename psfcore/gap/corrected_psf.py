"""The corrected PSF: it is fitted together with the named effects, and contains the changes by effects of the optics.

H is the PSF fitted together with the effects. theta_k is parameter k of the effects of the optics. dH_k is the change
of the image of a point source for one unit of theta_k. To first order, the corrected PSF is

    H' = H + sum over k of theta_k dH_k        Eq. (1)

Negative values of H' are set to zero, and H' is scaled to the sum of H. An effect of the detector or of the scene is
not part of a PSF: it changes H only because the fit no longer mistakes its light for scatter. For an effect that varies
across the field, dH_k is the change at the centre of the field; the change of the scatter over the field becomes terms
of the PSF (`field_terms`).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import cached_property

import numpy as np

from psfcore.arrays import Kernel
from psfcore.errors import DataError
from psfcore.gap.diagnose import Diagnosis
from psfcore.gap.field_terms import with_terms
from psfcore.gap.verdict.correction import Corrected
from psfcore.gap.view import Field, View
from psfcore.psf import REACH_GRID_PX, Psf
from psfcore.scatter.fit import psf_of_fit
from psfcore.scatter.total_psf import Lanes, Optics, TotalPsf
from psfcore.transit.transit import Place


def corrected_psf(found: Diagnosis, name: str, version: str, provenance: dict[str, object]) -> Psf:
    """The corrected PSF of a diagnosis, on the full reach, with the components DIFFRACTION and SCATTER.

    Raises DataError "no-answer" if the diagnosis made no full refit, "bad-effects" if an added effect fails, and the
    errors of `Psf`.

    Parameters
    ----------
    provenance
        The software and the parents of the PSF. This function adds the effects, their parameters with errors, the gap
        without and with these effects, and the input files.
    """
    added = found.corrected
    if added is None:
        raise DataError(
            "no-answer",
            "expected a diagnosis that names an effect and fitted it together with the PSF; got the verdict "
            f"{found.answer.verdict}: this diagnosis has no corrected PSF",
        )
    history = {
        "effects": [effect.name for effect in added.effects],
        "effect_in_kernel": [effect.name for effect in added.effects if effect.stage == "optics"],
        "effect_parameters": {
            parameter: {"value": value, "sigma": sigma, "unit": unit}
            for parameter, (value, sigma, unit) in added.values.items()
        },
        "verdict": found.answer.verdict,
        "gap_before_pct": found.rms.to_json(),
        "gap_after_pct": found.after.to_json(),
        "inputs_sha256": added.solution.transit.sha256,
    }
    return psf_of_refit(added, name, version, provenance | history)


def psf_of_refit(added: Corrected, name: str, version: str, provenance: dict[str, object]) -> Psf:
    """The PSF of a full refit: Eq. (1), with the terms of a scatter that changes over the field.

    Raises the errors of `corrected_psf`.
    """
    inversion = added.solution.inversion
    scatter = inversion.shape.kernel(inversion.coordinates, REACH_GRID_PX)
    psf = psf_of_fit(
        _kernel(added),
        scatter,
        added.solution,
        added.covariance,
        name=name,
        version=version,
        provenance=provenance,
    )
    return with_terms(psf, added)


def _kernel(added: Corrected) -> Kernel:
    """The kernel H' of Eq. (1) [y, x], on the full reach."""
    solution = added.solution
    grid = (REACH_GRID_PX, REACH_GRID_PX)
    total = TotalPsf(solution.transit.diffraction, solution.inversion.shape, grid, threads=solution.threads)
    kernel = np.maximum(total.kernel(solution.inversion.coordinates), 0.0)
    optical = [effect for effect in added.effects if effect.stage == "optics"]
    if not optical:
        return kernel
    middle = REACH_GRID_PX // 2
    point = replace(
        solution.transit.frames[0],
        pixels=kernel.astype(np.float32),
        place=Place(middle, middle, 1.0),
        filled=None,
    )
    transit = replace(solution.transit, frames=(point,))
    optics = Optics(kernel, kernel.shape, threads=solution.threads)
    view = _Point(replace(solution, transit=transit, total=total, optics=optics))
    values = iter(added.values.values())
    changed = kernel.copy()
    for effect in added.effects:
        theta = [next(values)[0] for _ in effect.parameters]
        if effect not in optical:
            continue
        for value, change in zip(theta, effect.changes(view), strict=True):
            changed += value * np.asarray(change.change(0, view.expected), dtype=np.float64)
    changed = np.maximum(changed, 0.0)
    return np.asarray(changed * (kernel.sum() / changed.sum()))


class _Point(View):
    """A view with one image: a point source in the centre of the field, convolved with the PSF.

    The field is as large as the full reach.
    """

    @cached_property
    def scenes(self) -> Sequence[Field]:
        """The scene: one unit of light in the central pixel."""
        point = np.zeros(self.solution.transit.shape, np.float32)
        point[point.shape[0] // 2, point.shape[1] // 2] = 1.0
        return [point]

    @cached_property
    def expected(self) -> Sequence[Field]:
        """The images: there is only the image of the point source, and this image is the PSF."""
        return [frame.pixels for frame in self.solution.transit.frames]

    @cached_property
    def pointing_means(self) -> list[Field]:
        """The mean images of the pointings. There is only one pointing with one image: the PSF."""
        return list(self.expected)

    @cached_property
    def occulted_scenes(self) -> Sequence[Lanes]:
        """The scene, in the memory order of the convolution engine. No occulter covers the point source."""
        return [self.solution.optics.lanes(self.scenes[0])]
