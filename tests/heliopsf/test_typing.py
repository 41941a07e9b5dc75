"""A script of a user passes ``mypy --strict`` with the annotations of heliopsf, and mistakes do not."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

SCRIPT = """
import numpy as np

import heliopsf

psf: heliopsf.Psf = heliopsf.build_psf("hri_euv", size=512, progress=True)
result: heliopsf.Deconvolution = heliopsf.deconvolve("image.fits", psf, iterations=25, threads=2)
before: np.ndarray[tuple[int, ...], np.dtype[np.float64]] = result.pixels
array: np.ndarray[tuple[int, ...], np.dtype[np.float64]] = heliopsf.deconvolve(before, psf.kernel)
beyond = float(heliopsf.psf_for("image.fits").light_beyond([10.0])[0])
sigma = heliopsf.fit_scatter("transit", progress=lambda stage, step, steps: None).value_sigma
print(beyond, sigma["total"], result.quality.max(), result.error is None)
with heliopsf.Client("http://127.0.0.1:8765") as client:
    client.deconvolve("image.fits", "out.fits")
"""
MISTAKES = {
    'heliopsf.build_psf("hri_euv", size="large")': 'has incompatible type "str"; expected "int"',
    'heliopsf.deconvolve("image.fits", 3)': "No overload variant",
    'heliopsf.deconvolve("image.fits").pixel': 'has no attribute "pixel"',
}


@pytest.mark.slow  # mypy reads the annotations of numpy for ten seconds
def test_a_script_passes_the_strict_check_and_mistakes_do_not(tmp_path: Path) -> None:
    (tmp_path / "script.py").write_text(SCRIPT)
    (tmp_path / "mistakes.py").write_text("\n".join(["import heliopsf", *MISTAKES]) + "\n")
    done = subprocess.run(
        [
            sys.executable, "-m", "mypy", "--strict", "--config-file", "", "--no-error-summary",
            "--follow-imports", "silent", "--cache-dir", str(tmp_path / "mypy"), "script.py", "mistakes.py",
        ],
        cwd=tmp_path, capture_output=True, text=True, env={"PATH": "", "MYPYPATH": str(Path(__file__).parents[2])},
    )  # fmt: skip
    assert done.stderr == ""
    errors = [line for line in done.stdout.splitlines() if ": error: " in line]
    assert len(errors) == len(MISTAKES), done.stdout
    for number, (error, text) in enumerate(zip(errors, MISTAKES.values(), strict=True), start=2):
        assert error.startswith(f"mistakes.py:{number}: ") and text in error
