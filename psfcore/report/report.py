"""Make a report on a PSF and its transit from one inversion. The report contains the results that a publication shows.

Source: Hofmeister et al., The point-spread function of HRI_EUV, sections "Inversion results", "Accuracy and robustness"
and "Evaluation". The PSF is fitted to all images once. The fit of every fold differs from this fit by a small step. The
step follows from the contributions of the images to the normal equations (the shared scheme, Eq. (1) of
`psfcore.scatter.validation.cross_validation`). There are two kinds of folds. In the cross-validation, the images of a fold
are a bootstrap sample. In the evaluation, the fitted images of a fold count once each, and the PSF of the fold is
evaluated on the held-out images. Only the dark offsets need new fits; these start from the fit to all images.

A given PSF is evaluated without a fit. The report then lists the results that are missing because they need a fit.

| symbol | name |
|---|---|
| y, s, PE, residual | PsfReport.evaluation, as in `psfcore.evaluation.evaluation` |
| 1 - encircled energy | PsfReport.tables["encircled"] |
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from psfcore.errors import DataError
from psfcore.evaluation.evaluation import Evaluation, evaluate
from psfcore.evaluation.report import report as evaluation_json
from psfcore.evaluation.report import sentence
from psfcore.evaluation.shapes import held_out_kernels
from psfcore.psf import PLATE_SCALE_TOLERANCE, REACH_GRID_PX, Psf
from psfcore.scatter.fit import TransitFit, fit_transit, fitted_psf
from psfcore.scatter.inversion import Inverter
from psfcore.scatter.reconstruction import Progress, Solution
from psfcore.scatter.report import fit_json
from psfcore.scatter.validation.cross_validation import (
    Bands,
    FoldFit,
    bands,
    bootstrap_samples,
    shared_fits,
)
from psfcore.scatter.validation.dark_offsets import OFFSETS_DN, DarkOffsetStudy, dark_offset_study
from psfcore.tables.make import tables_of
from psfcore.transit.prepare import Prepared
from psfcore.transit.transit import Kernel, Transit

SCHEMA = "psf-report/1"
STAGES = {
    "fit": 24.0,
    "folds": 14.0,
    "evaluating": 9.0,
    "dark offsets": 63.0,
    "tables": 6.0,
}  # relative costs
OFFSET_VISITS = 8.5  # in a fit with a dark offset, each image is typically processed this number of times


@dataclass(frozen=True, eq=False)
class CrossValidated:
    """All fits of a cross-validation, and their medians and bands."""

    fits: tuple[FoldFit, ...]
    bands: Bands


@dataclass(frozen=True)
class Missing:
    """A result that a report does not show, and the reason."""

    what: str
    why: str


@dataclass(frozen=True, eq=False)
class PsfReport:
    """A transit, a PSF and all results about them.

    tables: the tables of the PSF (`psfcore.tables.make`). fit, cross, study: None if the PSF was given; cross and study can
    also be None for a reason that `missing` contains. held_out: whether every image was evaluated with a PSF that was
    fitted without it. fitted_to_these: whether the PSF used in the evaluation was fitted to the same images, here or
    according to its history.
    """

    transit: Transit
    prepared: Prepared
    psf: Psf
    tables: dict[str, Any]
    fit: TransitFit | None
    cross: CrossValidated | None
    evaluation: Evaluation
    held_out: bool
    study: DarkOffsetStudy | None
    fitted_to_these: bool
    missing: tuple[Missing, ...]
    seed: int

    @property
    def given(self) -> bool:
        """Whether the PSF was given, not fitted here."""
        return self.fit is None

    @property
    def sentence(self) -> str:
        """The summary at the top of the report."""
        judged = sentence(self.evaluation)
        if self.fit is not None:
            return fit_json(self.fit)["sentence"] + f" {self.how_judged}. {judged}"
        return f"PSF {self.psf.name} {self.psf.version}. {self.how_judged}. {judged}"

    @property
    def how_judged(self) -> str:
        """A sentence: with which PSF each image was evaluated, and whether this is an independent test."""
        if self.held_out:
            return "Each image was evaluated with a PSF that was fitted without this image and its neighbours"
        if self.given and self.fitted_to_these:
            return (
                "Each image was evaluated with the given PSF, which was fitted to these images; this is not an "
                "independent test"
            )
        if self.given:
            return "Each image was evaluated with the given PSF"
        return "Each image was evaluated with the PSF fitted to all images; this is not an independent test"


def make_report(
    transit: Transit,
    prepared: Prepared,
    *,
    psf: Psf | None = None,
    dark_offsets: bool = True,
    seed: int = 1,
    threads: int = 1,
    progress: Progress = lambda stage, step, steps: None,
    solution: Solution | Inverter | None = None,
) -> PsfReport:
    """Fit a transit and evaluate the fit, or evaluate a given PSF.

    dark_offsets: also fit with -5, -3, +3 and +5 DN added to every readout. seed: the seed of all random samples
    (bootstrap, subsets of equations, noise realisations). solution: as in `fit_transit`; not used if the PSF is given.
    Raises DataError "plate-scale-mismatch", and the errors of `fit_transit` and `evaluate`.
    """
    wanted = [s for s in STAGES if psf is None or s in ("evaluating", "tables")]
    if not dark_offsets and psf is None:
        wanted.remove("dark offsets")
    stages = _ReportProgress(progress, {name: STAGES[name] for name in wanted})
    if psf is not None:
        _check_scale(transit, psf)
        return _on_a_given(transit, prepared, psf, seed, threads, stages)
    missing: list[Missing] = []
    fit = fit_transit(transit, seed=seed, threads=threads, progress=stages.of("fit"), solution=solution)
    made = fitted_psf(
        fit, name=f"{transit.instrument or 'transit'}-fitted", version="this report", provenance={}
    )
    cross = _cross_validated(fit, seed, missing, stages.of("folds"))
    kernels = _held_out_kernels(fit.solution, missing)
    evaluation = evaluate(
        transit,
        kernels or (lambda _index: fit.kernel),
        seed=seed,
        threads=threads,
        progress=stages.of("evaluating"),
    )
    study = None
    if dark_offsets:
        study = _offsets(fit, threads, missing, stages)
    else:
        missing.append(Missing("the effect of wrong dark levels", "it was not requested"))
    return PsfReport(
        transit=transit,
        prepared=prepared,
        psf=made,
        tables=_tables(made, threads, stages),
        fit=fit,
        cross=cross,
        evaluation=evaluation,
        held_out=kernels is not None,
        study=study,
        fitted_to_these=kernels is None,
        missing=tuple(missing),
        seed=seed,
    )


def _on_a_given(
    transit: Transit, prepared: Prepared, psf: Psf, seed: int, threads: int, stages: _ReportProgress
) -> PsfReport:
    """The report on a given PSF. No fit is made."""
    evaluation = evaluate(
        transit, lambda _index: psf.kernel, seed=seed, threads=threads, progress=stages.of("evaluating")
    )
    why = "the PSF was given, and no fit was made"
    lacking = (
        "the parameters and their cross-validation",
        "scatter without a formula (free shells)",
        "other shapes of scatter",
        "the effect of wrong dark levels on a fit",
    )
    missing = [Missing(what, why) for what in lacking]
    if psf.fitted is None:
        missing.append(Missing("errors of the PSF's curve and profile", "the PSF file contains no errors"))
    return PsfReport(
        transit=transit,
        prepared=prepared,
        psf=psf,
        tables=_tables(psf, threads, stages),
        fit=None,
        cross=None,
        evaluation=evaluation,
        held_out=False,
        study=None,
        fitted_to_these=_names_images(psf, transit),
        missing=tuple(missing),
        seed=seed,
    )


def _check_scale(transit: Transit, psf: Psf) -> None:
    """Raise DataError "plate-scale-mismatch" if both plate scales are known and differ by more than 1 %."""
    seen, wanted = transit.plate_scale_arcsec, psf.plate_scale_arcsec
    if seen is not None and wanted is not None and abs(seen / wanted - 1) > PLATE_SCALE_TOLERANCE:
        raise DataError(
            "plate-scale-mismatch",
            f"expected images with the plate scale of PSF {psf.name}, {wanted:g} arcsec/px; got {seen:g} arcsec/px; "
            "choose a PSF of the same instrument and binning",
        )


def _names_images(psf: Psf, transit: Transit) -> bool:
    """Whether a PSF's history contains the SHA-256 of an image of a transit.

    The lines of the history are joined first, because FITS can break a text anywhere.
    """
    history = "".join(str(line) for line in psf.provenance.get("history", ()))
    return any(transit.sha256.get(frame.file, "-") in history for frame in transit.frames)


def _tables(psf: Psf, threads: int, stages: _ReportProgress) -> dict[str, Any]:
    stages.of("tables")("tables of the PSF", 0, 1)
    return tables_of(psf, threads=threads)


def _cross_validated(
    fit: TransitFit, seed: int, missing: list[Missing], progress: Progress
) -> CrossValidated | None:
    """The cross-validation by the shared scheme.

    If the images do not suffice, the result is None, and the reason is appended to `missing`.
    """
    try:
        fits = shared_fits(
            fit.solution, bootstrap_samples(len(fit.transit.frames), seed=seed), progress=progress
        )
    except DataError as error:
        what = "the cross-validation, and its comparison with scatter without a formula"
        missing.append(Missing(what, error.message))
        return None
    return CrossValidated(fits, bands(fits, fit.solution.total.radii_px))


def _held_out_kernels(solution: Solution, missing: list[Missing]) -> Callable[[int], Kernel] | None:
    """For each image, the total PSF of the fold that holds it out. The fold's guard also excludes its neighbours.

    If the images do not suffice, the result is None, and the reason is appended to `missing`.
    """
    try:
        return held_out_kernels(solution)
    except DataError as error:
        missing.append(Missing("a test on held-out images", error.message))
        return None


def _offsets(
    fit: TransitFit, threads: int, missing: list[Missing], stages: _ReportProgress
) -> DarkOffsetStudy | None:
    visits = len(fit.transit.frames) * len(OFFSETS_DN) * OFFSET_VISITS
    try:
        return dark_offset_study(
            fit.transit,
            nominal=fit.inversion,
            threads=threads,
            progress=stages.counted("dark offsets", visits),
        )
    except DataError as error:
        missing.append(Missing("the effect of wrong dark levels", error.message))
        return None


class _ReportProgress:
    """Progress of the whole report, computed from the progress of its stages. It never decreases."""

    SCALE = 1000

    def __init__(self, progress: Progress, costs: dict[str, float]) -> None:
        self._progress, self._costs = progress, costs
        self._furthest = 0

    def of(self, name: str) -> Progress:
        """The progress function of a stage that reports its step and its number of steps."""

        def report(stage: str, step: int, steps: int) -> None:
            self._say(name, stage, step / max(steps, 1))

        return report

    def counted(self, name: str, visits: float) -> Progress:
        """The progress function of a stage with several fits.

        The steps of each fit begin at 0 again. Therefore the calls are counted instead. visits: expected number of calls.
        """
        calls = 0

        def report(stage: str, _step: int, _steps: int) -> None:
            nonlocal calls
            calls += 1
            self._say(name, stage, calls / visits)

        return report

    def _say(self, name: str, stage: str, share: float) -> None:
        before = 0.0
        for other, cost in self._costs.items():
            if other == name:
                break
            before += cost
        done = (before + min(share, 1.0) * self._costs[name]) / sum(self._costs.values())
        self._furthest = max(self._furthest, round(self.SCALE * done))
        self._progress(stage, self._furthest, self.SCALE)


# --- as JSON ----------------------------------------------------------------------------------------------


def report_json(report: PsfReport, provenance: dict[str, Any]) -> dict[str, Any]:
    """All numbers of a report as JSON. provenance: the caller's description of software and request."""
    out: dict[str, Any] = {
        "schema": SCHEMA,
        "sentence": report.sentence,
        "psf": {
            "name": report.psf.name,
            "version": report.psf.version,
            "given": report.given,
            "sum": report.psf.total,
            "fitted_to_these_images": report.fitted_to_these,
        },
        "tables": report.tables,
        "evaluation": evaluation_json(report.evaluation, report.study) | {"held_out": report.held_out},
        "not_shown": [vars(missing) for missing in report.missing],
        "inputs": inputs_of(report),
        "seed": report.seed,
        "provenance": provenance,
    }
    if report.fit is not None:
        out["fit"] = fit_json(report.fit)
    if report.cross is not None:
        out["cross_validation"] = {
            "scheme": "shared",
            "fits": len(report.cross.fits),
            **report.cross.bands.to_json(),
        }
    return out


def inputs_of(report: PsfReport) -> dict[str, Any]:
    """The inputs of a report: files with their SHA-256, noise figures, and numbers of filled pixels."""
    transit = report.transit
    return {
        "instrument": transit.instrument,
        "images": len(transit.frames),
        "shape": list(transit.shape),
        "plate_scale_arcsec": transit.plate_scale_arcsec,
        "exposures_s": sorted({frame.exposure_s for frame in transit.frames}),
        "noise": vars(transit.noise),
        "diffraction_shape": list(transit.diffraction.shape),
        "reach_px": REACH_GRID_PX,
        "prepared": report.prepared.to_json(),
        "sha256": transit.sha256,
    }
