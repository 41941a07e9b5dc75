"""The task ``cross-validate``: determines the uncertainty of a fit to a transit by fitting folds of its images.

Idle workers share the folds. A fold is a part in the catalogue: a worker takes it by compare-and-set under a lease and
computes it. If the job is tried again, finished folds are not computed again. The worker that runs the job computes all
folds that no other worker takes, so the job does not depend on help.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, Any

import numpy as np

from psfcore.errors import module_of_extra
from psfcore.psf import CURVE_RADII_PX
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
from psfcore.transit.transit import Transit
from workers.contract.identities import psf_fit_identity
from workers.contract.requests import ResolvedCrossValidate
from workers.tasks.results import Finished, keep_report, provenance_of, report_made
from workers.tasks.transits import load_transit, solved

if TYPE_CHECKING:
    from workers.catalogue.jobs import Part
    from workers.tasks.context import Context

_PLOT = "psfcore.scatter.plots"
WAIT_S = 0.5
MOST_HELPERS = 16


def cross_validate(context: Context, parameters: Mapping[str, Any]) -> str:
    """Cross-validate the fit of a transit; returns the report's id."""
    request = ResolvedCrossValidate.model_validate(parameters)
    identity = psf_fit_identity(request)
    if report_made(context, identity):
        return identity
    transit = load_transit(context, request)[0]
    wanted = bootstrap_samples(len(transit.frames), runs=request.runs, seed=request.seed)
    solution = _solution(context, request, transit)
    if request.scheme == "shared":
        fits = shared_fits(solution, wanted, progress=context.report)
    else:
        fits = _exact(context, identity, solution, wanted)
    report = report_of(request, transit, fits, job_id=context.job_id)
    keep_report(context, identity, "cross-validation", report, transit_id=request.transit_id)
    return identity


def assist_cross_validation(context: Context, parameters: Mapping[str, Any]) -> None:
    """Compute folds of a job that another worker runs, until no fold is left."""
    request = ResolvedCrossValidate.model_validate(parameters)
    identity = psf_fit_identity(request)
    part = context.catalogue.parts.take(context.owner, identity, context.settings.lease_s)
    if part is None:
        return
    context.catalogue.parts.release(part)  # reading and fitting a transit takes longer than a lease
    transit = load_transit(context, request)[0]
    wanted = bootstrap_samples(len(transit.frames), runs=request.runs, seed=request.seed)
    solution = _solution(context, request, transit)
    while (
        part := context.catalogue.parts.take(context.owner, identity, context.settings.lease_s)
    ) is not None:
        _one(context, solution, wanted, part, done=0)


def _solution(context: Context, request: ResolvedCrossValidate, transit: Transit) -> Solution:
    """The fit of all images; every fold starts from this fit.

    Helping workers read the solution that the worker of the job has stored.
    """
    return solved(context, request, transit, shape_named(request.shape), progress=context.report)


def _exact(
    context: Context, identity: str, solution: Solution, wanted: tuple[FoldSample, ...]
) -> tuple[FoldFit, ...]:
    """Fit every fold with its own reconstructions, here or on the workers that help."""
    catalogue, owner = context.catalogue, context.owner
    catalogue.parts.open(owner, identity, len(wanted))
    context.call_for_help(min(MOST_HELPERS, len(wanted) - 1))
    while True:
        done = catalogue.parts.results(owner, identity)
        context.report("folds", len(done), len(wanted))
        if len(done) == len(wanted):
            return tuple(FoldFit.from_json(result) for result in done)
        part = catalogue.parts.take(owner, identity, context.settings.lease_s)
        if part is None:
            time.sleep(WAIT_S)  # other workers compute the remaining folds
            continue
        _one(context, solution, wanted, part, done=len(done))


def _one(
    context: Context, solution: Solution, wanted: tuple[FoldSample, ...], part: Part, *, done: int
) -> None:
    """Compute one fold. After an exception the fold is released for another worker."""
    try:
        fit = exact_fit(solution, wanted[part.number], progress=_heartbeat(context, part, done, len(wanted)))
    except BaseException:
        context.catalogue.parts.release(part)
        raise
    context.catalogue.parts.finish(part, fit.to_json())


def _heartbeat(context: Context, part: Part, done: int, folds: int) -> Callable[[str, int, int], None]:
    """A progress function for a fold. The function renews the lease of the part, and raises an exception if the job
    must stop."""
    last = time.monotonic()

    def report(_stage: str, _step: int, _steps: int) -> None:
        nonlocal last
        context.report("folds", done, folds)
        if time.monotonic() - last > context.settings.heartbeat_s:
            last = time.monotonic()
            context.catalogue.parts.heartbeat(part)

    return report


def report_of(
    request: ResolvedCrossValidate, transit: Transit, fits: tuple[FoldFit, ...], *, job_id: str
) -> Finished:
    """The report on the fits of all folds."""
    found = bands(fits, np.array(CURVE_RADII_PX[: len(fits[0].curve_pct)]))
    said = {
        "schema": "cross-validation/2",
        "sentence": sentence(found, len(fits)),
        "scheme": request.scheme,
        "shape": request.shape,
        **found.to_json(),
        "files": {str(n): frame.file for n, frame in enumerate(transit.frames)},
        "folds": [fit.to_json() for fit in fits],
        "inputs_sha256": transit.sha256,
        "provenance": provenance_of(job_id, request),
    }
    pointings = [frame.pointing for frame in transit.frames]
    return Finished(
        said,
        {"sentence": said["sentence"], "held_out": found.held_out, "folds": len(fits)},
        draw=lambda path: module_of_extra(_PLOT).cross_validation_png(found, fits, pointings, path),
    )


def sentence(found: Bands, folds: int) -> str:
    """The sentence at the top of the report."""
    total, held_out = found.values["total"], found.held_out
    return (
        f"{folds} fits with held-out blocks and bootstrapped images: {100 * total[2]:.1f} % of the light is scattered "
        f"diffusely (1 sigma: {100 * total[1]:.1f} to {100 * total[3]:.1f} %). The residual of held-out images is "
        f"{held_out['mean_pct']:+.1f} % on average, {held_out['rms_pct']:.1f} % rms and {held_out['largest_pct']:.1f} % at "
        f"most.{_free_shells(found)}"
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
