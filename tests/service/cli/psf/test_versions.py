"""``heliopsf psf list|upload|certify|deprecate|best|lineage|rerun`` and ``heliopsf context``, and the client behind
them. ``heliopsf psf series`` and ``psf interpolate``, and the commands that name an interpolated PSF."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import prov
import pytest

from psfcore.deconvolve import run
from psfcore.fits.blocks import FitsLimits
from psfcore.fits.psfs import read_psf
from service.cli.connection import short
from service.client.http import Client, ServiceError
from tests.conftest import SMALL_INSTRUMENT, write_image, write_psf
from tests.fitted_psfs import EARLY, LATE, interpolated_on_a_small_grid, write_fitted

Command = Callable[..., str]


def uploaded(command: Command, tmp_path: Path, size: int, channel: str = "174") -> str:
    file = tmp_path / f"p{size}.fits"
    write_psf(file, size=size)
    series = ("--instrument", "hri_euv", "--channel", channel, "--kind", "total")
    return command("psf", "upload", file, "--name", f"p{size}", *series).split()[0]


def test_psfs_from_draft_to_deprecated(command: Command, client: Client, tmp_path: Path) -> None:
    assert "no PSF yet" in command("psf", "list")
    first, second = uploaded(command, tmp_path, 32), uploaded(command, tmp_path, 48)
    assert "no-such" not in command("psf", "list") and first in command("psf", "list", "--status", "draft")
    assert command("psf", "list", "--channel", "304") == "no PSF with channel 304\n"
    told = command("psf", "certify", first, "--version", "1.0.0", "--from", "2020-01-01", "--reason", "good")
    assert told == "hri_euv/174/total 1.0.0: certified  [2020-01-01T00:00:00Z, open)\n"
    refused = command("psf", "certify", second, "--version", "1.1.0", code=1)
    assert first in refused and "deprecate that PSF" in refused and "Traceback" not in refused
    told = command(
        "psf", "certify", second, "--version", "1.1.0", "--from", "2020-01-01", "--supersedes", first
    )
    assert "1.1.0: certified" in told
    listed = command("psf", "list", "--instrument", "hri_euv")
    assert "p32  1.0.0  deprecated" in listed and "p48  1.1.0  certified" in listed
    third = uploaded(command, tmp_path, 64)
    for nothing in ("", "xyz"):
        assert "expected an id, or its first 8 or more" in command("psf", "delete", nothing, code=2)
    fourth = uploaded(command, tmp_path, 16)
    assert command("psf", "delete", fourth[:8]).startswith(f"deleted {fourth[:12]}  p16")
    assert "never deleted" in command("psf", "delete", second, code=1)
    told = command("psf", "deprecate", second, "--reason", "wrong")
    assert told == "hri_euv/174/total 1.1.0: deprecated\nproducts made with it: 0\n"
    command("psf", "certify", third, "--version", "1.2.0")
    assert f"use {third}" in command("psf", "deprecate", second, "--successor", third)
    assert [one["reason"] for one in client.psf_status(second)["history"]] == ["", "wrong", ""]


def test_the_best_by_properties_and_by_an_image(command: Command, client: Client, tmp_path: Path) -> None:
    first, second = uploaded(command, tmp_path, 32), uploaded(command, tmp_path, 48)
    command("psf", "certify", first, "--version", "1.0.0", "--to", "2021-01-01")
    command("psf", "certify", second, "--version", "1.1.0", "--from", "2021-01-01")
    assert command("psf", "best", "--valid-at", "2022-01-01").startswith(second)
    several = command("psf", "best", "--instrument", "hri_euv", code=1)
    assert first in several and second in several
    image = tmp_path / "i.fits"
    write_image(
        image, DETECTOR="HRI_EUV", TELESCOP="SOLO/EUI/HRI_EUV", WAVELNTH=174.0, **{"DATE-BEG": "2020-05-05"}
    )
    found = command("psf", "best", "--image", image, "--json", tmp_path / "best.json")
    assert found.startswith(first)
    assert json.loads((tmp_path / "best.json").read_text())["psf"]["id"].startswith(first)
    assert command("psf", "best", "--image", image, "--version", "1.0.0", code=2)
    assert " has kind airy" in command("psf", "best", "--kind", "airy", code=1)
    write_image(tmp_path / "aia.fits", TELESCOP="SDO/AIA", INSTRUME="AIA_3", WAVELNTH=1600)
    told = command("psf", "best", "--image", tmp_path / "aia.fits", code=1)
    assert "--psf FILE.toml" in told and "psf fit TRANSIT" in told
    with pytest.raises(ServiceError) as caught:
        client.best_psf(channel="193")
    assert (caught.value.code, caught.value.status) == ("no-psf-fits", 404)


def test_contexts(command: Command, client: Client, tmp_path: Path) -> None:
    assert "no context yet" in command("context", "list")
    assert "no PSF is certified yet" in command("context", "create", "one", code=1)
    first, second = uploaded(command, tmp_path, 32), uploaded(command, tmp_path, 48, channel="304")
    command("psf", "certify", first, "--version", "1.0.0", "--from", "2020-01-01")
    assert "one  1 pinned" in command("context", "create", "one", "--reason", "as delivered")
    assert "two  2 pinned" in command("context", "create", "two", "--psf", first, "--psf", second)
    shown = command("context", "show", "one").splitlines()[1]
    assert shown == f"  hri_euv/174/total  [2020-01-01T00:00:00Z, open)  1.0.0  {first}"
    assert command("context", "use", "two").startswith("default: two")
    listed = command("context", "list").splitlines()
    assert listed[0].startswith("* ") and listed[1].startswith("  ") and "as delivered" in listed[1]
    assert command("psf", "best", "--channel", "304").startswith(second)
    assert " has context one" in command("psf", "best", "--channel", "304", "--context", "one", code=1)
    assert command("context", "use", "--none") == "no default context: the certified PSFs are used\n"
    assert len(client.default_context()["history"]) == 2
    command("context", "use", code=2)


def test_lineage_and_rerun(
    command: Command, client: Client, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "small.toml").write_text(SMALL_INSTRUMENT)
    write_image(tmp_path / "i.fits")
    psf = client.build_psf(tmp_path / "small.toml", size=64)
    product = client.deconvolve(tmp_path / "i.fits", psf_id=psf["id"], steps=2)
    told = command("psf", "lineage", product["id"], "--product", "--json", tmp_path / "l.json").splitlines()
    assert (
        told[0].startswith(f"product {short(product['id'])}")
        and short(product["details"]["job_id"]) in told[0]
    )
    assert told[1].startswith("  image ") and told[2].startswith(f"  psf {short(psf['id'])}")
    assert told[3].startswith("    instrument-file ")
    assert json.loads((tmp_path / "l.json").read_text())["id"] == product["id"]
    for name in ("l.json", "l.provn"):
        options = ("--product", "--prov", tmp_path / name, "--overwrite")
        assert command("psf", "lineage", product["id"], *options).startswith("product ")
        assert len(prov.read((tmp_path / name).read_bytes()).get_record(f"product:{product['id']}")) == 1
    again = command("psf", "rerun", psf["id"], "--json", tmp_path / "r.json")
    assert again == "The new PSF is the same file, bit for bit.\n"
    assert json.loads((tmp_path / "r.json").read_text())["same_file"] is True
    assert "bit for bit" in command("psf", "rerun", product["id"], "--product")
    real = run.write_image

    def off(path: Path, image: Any, **how: Any) -> None:
        real(path, image, **{**how, "pixels": how["pixels"] * 1.001})

    with monkeypatch.context() as patched:
        patched.setattr(run, "write_image", off)
        assert "differs by at most 0.001" in command("psf", "rerun", product["id"], "--product", code=1)
    assert [item["product_id"] for item in client.affected(psf["id"])] == [product["id"]]
    assert list(client.affected(superseded=True)) == []
    write_psf(tmp_path / "own.fits")
    own = command("psf", "upload", tmp_path / "own.fits").split()[0]
    assert "was uploaded" in command("psf", "rerun", own, code=1)


def test_a_deprecated_psf_that_is_named_is_used_with_a_warning(
    command: Command, psf_file: Path, tmp_path: Path
) -> None:
    line = ("--instrument", "hri_euv", "--channel", "174", "--kind", "total")
    psf = command("psf", "upload", psf_file, *line).split()[0]
    command("psf", "certify", psf, "--version", "1.0.0")
    write_image(tmp_path / "1.fits", DETECTOR="HRI_EUV", WAVELNTH=174)
    how = ("--psf", psf, "--steps", 1, "--other-channel")
    made = command("deconvolve", tmp_path / "1.fits", "-o", tmp_path / "o.fits", *how)
    assert "was deprecated" not in made
    command("psf", "deprecate", psf, "--reason", "wrong mesh")
    again = command("deconvolve", tmp_path / "1.fits", "-o", tmp_path / "o.fits", "--overwrite", *how)
    assert f"warning: PSF {psf} " in again and "deprecated (reason: wrong mesh)" in again
    many = command("deconvolve", tmp_path / "1.fits", "-o", f"{tmp_path}/out/", *how)
    assert f"warning: {tmp_path}/1.fits: PSF {psf} " in many
    bulk = command("bulk", "submit", "--upload", tmp_path / "1.fits", "--psf", psf, "--other-channel")
    assert f"warning: PSF {psf} was deprecated" in bulk


# --- interpolation in time ------------------------------------------------------------------------------


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


def test_two_psfs_are_interpolated_on_request_and_for_an_image_between_them(
    command: Command, tmp_path: Path
) -> None:
    assert "no series yet" in command("psf", "series")
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
    psf_id = again.split()[0]
    assert psf_id == said.split()[0], "the ends of the ranges are the default"
    lineage = command("psf", "lineage", psf_id).splitlines()
    assert "hri_euv-interpolated" in lineage[0]
    assert lineage[1].startswith(f"  psf {early}  (fitted 1.0.0 certified; weight 0.800")

    assert command("psf", "series") == f"{SERIES}  not interpolated\n"
    said = command("psf", "series", SERIES, "--interpolate", "--reason", "the mirrors age")
    assert said == f"{SERIES}  may be interpolated\n"
    image = tmp_path / "i.fits"
    write_image(image, DETECTOR="HRI_EUV", WAVELNTH=174, **{"DATE-BEG": "2022-08-13T06:00:00"})
    best = command("psf", "best", "--image", image)
    assert "not built yet" in best and f"{early} (fitted 1.0.0), which holds until 2022-03-01" in best
    command("context", "create", "2022")
    assert command("context", "show", "2022").count("may be interpolated") == 2
    assert command("psf", "series", SERIES, "--no-interpolate") == f"{SERIES}  not interpolated\n"


def test_options_that_do_not_belong_together(command: Command) -> None:
    assert "expected SERIES with --interpolate" in command("psf", "series", SERIES, code=2)
    unknown = command("psf", "series", SERIES, "--interpolate", code=1)
    assert "expected a series of which a PSF was certified" in unknown and SERIES in unknown
