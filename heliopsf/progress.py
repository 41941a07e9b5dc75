"""Progress of functions that take long: a callback of the user, or a line on the terminal."""

from __future__ import annotations

import sys
from collections.abc import Callable
from typing import Literal

Steps = Callable[[int, int], None]
# True: show a line on standard error; a function: call it with (step, steps); None, False: show nothing.
Told = Steps | bool | None
Stages = Callable[[str, int, int], None]


def told(progress: Told, stage: str) -> Steps | None:
    """The function that a computation calls with (step, steps); it shows the stage if ``progress`` is True."""
    if progress is None or progress is False:
        return None
    return _line(stage) if progress is True else progress


def told_stages(progress: Stages | bool | None) -> Stages:
    """The function that a computation of several stages calls with (stage, step, steps)."""
    if progress is True:
        return lambda stage, step, steps: _line(stage)(step, steps)
    return progress or (lambda stage, step, steps: None)


def _line(stage: str) -> Steps:
    def show(step: int, steps: int) -> None:
        end: Literal["\n", ""] = "\n" if step >= steps else ""
        print(f"\r{stage}: step {step} of {steps}", end=end, file=sys.stderr, flush=True)

    return show
