"""Figures of the right size without content: to draw a figure takes half a second, and a report has a dozen.

Tests of the service and of its jobs use them. The tests in tests/psfcore draw each figure, and the processes that the
tests in tests/whole start draw those of real jobs.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import IO, Any

import pytest
from matplotlib.figure import Figure
from PIL import Image

from psfcore.drawing import plots


class BlankCanvas:
    """Takes the place of matplotlib's canvas: writes a white PNG as large as the figure."""

    def __init__(self, figure: Figure) -> None:
        self._figure = figure

    def print_png(self, target: str | Path | IO[bytes], **_options: Any) -> None:
        width, height = (int(inches * self._figure.dpi) for inches in self._figure.get_size_inches())
        Image.new("L", (width, height), 255).save(target, "PNG")


@contextmanager
def blank_figures() -> Iterator[None]:
    """While this context is active, figures are written without being drawn."""
    with pytest.MonkeyPatch.context() as patched:
        patched.setattr(plots, "FigureCanvasAgg", BlankCanvas)
        yield


def blank_unless_told(request: pytest.FixtureRequest) -> Iterator[None]:
    """For a fixture of a module: blank figures, except in a browser and where the module says REAL_FIGURES = True."""
    if "browser" in request.path.parts or getattr(request.module, "REAL_FIGURES", False):
        yield
    else:
        with blank_figures():
            yield
