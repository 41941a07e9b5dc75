"""The browser of the tests of pages. Where it is missing, none of these tests is collected, and the run says so in one
line."""

from __future__ import annotations

import os
import shutil
from pathlib import Path

import pytest

VARIABLE = "HELIOPSF_CHROMIUM"
COMMANDS = ("chromium", "chromium-browser", "google-chrome")
TESTS = Path(__file__).parent / "service" / "pages" / "browser"


def chromium() -> str | None:
    """The command of Chromium. If the variable names one, its absence is an error and not a reason to skip tests."""
    return os.environ.get(VARIABLE) or next(filter(None, map(shutil.which, COMMANDS)), None)


def pytest_terminal_summary(terminalreporter: pytest.TerminalReporter, config: pytest.Config) -> None:
    """Say that the tests in a browser did not run, if they belong to this run."""
    paths = [Path(argument.split("::")[0]).resolve() for argument in config.args]
    if chromium() is None and any(TESTS.is_relative_to(path) or path.is_relative_to(TESTS) for path in paths):
        terminalreporter.write_line(
            f"not run: {TESTS.relative_to(config.rootpath)}: no Chromium on this machine: install it, or name one in "
            f"{VARIABLE}",
            yellow=True,
        )
