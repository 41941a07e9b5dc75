"""Make a report on a PSF and its transit from one inversion. The report contains the results that a publication shows.

Source: Hofmeister et al., The point-spread function of HRI_EUV, sections "Inversion results", "Accuracy and robustness"
and "Evaluation". The PSF is fitted to all images once. The fit of every fold differs from this fit by a small step. The
step follows from the contributions of the images to the normal equations (the shared scheme, Eq. (1) of
`psfcore.scatter.validation.cross_validation`). There are two kinds of folds. In the cross-validation, the images of a
fold are a bootstrap sample. In the evaluation, the fitted images of a fold count once each, and the PSF of the fold is
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
from itertools import count
from typing import Any, TypeVar

from psfcore.arrays import Kernel
from psfcore.errors import DataError
from psfcore.evaluation.evaluation import Evaluation, evaluate
from psfcore.evaluation.report import report as evaluation_json
from psfcore.evaluation.report import sentence
from psfcore.evaluation.shapes import held_out_kernels
from psfcore.instruments.psf_statements import title
from psfcore.psf import PLATE_SCALE_TOLERANCE, REACH_GRID_PX, Psf
from psfcore.psf_sampling import sampling_of
from psfcore.scatter.fit import TransitFit, fit_json, fit_transit, fitted_psf
from psfcore.scatter.inversion import Inverter
from psfcore.scatter.reconstruction import Progress, Solution
from psfcore.scatter.validation.cross_validation import (
    Bands,
    FoldFit,
    bands,
    bootstrap_samples,
    shared_fits,
)
from psfcore.scatter.validation.robustness import OFFSETS_DN, DarkOffsetStudy, dark_offset_study
from psfcore.tables.lookup import Tables
from psfcore.tables.make import tables_of
from psfcore.transit.prepare import Prepared
from psfcore.transit.transit import Transit

SCHEMA = "psf-report/1"
# The relative costs of the stages.
STAGES = {"fit": 24.0, "folds": 14.0, "evaluating": 9.0, "dark offsets": 63.0, "tables": 6.0}
Part = TypeVar("Part")
# Parts that a report may lack.
DARK_LEVELS = "the effect of wrong dark levels"
NEED_A_FIT = (
    "the parameters and their cross-validation",
    "scatter without a formula (free shells)",
    "other shapes of scatter",
    f"{DARK_LEVELS} on a fit",
)
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

    Attributes
    ----------
    tables
        The tables of the PSF (`psfcore.tables.make`).
    fit, cross, study
        The fit, its cross-validation and the study of dark offsets; None if the PSF was given. `cross` and `study` can
        also be None for a reason that `missing` contains.
    held_out
        Whether every image was evaluated with a PSF that was fitted without it.
    fitted_to_these
        Whether the PSF used in the evaluation was fitted to the same images, here or according to its history.
    """

    transit: Transit
    prepared: Prepared
    psf: Psf
    tables: Tables
    evaluation: Evaluation
    fitted_to_these: bool
    missing: tuple[Missing, ...]
    seed: int
    held_out: bool = False
    fit: TransitFit | None = None
    cross: CrossValidated | None = None
    study: DarkOffsetStudy | None = None

    @property
    def given(self) -> bool:
        """Whether the PSF was given, not fitted here."""
        return self.fit is None

    @property
    def sentence(self) -> str:
        """The summary at the top of the report."""
        judged = sentence(self.evaluation)
        if self.fit is not None:
            return f"{fit_json(self.fit)['sentence']} {self.how_judged}. {judged}"
        return f"{title(self.psf.name, self.psf.version, None)}. {self.how_judged}. {judged}"

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

    Raises DataError "plate-scale-mismatch", and the errors of `fit_transit` and `evaluate`.

    Parameters
    ----------
    dark_offsets
        Whether to fit also with -5, -3, +3 and +5 DN added to every readout.
    seed
        The seed of all random samples (bootstrap, subsets of equations, noise realisations).
    solution
        An existing solution, or a function that makes it, as for `fit_transit`; not used if the PSF is given.
    """
    missing = _MissingParts()
    fit: TransitFit | None = None
    cross: CrossValidated | None = None
    kernels: Callable[[int], Kernel] | None = None
    if psf is not None:
        stages = _ReportProgress(progress, "evaluating", "tables")
        tested = psf
        _check_scale(transit, psf)
        for what in NEED_A_FIT:
            missing.add(what, "the PSF was given, and no fit was made")
        if psf.fitted is None:
            missing.add("errors of the PSF's curve and profile", "the PSF file contains no errors")
    else:
        stages = _ReportProgress(progress, *(s for s in STAGES if dark_offsets or s != "dark offsets"))
        fit = fit_transit(transit, seed=seed, threads=threads, progress=stages.of("fit"), solution=solution)
        name, fitted = f"{transit.instrument or 'transit'}-fitted", fit.solution
        tested = fitted_psf(fit, name=name, version="this report", provenance={})
        cross = missing.unless_made(
            "the cross-validation, and its comparison with scatter without a formula",
            lambda: _cross_validated(fitted, seed, stages.of("folds")),
        )
        kernels = missing.unless_made("a test on held-out images", lambda: held_out_kernels(fitted))
    placed = sampling_of(tested, {}, transit.shape).of(tested)
    evaluation = evaluate(
        transit,
        kernels or (lambda _index: placed),
        seed=seed,
        threads=threads,
        progress=stages.of("evaluating"),
    )
    study: DarkOffsetStudy | None = None
    if fit is not None and dark_offsets:
        visits = len(transit.frames) * len(OFFSETS_DN) * OFFSET_VISITS
        told = stages.counted("dark offsets", visits)
        study = missing.unless_made(
            DARK_LEVELS,
            lambda: dark_offset_study(transit, nominal=fitted.inversion, threads=threads, progress=told),
        )
    elif fit is not None:
        missing.add(DARK_LEVELS, "it was not requested")
    stages.of("tables")("tables of the PSF", 0, 1)
    return PsfReport(
        transit=transit,
        prepared=prepared,
        psf=tested,
        tables=tables_of(tested, threads=threads),
        fit=fit,
        cross=cross,
        evaluation=evaluation,
        held_out=kernels is not None,
        study=study,
        fitted_to_these=kernels is None if psf is None else _names_images(psf, transit),
        missing=tuple(missing),
        seed=seed,
    )


class _MissingParts(list[Missing]):
    """The parts that the report does not show, with the reasons."""

    def add(self, what: str, why: str) -> None:
        self.append(Missing(what, why))

    def unless_made(self, what: str, make: Callable[[], Part]) -> Part | None:
        """The part that `make` makes. If the images do not suffice, None; the reason of its DataError is added."""
        try:
            return make()
        except DataError as error:
            self.add(what, error.message)
            return None


def _cross_validated(solution: Solution, seed: int, progress: Progress) -> CrossValidated:
    """The cross-validation by the shared scheme."""
    samples = bootstrap_samples(len(solution.transit.frames), seed=seed)
    fits = shared_fits(solution, samples, progress=progress)
    return CrossValidated(fits, bands(fits, solution.total.radii_px))


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


class _ReportProgress:
    """Progress of the whole report, computed from the progress of its stages. It never decreases."""

    SCALE = 1000

    def __init__(self, progress: Progress, *stages: str) -> None:
        self._progress, self._costs = progress, {name: STAGES[name] for name in stages}
        self._furthest = 0

    def of(self, name: str) -> Progress:
        """The progress function of a stage that reports its step and its number of steps."""
        return lambda stage, step, steps: self._tell(name, stage, step / max(steps, 1))

    def counted(self, name: str, visits: float) -> Progress:
        """The progress function of a stage with several fits.

        The steps of each fit begin at 0 again. Therefore the calls are counted instead.

        Parameters
        ----------
        visits
            Expected number of calls.
        """
        calls = count(1)
        return lambda stage, _step, _steps: self._tell(name, stage, next(calls) / visits)

    def _tell(self, name: str, stage: str, share: float) -> None:
        names = list(self._costs)
        before = sum(self._costs[other] for other in names[: names.index(name)])
        done = (before + min(share, 1.0) * self._costs[name]) / sum(self._costs.values())
        self._furthest = max(self._furthest, round(self.SCALE * done))
        self._progress(stage, self._furthest, self.SCALE)


# --- as JSON ----------------------------------------------------------------------------------------------


def report_json(report: PsfReport, provenance: dict[str, object]) -> dict[str, Any]:
    """All numbers of a report as JSON.

    Parameters
    ----------
    provenance
        Description of software and request, from the caller.
    """
    out: dict[str, object] = {
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
