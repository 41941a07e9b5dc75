"""The task ``cross-validate``: determines the uncertainty of a fit to a transit by fitting folds of its images.

Idle workers share the folds. A fold is a part in the catalogue: a worker takes it by compare-and-set under a lease and
computes it. If the job is tried again, finished folds are not computed again. The worker that runs the job computes all
folds that no other worker takes, so the job does not depend on help.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING

import numpy as np

from psfcore.errors import module_of_extra
from psfcore.psf import CURVE_RADII_PX
from psfcore.scatter.inversion import solution_of
from psfcore.scatter.reconstruction import Solution
from psfcore.scatter.shapes import shape_named
from psfcore.scatter.validation.cross_validation import (
    NEAR_CENTRE_PX,
    PARTING_SIGMAS,
    Bands,
    FoldFit,
    FoldSample,
    bands,
    bootstrap_samples,
    exact_fit,
    shared_fits,
)
from workers.contract.identities import psf_fit_identity
from workers.contract.requests import ResolvedCrossValidate
from workers.tasks.results import provenance_of, report_result
from workers.tasks.transits import load_transit
from workers.tasks.workspace import Json, Progress, Workspace, task_of

if TYPE_CHECKING:
    from workers.tasks.catalogue_workspace import CatalogueWorkspace

Samples = tuple[FoldSample, ...]
_PLOT = "psfcore.scatter.plots"


@task_of("cross-validate")
def cross_validate(workspace: Workspace, request: ResolvedCrossValidate, identity: str) -> None:
    """Cross-validate the fit of a transit, and add the report."""
    solution, samples = _solution(workspace, request)
    if request.scheme == "shared":
        fits = shared_fits(solution, samples, progress=workspace.report)
    else:
        results = workspace.parts(identity, len(samples), _fold(solution, samples))
        fits = tuple(FoldFit.from_json(result) for result in results)
    transit = solution.transit
    found = bands(fits, np.array(CURVE_RADII_PX[: len(fits[0].curve_pct)]))
    content = {
        "schema": "cross-validation/2",
        "sentence": sentence(found, len(fits)),
        "scheme": request.scheme,
        "shape": request.shape,
        **found.to_json(),
        "files": {str(n): frame.file for n, frame in enumerate(transit.frames)},
        "folds": [fit.to_json() for fit in fits],
        "inputs_sha256": transit.sha256,
        "provenance": provenance_of(workspace.job_id, request),
    }
    details = {"sentence": content["sentence"], "held_out": found.held_out, "folds": len(fits)}
    pointings = [frame.pointing for frame in transit.frames]
    workspace.add(
        report_result(
            identity,
            "cross-validation",
            content,
            details,
            draw=lambda path: module_of_extra(_PLOT).cross_validation_png(found, fits, pointings, path),
            transit_id=request.transit_id,
        )
    )


def assist_cross_validation(workspace: CatalogueWorkspace, parameters: Mapping[str, object]) -> None:
    """Compute folds of a job that another worker runs, until no fold is left."""
    request = ResolvedCrossValidate.model_validate(parameters)
    identity = psf_fit_identity(request)
    if workspace.has_parts_left(identity):  # reading and fitting a transit takes longer than a lease
        solution, samples = _solution(workspace, request)
        workspace.assist(identity, len(samples), _fold(solution, samples))


def _solution(workspace: Workspace, request: ResolvedCrossValidate) -> tuple[Solution, Samples]:
    """The fit of all images, with which every fold starts, and the samples of the folds.

    Helping workers read the solution that the worker of the job has stored.
    """
    transit, _ = load_transit(workspace, request)
    samples = bootstrap_samples(len(transit.frames), runs=request.runs, seed=request.seed)
    given = workspace.inverter(request)
    solution = solution_of(
        transit,
        shape_named(request.shape),
        given,
        threads=workspace.threads,
        progress=workspace.report,
    )
    return solution, samples


def _fold(solution: Solution, samples: Samples) -> Callable[[int, Progress], Json]:
    """The function that fits a fold with its own reconstructions."""
    return lambda number, progress: exact_fit(solution, samples[number], progress=progress).to_json()


def sentence(found: Bands, folds: int) -> str:
    """The sentence at the top of the report."""
    total, held_out = found.values["total"], found.held_out
    return (
        f"{folds} fits with held-out blocks and bootstrapped images: {100 * total[2]:.1f} % of the light is "
        f"scattered diffusely (1 sigma: {100 * total[1]:.1f} to {100 * total[3]:.1f} %). The residual of held-out "
        f"images is {held_out['mean_pct']:+.1f} % on average, {held_out['rms_pct']:.1f} % rms and "
        f"{held_out['largest_pct']:.1f} % at most.{_free_shells(found)}"
    )


def _free_shells(found: Bands) -> str:
    """A sentence that compares the fit of free shells, which assumes no formula, with the fit of the formula."""
    if found.shells is None:
        return ""
    near, largest = found.shells.near_centre, found.shells.largest
    said = (
        f" A fit without a formula puts {near.points:+.1f} ± {near.sigma:.1f} % more of the light within "
        f"{NEAR_CENTRE_PX:g} px"
    )
    if not largest.parts:
        return f"{said}; at no radius do the two fits differ by more than {PARTING_SIGMAS:g} standard errors."
    return (
        f"{said}; the two fits differ most within {largest.within_px:.3g} px, by {largest.points:+.1f} ± "
        f"{largest.sigma:.1f} % of the light."
    )
