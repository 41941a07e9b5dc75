"""``heliopsf psf fit``: what it prints."""

from __future__ import annotations

import re
from pathlib import Path

from click.testing import CliRunner

from service.cli.main import main
from tests.transit_files import write_simulated


def test_the_id_of_the_fitted_psf_is_printed(tmp_path: Path) -> None:
    transit, output = write_simulated(tmp_path / "transit"), tmp_path / "psf.fits"
    told = CliRunner().invoke(main, ["psf", "fit", str(transit), "--local", "-o", str(output)]).output
    assert re.search(r"psf\.fits: .* \(draft\), id [0-9a-f]{12}$", told, flags=re.M), told
