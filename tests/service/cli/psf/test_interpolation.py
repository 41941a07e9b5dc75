"""``heliopsf psf series`` and ``psf interpolate``, and the commands that name an interpolated PSF."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from astropy.io import fits

from psfcore.fits.blocks import FitsLimits
from psfcore.fits.psfs import read_psf
from tests.conftest import write_image
from tests.fitted_psfs import EARLY, LATE, interpolated_on_a_small_grid, write_fitted

Command = Callable[..., str]
SERIES = "hri_euv/174/total"


@pytest.fixture(scope="module", autouse=True)
def _small_grid() -> Iterator[None]:
    with interpolated_on_a_small_grid():
        yield


def two_psfs(command: Command, folder: Path) -> tuple[str, str]:
    """Two fitted PSFs, uploaded."""
    first, second = (
        command("psf", "upload", write_fitted(folder / f"{name}.fits", values), "--kind", "total").split()[0]
        for name, values in (("early", EARLY), ("late", LATE))
    )
    return first, second


def test_a_series_is_interpolated_for_an_image_between_two_psfs(command: Command, tmp_path: Path) -> None:
    assert "no series yet" in command("psf", "series")
    early, late = two_psfs(command, tmp_path)
    command("psf", "certify", early, "--version", "1.0.0", "--to", "2022-03-01")
    command("psf", "certify", late, "--version", "1.1.0", "--from", "2023-03-01")
    assert command("psf", "series") == f"{SERIES}  not interpolated\n"
    image = tmp_path / "i.fits"
    write_image(image, DETECTOR="HRI_EUV", WAVELNTH=174, **{"DATE-BEG": "2022-05-13T06:00:00"})
    refused = command("psf", "best", "--image", image, code=1)
    assert "valid_at 2022-05-13" in refused
    said = command("psf", "series", SERIES, "--interpolate", "--reason", "the mirrors age")
    assert said == f"{SERIES}  may be interpolated\n"
    best = command("psf", "best", "--image", image)
    assert "not built yet" in best and f"{early} (fitted 1.0.0), which holds until 2022-03-01" in best

    made = command("deconvolve", image, "-o", tmp_path / "o.fits", "--steps", 2)
    with fits.open(tmp_path / "o.fits") as hdus:
        psf_id, version = hdus[0].header["PSFID"], hdus[0].header["PSFVERS"]
    assert psf_id[:12] in best and version == f"0.1.0+{psf_id[:8]}" and f" {version} (" in made
    lines = command("psf", "lineage", psf_id).splitlines()
    assert "hri_euv-interpolated" in lines[0]
    assert lines[1].startswith(f"  psf {early}  (fitted 1.0.0 certified; weight 0.800")
    assert lines[2].startswith(f"  psf {late}  (fitted 1.1.0 certified; weight 0.200")

    command("context", "create", "2022")
    assert command("context", "show", "2022").count("may be interpolated") == 2
    assert command("psf", "series", SERIES, "--no-interpolate") == f"{SERIES}  not interpolated\n"
    assert "valid_at 2022-05-13" in command("psf", "best", "--image", image, code=1)
    assert psf_id[:12] in command("psf", "best", "--image", image, "--context", "2022")

    command("psf", "deprecate", late, "--reason", "wrong")
    (line,) = [line for line in command("psf", "list").splitlines() if "hri_euv-interpolated" in line]
    assert "deprecated" in line and "[" not in line, "it never had a range of times"


def test_two_psfs_are_interpolated_on_request(command: Command, tmp_path: Path) -> None:
    early, late = two_psfs(command, tmp_path)
    refused = command("psf", "interpolate", early, late, "--time", "2022-05-13", code=2)
    assert f"expected --before-until, because PSF {early} has no end" in refused
    times = ("--before-until", "2022-03-01", "--after-from", "2023-03-01")
    out = tmp_path / "p.fits"
    said = command("psf", "interpolate", early, late, "--time", "2022-05-13", *times, "-o", out)
    assert "draft" in said and "weight 0.800" in said and "light beyond" in said and "total" in said
    psf = read_psf(out, FitsLimits(max_pixels=2**20))
    assert psf.fitted is not None and psf.name == "hri_euv-interpolated"
    outside = command("psf", "interpolate", early, late, "--time", "2024-01-01", *times, code=1)
    assert "not extrapolated" in outside and "2023-03-01" in outside
    command("psf", "certify", early, "--version", "1.0.0", "--to", "2022-03-01")
    command("psf", "certify", late, "--version", "1.1.0", "--from", "2023-03-01")
    again = command("psf", "interpolate", early, late, "--time", "2022-05-13")
    assert again.split()[0] == said.split()[0], "the ends of the ranges are the default"


def test_options_that_do_not_belong_together(command: Command) -> None:
    for words in (("psf", "series", SERIES), ("psf", "series", "--interpolate")):
        assert "expected SERIES with --interpolate or --no-interpolate" in command(*words, code=2)
    unknown = command("psf", "series", SERIES, "--interpolate", code=1)
    assert "expected a series of which a PSF was certified" in unknown and SERIES in unknown
