"""The tasks by job kind. Each loads, computes and saves; it raises, and ``workers.runner`` decides what that means."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

from workers.bulk_task import bulk_turn
from workers.context import Context
from workers.crossval_task import assist_cross_validation, cross_validate
from workers.deconvolve_task import deconvolve
from workers.evaluate_task import evaluate
from workers.gap_task import gap_diagnose
from workers.psf_fit_task import psf_fit
from workers.psf_tables_task import psf_tables
from workers.psf_task import psf_build
from workers.rerun_task import rerun

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
