"""The PSF that most tests of this folder use."""

from __future__ import annotations

from pathlib import Path

import pytest

import heliopsf
from tests.conftest import SMALL_INSTRUMENT


@pytest.fixture(scope="session")
def small_toml(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The file of the small instrument."""
    path = tmp_path_factory.mktemp("instrument") / "small.toml"
    path.write_text(SMALL_INSTRUMENT)
    return path


@pytest.fixture(scope="session")
def psf(small_toml: Path) -> heliopsf.Psf:
    """The PSF of the small instrument, 64 px."""
    return heliopsf.build_psf(small_toml, size=64)
