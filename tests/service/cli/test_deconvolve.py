"""``heliopsf deconvolve`` with many images, and the exit status of commands that wait for many images.
The command `changes`: a folder of images in, a table and a sheet out; and it agrees with `deconvolve`."""

from __future__ import annotations

import hashlib
import json
import re
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from astropy.io import fits
from click.testing import CliRunner, Result

import heliopsf
from psfcore.errors import DataError
from service.cli.main import main
from service.client.http import Client
from tests.conftest import SMALL_INSTRUMENT, write_image, write_psf


def run(*arguments: object) -> Result:
    return CliRunner().invoke(main, [str(argument) for argument in arguments])


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    (tmp_path / "in").mkdir()
    for seed in range(2):
        write_image(tmp_path / "in" / f"{seed}.fits", seed=seed)
    write_psf(tmp_path / "psf.dat")
    return tmp_path


def options(folder: Path) -> tuple[object, ...]:
    return "--psf", folder / "psf.dat", "--steps", 1, "--local"


def test_images_go_into_a_folder(folder: Path) -> None:
    first, second = (folder / "in" / f"{number}.fits" for number in range(2))
    for name, images, count in (
        ("files", [first, second], 2),
        ("folder", [folder / "in"], 2),
        ("one", [first], 1),
    ):
        out = folder / f"out-{name}"
        done = run("deconvolve", *images, "-o", f"{out}/", *options(folder))
        assert done.exit_code == 0, done.output
        assert f"{count} deconvolved, 0 existed already, 0 failed" in done.output
        assert [path.name.split("-")[0] for path in sorted(out.iterdir())] == ["0", "1"][:count]
        again = run("deconvolve", *images, "-o", out, *options(folder))
        assert again.exit_code == 0 and f"0 deconvolved, {count} existed already" in again.output


def test_one_image_goes_into_a_file(folder: Path) -> None:
    done = run("deconvolve", folder / "in" / "0.fits", "-o", folder / "new.fits", *options(folder))
    assert done.exit_code == 0, done.output
    told = done.stdout.splitlines()
    assert len(told) == 3 and "PSF psf 0.0.0+" in told[0] and told[1].startswith("1 step: flux"), told
    assert "--plot" in told[2]
    header = fits.getheader(folder / "new.fits")
    assert header["DCNVITER"] == 1 and "DCNVSATL" not in header
    level = ("--saturation", 100.0)
    done = run("deconvolve", folder / "in" / "0.fits", "-o", folder / "level.fits", *level, *options(folder))
    assert done.exit_code == 0, done.output
    assert fits.getheader(folder / "level.fits")["DCNVSATL"] == 50.0  # 100 DN in 2 s


def test_a_region_tells_its_error_in_percent_of_its_mean(folder: Path) -> None:
    asked = ("deconvolve", folder / "in" / "0.fits", "-o", folder / "new.fits", "--region", "8:40,8:40")
    done = run(*asked, "--region-error", 0.9, *options(folder))
    assert done.exit_code == 0, done.output
    (line,) = (line for line in done.stdout.splitlines() if line.startswith("region "))
    found = re.search(r"at most ([\d.]+) % of the mean of the region", line)
    assert found is not None and 0 < float(found[1]) <= 90, line


def test_a_psf_of_another_channel_is_refused_before_it_is_built(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("HELIOPSF_CACHE_DIR", str(folder / "cache"))
    write_image(folder / "aia.fits", TELESCOP="SDO/AIA", WAVELNTH=171, CDELT1=0.6, CDELT2=0.6)
    asked = ("deconvolve", folder / "aia.fits", "-o", folder / "new.fits", "--local")
    for scale, code in (((), "171 angstrom"), (("--plate-scale", 0.7), "171 angstrom")):
        done = run(*asked, "--psf", "aia_193", *scale)
        assert done.exit_code == 1 and code in done.output, done.output
    done = run(*asked, "--psf", "aia_171", "--plate-scale", 0.7)
    assert done.exit_code == 1 and "leave the plate scale out" in done.output
    with pytest.raises(DataError, match="channel-mismatch"):
        heliopsf.deconvolve(folder / "aia.fits", "aia_193")
    assert not (folder / "cache").exists(), "a PSF was built"


def test_the_time_of_each_stage_is_printed(folder: Path) -> None:
    asked = ("deconvolve", folder / "in" / "0.fits", "-o", folder / "new.fits", "--timings")
    done = run(*asked, *options(folder))
    assert done.exit_code == 0, done.output
    rows = [line.split(" s  ") for line in done.output.splitlines() if " s  " in line]
    seconds = {stage: float(number) for number, stage in rows}
    assert {"reading", "deconvolving", "saving", "whole command"} <= set(seconds)
    whole = seconds.pop("whole command")
    assert sum(seconds.values()) == pytest.approx(whole, abs=0.01 * len(rows))
    refused = run(*asked, "--psf", folder / "psf.dat")
    assert refused.exit_code == 2 and "--timings: expected --local" in refused.output


def test_a_failure_is_named_and_ends_with_status_1(folder: Path) -> None:
    (folder / "in" / "a.fits").write_text("Dear archive,\n" * 300)
    done = run("deconvolve", folder / "in", "-o", folder / "out", *options(folder))
    assert done.exit_code == 1, done.output
    assert f"failed: {folder}/in/a.fits: expected a FITS file" in done.output
    assert "3 images: 2 deconvolved, 0 existed already, 1 failed" in done.output
    assert "1 of 3 images failed" in done.output
    assert len(list((folder / "out").iterdir())) == 2


def test_an_error_is_told_once_with_local(folder: Path) -> None:
    """In a process of its own, because pytest replaces the handlers of the logs."""
    wrong = ("--stop", "discrepancy", "--steps", 1, "--psf", folder / "psf.dat", "--local")
    line = ("deconvolve", folder / "in" / "0.fits", "-o", folder / "o.fits", *wrong)
    done = subprocess.run(
        [sys.executable, "-m", "service.cli", *map(str, line)], capture_output=True, text=True
    )
    assert done.returncode == 1
    assert done.stderr.count("expected photon gain and read noise") == 1, done.stderr
    assert "job " not in done.stderr


def test_the_psf_of_an_instrument_may_be_named(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    image, file = folder / "in" / "0.fits", folder / "small.toml"
    file.write_text(SMALL_INSTRUMENT)
    done = run("deconvolve", image, "-o", folder / "o.fits", "--steps", 1, "--psf", file, "--local")
    assert done.exit_code == 0 and "PSF small 1.0.0" in done.output, done.output
    assert "scattered light stays" in done.output
    assert fits.getheader(folder / "o.fits")["PSFNAME"] == "small"
    done = run("deconvolve", image, "-o", folder / "n.fits", "--psf", "aia171", "--local")
    assert done.exit_code == 2 and "'aia_171'" in done.output
    file.write_text(SMALL_INSTRUMENT.replace("diameter_mm", "diameter_cm"))
    done = run("deconvolve", image, "-o", folder / "n.fits", "--psf", file, "--local")
    assert done.exit_code == 1 and "aperture.diameter_cm" in done.output and "'diameter_mm'" in done.output


def test_what_does_not_fit_together_is_refused(folder: Path) -> None:
    images = (folder / "in" / "0.fits", folder / "in" / "1.fits")
    plot = run("deconvolve", *images, "-o", folder / "out", "--plot", folder / "p.png", *options(folder))
    assert plot.exit_code == 2 and "heliopsf changes" in plot.output
    into_file = run("deconvolve", *images, "-o", folder / "psf.dat", *options(folder))
    assert into_file.exit_code == 1 and "expected a folder; " in into_file.output
    (folder / "empty").mkdir()
    none = run("deconvolve", folder / "empty", "-o", folder / "out", *options(folder))
    assert none.exit_code == 2 and "contain none" in none.output
    gone = run("deconvolve", *images, folder / "gone.fits", "-o", folder / "out", *options(folder))
    assert gone.exit_code == 2 and not (folder / "out").exists()


def test_an_image_that_does_not_fit_into_the_memory_is_refused(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("workers.tasks.deconvolve.free_bytes", lambda: 2**16)
    image, out = folder / "in" / "0.fits", folder / "out.fits"
    refused = run("deconvolve", image, "-o", out, *options(folder))
    assert refused.exit_code == 1 and not out.exists()
    assert "free memory, 0 MiB" in refused.output and "use a machine with more memory" in refused.output


# --- changes --------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def images(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Three images, one of them with pits; one of NaN, one that is no FITS file, and a text beside them."""
    images = tmp_path_factory.mktemp("images")
    for seed in range(3):
        write_image(images / f"{seed}.fits", seed=seed, **{"DATE-OBS": f"2024-03-1{seed}T00:00:00"})
    pixels = fits.getdata(images / "1.fits")
    pixels[20:80:5, 70:120:7] = -200
    fits.writeto(images / "1.fits", pixels, fits.getheader(images / "1.fits"), overwrite=True)
    fits.PrimaryHDU(np.full((64, 64), np.nan, "f4")).writeto(images / "nan.fits")
    (images / "junk.fits").write_text("hello\n" * 100)
    (images / "notes.txt").write_text("not an image")
    write_psf(images / "psf.dat")
    return images


def test_a_folder_is_ranked_tabulated_and_drawn(images: Path, tmp_path: Path) -> None:
    out = tmp_path / "a" / "b"
    named = (images, images / "0.fits", tmp_path / "gone.fits")
    result = run("changes", *named, "--psf", images / "psf.dat", "-o", out, "--local")
    assert result.exit_code == 0, result.output
    content = json.loads((out / "changes.json").read_text())
    assert content["method"] == {"name": "richardson-lucy", "steps": None}
    files = [Path(row["file"]).name for row in content["images"]]
    assert sorted(files) == ["0.fits", "1.fits", "2.fits"] and files[0] == "1.fits"
    assert content["images"][0]["score"] > 1 > content["images"][1]["score"]
    assert content["images"][0]["taken"] == "2024-03-11T00:00:00"
    assert {Path(f["name"]).name: f["code"] for f in content["failures"]} == {
        "nan.fits": "all-nan",
        "junk.fits": "not-fits",
        "gone.fits": "unreadable-file",
    }
    assert content["summary"]["images"] == 3 and content["summary"]["failures"] == 3
    image = str(images / "2.fits")
    assert content["inputs_sha256"][image] == hashlib.sha256(Path(image).read_bytes()).hexdigest()
    assert (out / "contact-sheet.png").read_bytes().startswith(b"\x89PNG")
    assert "3 images, 1 to look at, 3 not deconvolved" in result.output
    assert result.output.index("1.fits") < result.output.index("0.fits")


def test_where_nothing_can_be_done_it_says_so(images: Path, tmp_path: Path) -> None:
    empty = tmp_path / "empty"
    empty.mkdir()
    psf = ("--psf", images / "psf.dat", "-o", tmp_path / "out", "--local")
    none = run("changes", images / "junk.fits", *psf)
    assert none.exit_code == 1 and "no image could be deconvolved" in none.output
    assert json.loads((tmp_path / "out" / "changes.json").read_text())["failures"][0]["code"] == "not-fits"
    other = ("--psf", images / "junk.fits", "-o", tmp_path / "o", "--local")
    for arguments in ((empty, *psf), (images / "0.fits", *other)):
        refused = run("changes", *arguments)
        assert refused.exit_code != 0 and "Traceback" not in refused.output


def test_it_agrees_with_deconvolve_on_a_certified_psf_and_in_a_context(
    command: Callable[..., str], client: Client, tmp_path: Path
) -> None:
    """Both take the PSF that the service chooses for the image, and tell the same changes."""
    image = tmp_path / "hri.fits"
    write_image(image, DETECTOR="HRI_EUV", TELESCOP="SOLO/EUI/HRI_EUV", WAVELNTH=174)
    ids = []
    for size in (32, 48):
        write_psf(tmp_path / f"{size}.fits", size=size)
        series = {"instrument": "hri_euv", "channel": "174", "kind": "total"}
        ids.append(client.upload_psf(tmp_path / f"{size}.fits", name=f"p{size}", **series)["id"])
    client.certify_psf(ids[0], "1.0.0")
    client.create_context("first")
    client.certify_psf(ids[1], "1.1.0", supersedes=[ids[0]])
    for n, (chosen, context) in enumerate(((ids[1], ()), (ids[0], ("--context", "first")))):
        command("deconvolve", image, "-o", tmp_path / "d.fits", "--steps", 4, "--overwrite", *context)
        command("changes", image, "-o", tmp_path / f"out{n}", "--steps", 4, *context)
        product = client.product(fits.getheader(tmp_path / "d.fits")["PRODID"])
        content = json.loads((tmp_path / f"out{n}" / "changes.json").read_text())
        assert product["psf_id"] == chosen
        made = content["products"][str(image)]
        assert (made["id"], made["psf_id"]) == (product["id"], chosen)
        row = content["images"][0]
        assert row["psf"] == f"{'p32 1.0.0' if context else 'p48 1.1.0'}"
        assert product["details"]["changes"] in row.values(), "the figures are the product's own"
