"""The tasks by job kind. Each loads, computes and saves; it raises, and ``workers.run.runner`` decides what that means."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

from workers.bulk.task import bulk_turn
from workers.tasks.context import Context
from workers.tasks.crossval import assist_cross_validation, cross_validate
from workers.tasks.deconvolve import deconvolve
from workers.tasks.gap import gap_diagnose
from workers.tasks.psf_build import psf_build
from workers.tasks.psf_fit import psf_fit
from workers.tasks.report import evaluate
from workers.tasks.rerun import rerun
from workers.tasks.tables import psf_tables

Task = Callable[[Context, Mapping[str, Any]], str]

TASKS: dict[str, Task] = {
    "bulk": bulk_turn,
    "psf-build": psf_build,
    "psf-fit": psf_fit,
    "psf-tables": psf_tables,
    "cross-validate": cross_validate,
    "deconvolve": deconvolve,
    "evaluate": evaluate,
    "gap-diagnose": gap_diagnose,
    "rerun": rerun,
}
# What other workers do of a job that calls for help.
ASSISTANTS: dict[str, Callable[[Context, Mapping[str, Any]], None]] = {
    "cross-validate": assist_cross_validation
}
