"""What a command prints: its lines, and its progress on standard error: a bar on a terminal, otherwise a line every 10
s.

Names and messages of files, services and other owners may contain characters that control a terminal. Commands print
them by ``echo`` and ``say``, which make them harmless.
"""

from __future__ import annotations

import sys
import threading
import time
import unicodedata
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from datetime import UTC, datetime

import click

LINE_EVERY_S = 10.0
STEPS_OF = {"error estimate": "realisation"}  # the name of a step, by stage; "step" in all other stages
UNITS = (("days", 86_400), ("h", 3600), ("min", 60))

Report = Callable[[str, int, int], None]


def printable(text: str) -> str:
    r"""The text with every character that can control a terminal in the form \x1b. Line ends and tabs stay."""
    return "".join(c if c in "\n\t" or unicodedata.category(c)[0] != "C" else ascii(c)[1:-1] for c in text)


class OutputClosed(Exception):  # no error: the reader has read enough
    """The reader of the output ended first, as ``head`` does after its last line."""


def echo(text: str, *, err: bool = False) -> None:
    """Print a line to standard output, or to standard error. Raises `OutputClosed`."""
    try:
        click.echo(printable(text), err=err)
    except BrokenPipeError as error:
        raise OutputClosed from error


@dataclass
class Pace:
    """Estimates the time left until the last of the steps that a job counts at present.

    A job may count several times, for example first the images that it reads, then the iterations of a fit. A new count
    begins when the number of steps changes, or when the step number decreases. Only the present count is used for the
    estimate, because its steps may be faster or slower than those of earlier counts.
    """

    steps: int = -1
    first: tuple[int, float] = (0, 0.0)  # step and time of the first report of the count
    last: tuple[int, float] = (0, 0.0)  # step and time of the first report of the latest step

    def left_s(self, step: int, steps: int, now_s: float) -> float | None:
        """Take the report of a step; returns the time left, s, or None before the second step of a count."""
        if steps != self.steps or step < self.last[0]:
            self.steps, self.first, self.last = steps, (step, now_s), (step, now_s)
        elif step > self.last[0]:
            self.last = (step, now_s)
        done = self.last[0] - self.first[0]
        if not done:
            return None
        step_s = (self.last[1] - self.first[1]) / done
        return max(0.0, step_s * (steps - step) - (now_s - self.last[1]))


def duration(seconds: float) -> str:
    """A duration as text, in the largest unit in which its value is at least 2."""
    for unit, length_s in UNITS:
        if seconds >= 2 * length_s:
            return f"{seconds / length_s:.0f} {unit}"
    return f"{seconds:.0f} s"


def moment(seconds: float, form: str = "%Y-%m-%d %H:%M:%SZ") -> str:
    """A time as text, in UTC."""
    return datetime.fromtimestamp(seconds, UTC).strftime(form)


def step_text(stage: str, step: int, steps: int) -> str:
    """The stage and its step as text. If the number of steps is unknown, the text contains only the stage.

    A task reports an unknown number of steps as 1. A job of several counts reports percents of its estimated time.
    """
    if steps == 100:
        return f"{stage}: {step} % of the estimated time"
    if (steps <= 1 and step < steps) or not steps:
        return stage
    return f"{stage}: {STEPS_OF.get(stage, 'step')} {step} of {steps}"


class _Teller:
    """Writes the progress of one command."""

    def __init__(self, *, bar: bool) -> None:
        self.bar = bar
        self.started_s = self.told_s = time.monotonic()
        self.pace, self.lock = Pace(), threading.Lock()
        self.open_line = (
            False  # whether a bar is the last text on the terminal; other text then needs a new line
        )

    def report(self, stage: str, step: int, steps: int) -> None:
        """Show that this step of a stage is done."""
        now_s = time.monotonic()
        with self.lock:
            left_s = self.pace.left_s(step, steps, now_s)
            # A job may take longer than its pace, which then says nothing of the time left.
            left = "" if left_s is None or left_s < 1 else f", {duration(left_s)} left"
            if self.bar:
                filled = round(20 * step / max(steps, 1))
                drawn = "#" * filled + "-" * (20 - filled)
                elapsed_s = now_s - self.started_s
                bar = f"\r{printable(stage):<32.32} [{drawn}] {step}/{steps}  {elapsed_s:5.1f} s{left:<14}"
                click.echo(bar, err=True, nl=False)
                self.open_line = True
            elif now_s - self.told_s >= LINE_EVERY_S:
                self.told_s = now_s
                elapsed = duration(now_s - self.started_s)
                echo(f"{step_text(stage, step, steps)} after {elapsed}{left}", err=True)

    def line(self, text: str) -> None:
        """Write a text on a separate line."""
        with self.lock:
            self.end()
            echo(text, err=True)

    def end(self) -> None:
        """End the line of the bar."""
        if self.open_line:
            echo("", err=True)
            self.open_line = False


_tellers: list[_Teller] = []  # of the open blocks of ``progress_bar``, the innermost last


@contextmanager
def progress_bar() -> Iterator[Report]:
    """Show the progress of a ``with`` block and the time left in its stage.

    A terminal shows a bar; otherwise a line is written every 10 s.
    """
    teller = _Teller(bar=sys.stderr.isatty())
    _tellers.append(teller)
    try:
        yield teller.report
    finally:
        _tellers.remove(teller)
        teller.end()


def say(text: str) -> None:
    """Write a line to standard error. If a bar is shown, the line begins below it."""
    (_tellers[-1] if _tellers else _Teller(bar=False)).line(text)
