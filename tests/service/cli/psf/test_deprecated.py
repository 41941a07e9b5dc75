"""Commands that are told to use a deprecated PSF: they use it, and warn."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from tests.conftest import write_image

Command = Callable[..., str]


def test_a_deprecated_psf_that_is_named_is_used_with_a_warning(
    command: Command, psf_file: Path, tmp_path: Path
) -> None:
    line = ("--instrument", "hri_euv", "--channel", "174", "--kind", "total")
    psf = command("psf", "upload", psf_file, *line).split()[0]
    command("psf", "certify", psf, "--version", "1.0.0")
    for number in (1, 2):
        write_image(tmp_path / f"{number}.fits", seed=number, DETECTOR="HRI_EUV", WAVELNTH=174)
    how = ("--psf", psf, "--steps", 1, "--other-channel")
    made = command("deconvolve", tmp_path / "1.fits", "-o", tmp_path / "o.fits", *how)
    assert "was deprecated" not in made
    command("psf", "deprecate", psf, "--reason", "wrong mesh")
    again = command("deconvolve", tmp_path / "1.fits", "-o", tmp_path / "o.fits", "--overwrite", *how)
    assert f"warning: PSF {psf} " in again and "deprecated (reason: wrong mesh)" in again
    both = command("deconvolve", tmp_path / "1.fits", tmp_path / "2.fits", "-o", f"{tmp_path}/out/", *how)
    for number in (1, 2):
        assert f"warning: {tmp_path}/{number}.fits: PSF {psf} " in both
    bulk = command("bulk", "submit", "--upload", tmp_path / "1.fits", "--psf", psf, "--other-channel")
    assert f"warning: PSF {psf} was deprecated" in bulk
