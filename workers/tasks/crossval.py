"""The task ``cross-validate``: how well a fit is known, its folds shared by as many workers as are idle.

Folds are parts in the catalogue: taken by compare-and-set under a lease, done once, kept when the job is tried again.
The job's own worker does what nobody else takes, so that help is welcome and never needed.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

from psfcore.scatter.inversion import Solution, invert
from psfcore.scatter.shapes import shape_named
from psfcore.scatter.total_psf import CURVE_RADII_PX
from psfcore.scatter.validation.bands import NEAR_CENTRE_PX, PARTING_SIGMAS, Bands, bands
from psfcore.scatter.validation.cross_validation import (
    FoldFit,
    FoldSample,
    bootstrap_samples,
    exact_fit,
    shared_fits,
)
from psfcore.scatter.validation.cross_validation_plot import cross_validation_png
from psfcore.transit.transit import Transit
from workers.catalogue.parts import Part
from workers.catalogue.tables import ReportRow
from workers.contract.identities import psf_fit_identity
from workers.contract.resolved import ResolvedCrossValidate
from workers.tasks.context import Context
from workers.tasks.keep_report import keep_report, provenance_of, write_json
from workers.tasks.psf_fit import load_transit

WAIT_S = 0.5
MOST_HELPERS = 16


def cross_validate(context: Context, parameters: Mapping[str, Any]) -> str:
    """Cross-validate a transit's fit; returns the id of the report."""
    request = ResolvedCrossValidate.model_validate(parameters)
    identity = psf_fit_identity(request)
    if context.catalogue.get(ReportRow, identity, context.owner) is not None:
        return identity
    transit = load_transit(context, request)[0]
    wanted = bootstrap_samples(len(transit.frames), runs=request.runs, seed=request.seed)
    solution = _solution(context, request, transit)
    if request.scheme == "shared":
        fits = shared_fits(solution, wanted, progress=context.report)
    else:
        fits = _exact(context, identity, solution, wanted)
    _save(context, request, identity, transit, fits)
    return identity


def assist_cross_validation(context: Context, parameters: Mapping[str, Any]) -> None:
    """Take folds of a job that runs elsewhere, until none is left."""
    request = ResolvedCrossValidate.model_validate(parameters)
    identity = psf_fit_identity(request)
    part = context.catalogue.parts.take(context.owner, identity, context.settings.lease_s)
    if part is None:
        return
    context.catalogue.parts.release(part)  # reading and fitting a transit takes longer than a lease may last
    transit = load_transit(context, request)[0]
    wanted = bootstrap_samples(len(transit.frames), runs=request.runs, seed=request.seed)
    solution = _solution(context, request, transit)
    while (
        part := context.catalogue.parts.take(context.owner, identity, context.settings.lease_s)
    ) is not None:
        _one(context, solution, wanted, part, done=0)


def _solution(context: Context, request: ResolvedCrossValidate, transit: Transit) -> Solution:
    """The fit of all images, which every fold begins from: each worker makes its own, for its scenes are large."""
    return invert(
        transit, shape_named(request.shape), threads=context.settings.threads, progress=context.report
    )


def _exact(
    context: Context, identity: str, solution: Solution, wanted: tuple[FoldSample, ...]
) -> tuple[FoldFit, ...]:
    """Every fold a fit of its own, done here or by whoever helps."""
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
            time.sleep(WAIT_S)  # the rest is with other workers
            continue
        _one(context, solution, wanted, part, done=len(done))


def _one(
    context: Context, solution: Solution, wanted: tuple[FoldSample, ...], part: Part, *, done: int
) -> None:
    """One fold; what it raises gives the fold back."""
    try:
        fit = exact_fit(solution, wanted[part.number], progress=_alive(context, part, done, len(wanted)))
    except BaseException:
        context.catalogue.parts.release(part)
        raise
    context.catalogue.parts.finish(part, fit.to_json())


def _alive(context: Context, part: Part, done: int, folds: int) -> Callable[[str, int, int], None]:
    """Progress of a fold: says that the part is alive, and lets the job's own report stop it."""
    last = time.monotonic()

    def report(_stage: str, _step: int, _steps: int) -> None:
        nonlocal last
        context.report("folds", done, folds)
        if time.monotonic() - last > context.settings.heartbeat_s:
            last = time.monotonic()
            context.catalogue.parts.heartbeat(part)

    return report


def _save(
    context: Context,
    request: ResolvedCrossValidate,
    identity: str,
    transit: Transit,
    fits: tuple[FoldFit, ...],
) -> None:
    radii = np.array(CURVE_RADII_PX[: len(fits[0].curve_pct)])
    found = bands(fits, radii)
    said = {
        "schema": "cross-validation/2",
        "sentence": sentence(found, len(fits)),
        "scheme": request.scheme,
        "shape": request.shape,
        **found.to_json(),
        "files": {str(n): frame.file for n, frame in enumerate(transit.frames)},
        "folds": [fit.to_json() for fit in fits],
        "inputs_sha256": transit.sha256,
        "provenance": provenance_of(context, request),
    }
    with context.store.temporary() as text, context.store.temporary() as picture:
        write_json(text, said)
        cross_validation_png(found, fits, [frame.pointing for frame in transit.frames], picture)
        keep_report(
            context,
            identity,
            "cross-validation",
            transit_id=request.transit_id,
            text=text,
            picture=picture,
            details={"sentence": said["sentence"], "held_out": found.held_out, "folds": len(fits)},
        )


def sentence(found: Bands, folds: int) -> str:
    """What a person reads first."""
    total, held_out = found.values["total"], found.held_out
    return (
        f"{folds} fits with images held out and drawn again: {100 * total[2]:.1f} % of the light is scattered diffusely "
        f"(1 sigma {100 * total[1]:.1f} to {100 * total[3]:.1f} %); held-out discs are {held_out['mean_pct']:+.1f} % off "
        f"on the mean, {held_out['rms_pct']:.1f} % rms, {held_out['largest_pct']:.1f} % at most{_freely(found)}."
    )


def _freely(found: Bands) -> str:
    """How a fit without a formula compares."""
    if found.shells is None:
        return ""
    near, largest = found.shells.near_centre, found.shells.largest
    said = (
        f"; without a formula {near.points:+.1f} ± {near.sigma:.1f} % of the light more is within "
        f"{NEAR_CENTRE_PX:g} px"
    )
    if not largest.parts:
        return f"{said}, and at no distance do the two part by more than {PARTING_SIGMAS:g} errors"
    return (
        f"{said}; the two part most within {largest.within_px:.3g} px, by {largest.points:+.1f} ± "
        f"{largest.sigma:.1f} % of the light"
    )
