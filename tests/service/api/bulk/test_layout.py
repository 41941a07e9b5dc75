"""Products of bulk runs in the archive's own layout."""

from __future__ import annotations

import hashlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from fastapi.testclient import TestClient

from tests.conftest import write_image
from tests.service.api.bulk.conftest import FEW, failures, results, started

Work = Callable[[], None]
LAYOUT = "{telescop}/{date:%Y/%m/%d}/{stem}_deconvolved.fits"


@pytest.fixture
def archive(tmp_path: Path) -> Path:
    """Files of equal names in the folders of two years; the third has no date."""
    root = tmp_path / "archive"
    for number, year in enumerate((2020, 2021, 2022)):
        (root / str(year)).mkdir(parents=True)
        date = {} if year == 2022 else {"DATE-BEG": f"{year}-03-01T12:00:00"}
        write_image(root / str(year) / "one.fits", seed=number, **date)
    return root


def done(api: TestClient, work: Work, **request: Any) -> tuple[list[dict[str, Any]], dict[str, str]]:
    """The results of a run, and the codes of its failures by file."""
    bulk = started(api, **request)
    work()
    return results(api, bulk), {one["source"]: one["error"]["code"] for one in failures(api, bulk)}


@pytest.mark.parametrize("only", [False, True])
def test_products_have_the_names_of_the_layout(
    api: TestClient, work: Work, archive: Path, out: Path, psf_id: str, only: bool
) -> None:
    output = {"folder": str(out), "layout": LAYOUT, "only": only}
    request = {"files": [{"glob": f"{archive}/*/*"}], "psf_id": psf_id, "output": output}
    lines, failed = done(api, work, **request)
    wanted = [out / f"TEST/{year}/03/01/one_deconvolved.fits" for year in (2020, 2021)]
    assert [line["output"] for line in lines] == list(map(str, wanted))
    assert failed == {f"{archive}/2022/one.fits": "no-output-name"}
    assert [hashlib.sha256(path.read_bytes()).hexdigest() for path in wanted] == [
        line["sha256"] for line in lines
    ]
    assert sorted(path for path in out.rglob("*") if path.is_file()) == wanted, "nothing else is left"
    again, _ = done(api, work, **request)
    assert [line["reused"] for line in again] == [True, True]
    assert [line["output"] for line in again] == list(map(str, wanted))


@pytest.mark.parametrize("only", [False, True])
def test_the_second_image_with_a_name_fails_and_replaces_nothing(
    api: TestClient, work: Work, archive: Path, out: Path, psf_id: str, only: bool
) -> None:
    output = {"folder": str(out), "layout": "{stem}.fits", "only": only}
    request = {"files": [{"glob": f"{archive}/*/*"}], "psf_id": psf_id, "output": output}
    told = api.post("/v1/bulk/estimate", json={"parameters": FEW, **request}).json()
    assert [one["error"]["code"] for one in told["refused"]] == ["output-name-taken"] * 2
    (line,), failed = done(api, work, **request)
    assert set(failed.values()) == {"output-name-taken"} and len(failed) == 2
    assert hashlib.sha256((out / "one.fits").read_bytes()).hexdigest() == line["sha256"]
    assert [path.name for path in out.iterdir()] == ["one.fits"]


def test_a_file_of_somebody_else_is_not_replaced(
    api: TestClient, work: Work, archive: Path, out: Path, psf_id: str
) -> None:
    out.mkdir()
    (out / "one.fits").write_text("a letter")
    output = {"folder": str(out), "layout": "{stem}.fits"}
    lines, failed = done(api, work, files=[{"glob": f"{archive}/2020/*"}], psf_id=psf_id, output=output)
    assert lines == [] and list(failed.values()) == ["output-name-taken"]
    assert (out / "one.fits").read_text() == "a letter"


def test_a_link_in_the_output_folder_is_not_followed_out_of_it(
    api: TestClient, work: Work, archive: Path, out: Path, psf_id: str
) -> None:
    (out / "elsewhere").mkdir(parents=True)
    (out / "run").mkdir()
    (out / "run" / "2020").symlink_to(out / "elsewhere")
    output = {"folder": str(out / "run"), "layout": "{folder}/{stem}.fits"}
    lines, failed = done(api, work, files=[{"glob": f"{archive}/202[01]/*"}], psf_id=psf_id, output=output)
    assert failed == {f"{archive}/2020/one.fits": "path-not-allowed"}
    assert [line["output"] for line in lines] == [str(out / "run" / "2021" / "one.fits")]
    assert list((out / "elsewhere").iterdir()) == []
