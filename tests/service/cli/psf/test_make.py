"""``heliopsf psf fit``: what it prints of a fit."""

from __future__ import annotations

from pathlib import Path
from unittest.mock import MagicMock

import pytest
from click.testing import CliRunner

from service.cli.main import main
from service.cli.psf import make
from tests.transit_files import write_transit

FIT = {
    "sentence": "It fits.",
    "parameters": {"b": {"value": 6.15, "sigma": 0.1, "unit": "px"}},
    "curve": {"radii_px": [10], "light_beyond_pct": [12.5], "sigma": [0.3]},
    "limits": ["one limit"],
}


def test_the_id_of_the_fitted_psf_is_printed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    service = MagicMock()
    service.__enter__.return_value = service
    row = {"name": "fit", "version": "0.1.0", "status": "draft", "details": {"fit": FIT}}
    service.fit_psf.return_value = row | {"id": "0123456789ab" + "c" * 52}
    monkeypatch.setattr(make, "connection", lambda *_: service)
    transit, output = write_transit(tmp_path / "transit"), tmp_path / "psf.fits"
    done = CliRunner().invoke(main, ["psf", "fit", str(transit), "--local", "-o", str(output)])
    assert done.exit_code == 0, (done.output, done.exception)
    lines = done.output.splitlines()
    assert lines[0].endswith("psf.fits: fit 0.1.0 (draft), id 0123456789ab"), done.output
    assert [" ".join(line.split()) for line in lines[1:]] == [
        "It fits.", "b 6.1500 ± 0.1000 px", "light beyond 10 px 12.50 ± 0.30 %", "note: one limit",
        f"next: `heliopsf report {transit} --local -o PAGE.html` tests the fit on images that it did not use",
    ]  # fmt: skip
