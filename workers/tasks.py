"""The tasks by job kind. Each loads, computes and saves; it raises, and ``workers.runner`` decides what that means."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

from workers.context import Context
from workers.deconvolve_task import deconvolve
from workers.psf_fit_task import psf_fit
from workers.psf_task import psf_build

Task = Callable[[Context, Mapping[str, Any]], str]

TASKS: dict[str, Task] = {"psf-build": psf_build, "psf-fit": psf_fit, "deconvolve": deconvolve}
