"""``heliopsf psf list|upload|certify|deprecate|best|lineage|rerun`` and ``heliopsf context``, and the client behind them."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from click.testing import CliRunner, Result
from fastapi.testclient import TestClient

from service.cli import context as cli_context
from service.cli.connection import short
from service.cli.main import main
from service.cli.psf import versions as cli_psf_versions
from service.client.http import Client, ServiceError
from tests.conftest import SMALL_INSTRUMENT, write_image, write_psf


@pytest.fixture
def sun(api: TestClient, run_jobs: Callable[[], None], monkeypatch: pytest.MonkeyPatch) -> Client:
    """A client of the application in this process, whose jobs are run as soon as they are asked for."""

    class AtOnce(Client):
        def submit(self, kind: str, *, queue: str | None = None, **parameters: Any) -> dict[str, Any]:
            job = super().submit(kind, queue=queue, **parameters)
            run_jobs()
            return job

        def close(self) -> None:
            """The transport is the application's: it goes on."""

    client = AtOnce("http://testserver", transport=api._transport)
    for module in (cli_psf_versions, cli_context):
        monkeypatch.setattr(module, "remote", lambda server: client)
    return client


def ask(*words: str, code: int = 0) -> str:
    answer: Result = CliRunner().invoke(main, list(words))
    assert answer.exit_code == code and (
        answer.exception is None or isinstance(answer.exception, SystemExit)
    ), (words, answer.output, answer.exception)
    return answer.output


def uploaded(tmp_path: Path, size: int, **line: str) -> str:
    file = tmp_path / f"p{size}.fits"
    write_psf(file, size=size)
    said = {"instrument": "hri_euv", "channel": "174", "kind": "total", **line}
    options = [word for name, value in said.items() for word in (f"--{name}", value)]
    return ask("psf", "upload", str(file), "--name", f"p{size}", *options).split()[0]


def test_psfs_from_draft_to_deprecated(sun: Client, tmp_path: Path) -> None:
    assert "no PSF yet" in ask("psf", "list")
    first, second = uploaded(tmp_path, 32), uploaded(tmp_path, 48)
    assert "no-such" not in ask("psf", "list") and first in ask("psf", "list", "--status", "draft")
    assert ask("psf", "list", "--channel", "304") == "no PSF with channel 304\n"
    told = ask("psf", "certify", first, "--version", "1.0.0", "--from", "2020-01-01", "--reason", "good")
    assert told == "hri_euv/174/total 1.0.0: certified  [2020-01-01T00:00:00Z, open)\n"
    refused = ask("psf", "certify", second, "--version", "1.1.0", code=1)
    assert first in refused and "deprecate that PSF" in refused and "Traceback" not in refused
    told = ask("psf", "certify", second, "--version", "1.1.0", "--from", "2020-01-01", "--supersedes", first)
    assert "1.1.0: certified" in told
    listed = ask("psf", "list", "--instrument", "hri_euv")
    assert "p32  1.0.0  deprecated" in listed and "p48  1.1.0  certified" in listed
    third = uploaded(tmp_path, 64)
    told = ask("psf", "deprecate", second, "--reason", "wrong")
    assert told == "hri_euv/174/total 1.1.0: deprecated\nproducts made with it: 0\n"
    ask("psf", "certify", third, "--version", "1.2.0")
    assert f"use {third}" in ask("psf", "deprecate", second, "--successor", third)
    assert [one["reason"] for one in sun.psf_status(second)["history"]] == ["", "wrong", ""]


def test_a_draft_is_deleted_by_the_first_digits_of_its_id(sun: Client, tmp_path: Path) -> None:
    first, second = uploaded(tmp_path, 32), uploaded(tmp_path, 48)
    for nothing in ("", "xyz"):
        assert "expected an id, or its first 8 or more" in ask("psf", "delete", nothing, code=2)
    assert ask("psf", "delete", first[:8]).startswith(f"deleted {first[:12]}  p32")
    assert [row["id"][:12] for row in sun.psfs()] == [second]
    ask("psf", "certify", second, "--version", "1.0.0")
    assert "never deleted" in ask("psf", "delete", second, code=1)


def test_the_best_by_properties_and_by_an_image(sun: Client, tmp_path: Path) -> None:
    first, second = uploaded(tmp_path, 32), uploaded(tmp_path, 48)
    ask("psf", "certify", first, "--version", "1.0.0", "--to", "2021-01-01")
    ask("psf", "certify", second, "--version", "1.1.0", "--from", "2021-01-01")
    assert ask("psf", "best", "--valid-at", "2022-01-01").startswith(second)
    several = ask("psf", "best", "--instrument", "hri_euv", code=1)
    assert first in several and second in several
    image = tmp_path / "i.fits"
    write_image(
        image, DETECTOR="HRI_EUV", TELESCOP="SOLO/EUI/HRI_EUV", WAVELNTH=174.0, **{"DATE-BEG": "2020-05-05"}
    )
    found = ask("psf", "best", "--image", str(image), "--json", str(tmp_path / "best.json"))
    assert found.startswith(first)
    assert json.loads((tmp_path / "best.json").read_text())["psf"]["id"].startswith(first)
    assert ask("psf", "best", "--image", str(image), "--version", "1.0.0", code=2)
    assert " has kind airy" in ask("psf", "best", "--kind", "airy", code=1)
    with pytest.raises(ServiceError) as caught:
        sun.best_psf(channel="193")
    assert (caught.value.code, caught.value.status) == ("no-psf-fits", 404)


def test_the_best_psf_for_an_image_is_the_one_that_deconvolve_uses(sun: Client, tmp_path: Path) -> None:
    hri = {"DETECTOR": "HRI_EUV", "TELESCOP": "SOLO/EUI/HRI_EUV", "WAVELNTH": 174.0}
    write_image(tmp_path / "hri.fits", **hri, **{"DATE-BEG": "2020-05-05"})
    told = ask("psf", "best", "--image", str(tmp_path / "hri.fits"), "--json", str(tmp_path / "b.json"))
    image_id = sun.upload_image(tmp_path / "hri.fits")["id"]
    wanted = sun.estimate("deconvolve", image_id=image_id)["psf"]
    assert told.startswith(f"{short(wanted['id'])}  hri_euv") and "not built yet" in told
    assert "No PSF of hri_euv/174/total is certified" in told
    assert json.loads((tmp_path / "b.json").read_text()) == {"psf": wanted, "why": wanted["why"]}
    certified = uploaded(tmp_path, 32)
    ask("psf", "certify", certified, "--version", "1.0.0")
    told = ask("psf", "best", "--image", str(tmp_path / "hri.fits"))
    assert told.startswith(certified) and "This PSF is certified" in told
    write_image(tmp_path / "aia.fits", TELESCOP="SDO/AIA", INSTRUME="AIA_3", WAVELNTH=1600)
    told = ask("psf", "best", "--image", str(tmp_path / "aia.fits"), code=1)
    assert "What to do next:" in told and "aia_171" in told


def test_contexts(sun: Client, tmp_path: Path) -> None:
    assert "no context yet" in ask("context", "list")
    assert "no PSF is certified yet" in ask("context", "create", "one", code=1)
    first, second = uploaded(tmp_path, 32), uploaded(tmp_path, 48, channel="304")
    ask("psf", "certify", first, "--version", "1.0.0", "--from", "2020-01-01")
    assert "one  1 pinned" in ask("context", "create", "one", "--reason", "as delivered")
    assert "two  2 pinned" in ask("context", "create", "two", "--psf", first, "--psf", second)
    shown = ask("context", "show", "one").splitlines()[1]
    assert shown == f"  hri_euv/174/total  [2020-01-01T00:00:00Z, open)  1.0.0  {first}"
    assert ask("context", "use", "two").startswith("default: two")
    listed = ask("context", "list").splitlines()
    assert listed[0].startswith("* ") and listed[1].startswith("  ") and "as delivered" in listed[1]
    assert ask("psf", "best", "--channel", "304").startswith(second)
    assert " has context one" in ask("psf", "best", "--channel", "304", "--context", "one", code=1)
    assert ask("context", "use", "--none") == "no default context: the certified PSFs are used\n"
    assert len(sun.default_context()["history"]) == 2
    ask("context", "use", code=2)
    assert "expected the id or name of a context; got 'three'" in ask("context", "use", "three", code=1)


def test_lineage_and_rerun(sun: Client, tmp_path: Path) -> None:
    (tmp_path / "small.toml").write_text(SMALL_INSTRUMENT)
    write_image(tmp_path / "i.fits")
    psf = sun.build_psf(tmp_path / "small.toml", size=64)
    product = sun.deconvolve(tmp_path / "i.fits", psf_id=psf["id"], steps=2)
    told = ask("psf", "lineage", product["id"], "--product", "--json", str(tmp_path / "l.json")).splitlines()
    assert (
        told[0].startswith(f"product {short(product['id'])}")
        and short(product["details"]["job_id"]) in told[0]
    )
    assert told[1].startswith("  image ") and told[2].startswith(f"  psf {short(psf['id'])}")
    assert told[3].startswith("    instrument-file ")
    assert json.loads((tmp_path / "l.json").read_text())["id"] == product["id"]
    again = ask("psf", "rerun", psf["id"], "--json", str(tmp_path / "r.json"))
    assert again == "The new PSF is the same file, bit for bit.\n"
    assert json.loads((tmp_path / "r.json").read_text())["same_file"] is True
    assert "bit for bit" in ask("psf", "rerun", product["id"], "--product")
    assert [item["product_id"] for item in sun.affected(psf["id"])] == [product["id"]]
    assert list(sun.affected(superseded=True)) == []
    write_psf(tmp_path / "own.fits")
    own = ask("psf", "upload", str(tmp_path / "own.fits")).split()[0]
    assert "was uploaded" in ask("psf", "rerun", own, code=1)


def test_a_rerun_that_differs_ends_with_status_1(
    sun: Client, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from psfcore.deconvolve import run

    write_image(tmp_path / "i.fits")
    write_psf(tmp_path / "p.fits")
    product = sun.deconvolve(tmp_path / "i.fits", psf_id=sun.upload_psf(tmp_path / "p.fits")["id"], steps=2)
    real = run.write_image

    def off(path: Path, image: Any, **how: Any) -> None:
        real(path, type(image)(**{**vars(image), "pixels": image.pixels * 1.001}), **how)

    monkeypatch.setattr(run, "write_image", off)
    assert "differs by at most 0.001" in ask("psf", "rerun", product["id"], "--product", code=1)
