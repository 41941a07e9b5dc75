"""What a job is expected to need, what is refused for it, and what is stopped after all."""

from __future__ import annotations

import itertools
import re
import uuid
from functools import partial
from types import SimpleNamespace
from typing import Any

import pytest
from sqlalchemy import delete

from psfcore.errors import DataError
from psfcore.instruments.model import parse_instrument
from psfcore.instruments.workload import check_workload
from tests.conftest import SMALL_INSTRUMENT
from tests.workers.databases import add, change
from tests.workers.psf_examples import psf as psf_row
from tests.workers.psf_examples import refused
from workers.catalogue.catalogue import Catalogue
from workers.catalogue.tables import ImageRow, JobRow, TransitRow
from workers.contract.jobs import Phase
from workers.contract.requests import METHOD_MODELS, PsfBuild
from workers.intake import estimates
from workers.intake.estimates import BOUNDS, FEWEST_JOBS, KEEP_FACTOR_S, checked, estimate
from workers.settings import Settings

OWNER = "ann"


def image(catalogue: Catalogue, px: int) -> str:
    summary = {"shape": [px, px]}
    row = ImageRow(owner=OWNER, id=f"{px:064x}", created_at=0.0, bytes=1, filename=None, summary=summary)
    return catalogue.add(row)[0].id


def psf(catalogue: Catalogue, px: int, **details: Any) -> str:
    row = psf_row(str(px), owner=OWNER, details={"shape": [px, px], **details})
    return catalogue.add(row)[0].id


def deconvolution(catalogue: Catalogue, px: int = 1024, **changes: Any) -> dict[str, Any]:
    method = METHOD_MODELS["richardson-lucy"]().model_dump(mode="json") | changes.pop("method", {})
    wanted = {"image_id": image(catalogue, px), "psf_id": psf(catalogue, 512), "psf_recipe": None}
    return {**wanted, "method": method, "error_draws": 0, **changes}


def needs(
    catalogue: Catalogue, kind: str, parameters: dict[str, Any], threads: int = 1
) -> tuple[float, float]:
    found = estimate(kind, parameters, catalogue, OWNER, threads)
    return found.seconds, found.memory_mib


def test_more_to_do_needs_more(catalogue: Catalogue) -> None:
    base = needs(catalogue, "deconvolve", deconvolution(catalogue))
    bigger = needs(catalogue, "deconvolve", deconvolution(catalogue, 4096))
    assert bigger[0] > 8 * base[0] and bigger[1] > base[1] + 700
    steps = needs(catalogue, "deconvolve", deconvolution(catalogue, method={"steps": 200}))
    assert 3 * base[0] < steps[0] < 10 * base[0] and steps[1] == base[1]
    drawn = needs(catalogue, "deconvolve", deconvolution(catalogue, error_draws=16))
    assert drawn[0] > 3 * base[0] and drawn[1] > base[1]
    wide = needs(catalogue, "deconvolve", deconvolution(catalogue, method={"margin_px": 2048}))
    assert wide[0] > 5 * base[0] and wide[1] > base[1] + 300
    none = needs(
        catalogue, "deconvolve", deconvolution(catalogue, method={"edges": "zero", "margin_px": 2048})
    )
    assert none[0] <= base[0] and none[1] < base[1]
    threads = needs(catalogue, "deconvolve", deconvolution(catalogue), threads=4)
    assert threads == (pytest.approx(base[0] / 4, abs=0.1), base[1])


def test_a_psf_that_may_have_to_be_built_first_counts(catalogue: Catalogue) -> None:
    recipe = PsfBuild(instrument="hri_euv").model_dump(mode="json")
    there = deconvolution(catalogue, 256)
    missing = {**there, "psf_id": "f" * 64, "psf_recipe": recipe}
    built = needs(catalogue, "psf-build", recipe)
    assert needs(catalogue, "deconvolve", missing)[0] >= built[0] > needs(catalogue, "deconvolve", there)[0]
    rerun = {"kind": "psf-build", "parameters": recipe, "of": "psf", "id": "f" * 64}
    assert needs(catalogue, "rerun", rerun) == built


def test_a_psf_that_may_have_to_be_interpolated_first_counts(catalogue: Catalogue) -> None:
    end = psf(catalogue, 2048, fit={})
    interpolation = {"before_psf_id": end, "after_psf_id": end}
    there = deconvolution(catalogue, 256, psf_id=end)
    missing = {**there, "psf_id": "f" * 64, "psf_interpolation": interpolation}
    alone = needs(catalogue, "psf-interpolate", interpolation)
    assert alone[0] > needs(catalogue, "psf-interpolate", {"before_psf_id": psf(catalogue, 128)})[0]
    for draws in (0, 4):
        there, missing = ({**one, "error_draws": draws} for one in (there, missing))
        both = needs(catalogue, "deconvolve", there)[0] + alone[0]
        assert needs(catalogue, "deconvolve", missing)[0] == pytest.approx(both, abs=0.15)


def of_file(catalogue: Catalogue, text: str) -> tuple[float, float]:
    return needs(catalogue, "psf-build", PsfBuild(instrument_file=text).model_dump(mode="json"))


def test_an_instrument_file_that_asks_for_much_is_seen_for_it(catalogue: Catalogue) -> None:
    small = of_file(catalogue, SMALL_INSTRUMENT)[0]
    mesh = "{name='m',place='filter_wheel',pitch_um=9.0,wire_um=1.0,windows=9}"
    for key, entry, count, least_s in (
        ("bandpass", "{wavelength_angstrom=171.0,weight=1.0}", 64, 64),
        ("meshes", mesh, 16, 56),
    ):
        entries = f"{key} = [{','.join([entry] * count)}]\n[aperture]"
        large = of_file(catalogue, SMALL_INSTRUMENT.replace("[aperture]", entries))[0]
        assert large >= least_s > 10 * small, key


def test_an_instrument_file_of_extremes_can_be_estimated(catalogue: Catalogue) -> None:
    keys = ("wavelength_angstrom", "focal_length_mm", "diameter_mm", "pixel_pitch_um")
    mount = "\n[mount]\nbasis = 'assumed'\nrays = [{count = 4, width_mm = 1e-9}]\n"
    for extremes in itertools.product(("1e-9", "1e9"), repeat=4):
        text = SMALL_INSTRUMENT + mount
        for key, value in zip(keys, extremes, strict=True):
            text = re.sub(rf"(?m)^{key} = .*$", f"{key} = {value}", text)
        seconds, mib = of_file(catalogue, text)
        assert seconds > 0 and mib > 0, extremes
        try:
            check_workload(parse_instrument(text, "extreme.toml"), "extreme.toml")
        except DataError as error:
            assert error.code == "bad-instrument-file", extremes
        else:
            assert seconds < 600 and mib < 6000, extremes


def test_a_mask_image_counts(catalogue: Catalogue) -> None:
    build = {"instrument_file": SMALL_INSTRUMENT, "size": 64}
    plain = needs(catalogue, "psf-build", PsfBuild(**build).model_dump(mode="json"))
    masked = PsfBuild(**build, mask_id=image(catalogue, 4096)).model_dump(mode="json")
    assert needs(catalogue, "psf-build", masked)[1] >= plain[1] + 4096**2 * 3 * 8 / 2**20


def test_studies_go_with_the_transit_s_length(catalogue: Catalogue) -> None:
    for name, pixels in (("1", 10**6 // 4), ("2", 10**9 // 4)):
        summary = {"pixels": pixels}
        catalogue.add(
            TransitRow(owner=OWNER, id=name * 64, created_at=0.0, bytes=1, filename=None, summary=summary)
        )
    for kind, less, more, factor in (
        ("psf-fit", {"as_published": False}, {"as_published": True}, 5),
        ("report", {"shapes": None}, {"shapes": ["king"]}, 2),
        ("gap-diagnose", {}, {}, 1),
        ("cross-validate", {"scheme": "shared", "runs": 10}, {"scheme": "exact", "runs": 10}, 5),
    ):
        small, large, largest = (
            needs(catalogue, kind, {"transit_id": name * 64, "diffraction_recipe": None, **asked})
            for name, asked in (("1", less), ("2", less), ("2", more))
        )
        assert large[0] > 10 * small[0] and large[1] > 3 * small[1]
        assert largest[0] >= factor * large[0] and largest[1] == large[1]


def completed(catalogue: Catalogue, count: int, took_s: float, start_s: float = 1.0) -> None:
    """Add completed deconvolutions that were expected to take ``start_s`` and took so long."""
    rows = [
        JobRow(
            id=uuid.uuid4().hex,
            owner=OWNER,
            kind="deconvolve",
            parameters={},
            request_key=uuid.uuid4().hex,
            work_key="k",
            phase=Phase.COMPLETED,
            created_at=0.0,
            started_at=100.0,
            ended_at=100.0 + took_s,
            estimate={"memory_mib": 1, "seconds": start_s, "start_s": start_s},
        )
        for _ in range(count)
    ]
    add(catalogue, *rows)


def test_estimates_follow_completed_jobs(catalogue: Catalogue, monkeypatch: pytest.MonkeyPatch) -> None:
    now = [1000.0]
    monkeypatch.setattr(estimates, "time", SimpleNamespace(monotonic=lambda: now[0]))
    job = deconvolution(catalogue)
    start_s, memory = needs(catalogue, "deconvolve", job)
    for took_s, expected in (
        (3.0, 3.0),
        (0.5, 0.5),
        (50.0, BOUNDS[1]),  # much slower
        (0.06, BOUNDS[0]),  # much faster
        (0.001, 1.0),  # the result was there already
    ):
        change(catalogue, delete(JobRow))
        completed(catalogue, FEWEST_JOBS - 1, took_s)
        now[0] += 2 * KEEP_FACTOR_S
        assert needs(catalogue, "deconvolve", job) == (start_s, memory), "too few jobs to learn from"
        completed(catalogue, 1, took_s)
        assert needs(catalogue, "deconvolve", job) == (start_s, memory), "it is kept for a while"
        now[0] += 2 * KEEP_FACTOR_S
        seconds, same = needs(catalogue, "deconvolve", job)
        assert seconds == pytest.approx(start_s * expected, abs=0.2) and same == memory, took_s
        start = estimate("deconvolve", job, catalogue, OWNER, 1).start_s
        assert start == pytest.approx(start_s, abs=0.1)


def ratio(catalogue: Catalogue, px: int, **changes: Any) -> float:
    found = estimate("deconvolve", deconvolution(catalogue, px, **changes), catalogue, OWNER, 1)
    return found.seconds / found.start_s


def test_jobs_of_similar_size_count(catalogue: Catalogue) -> None:
    completed(catalogue, 5, 2.0)
    completed(catalogue, 5, 900.0, start_s=100.0)
    assert ratio(catalogue, 4096, error_draws=8) == pytest.approx(9.0, rel=0.01)
    assert ratio(catalogue, 1024) == pytest.approx(2.0, rel=0.05)


def test_one_long_job_is_enough(catalogue: Catalogue) -> None:
    completed(catalogue, 1, 300.0, start_s=100.0)
    assert ratio(catalogue, 4096, error_draws=8) == pytest.approx(3.0, rel=0.01)


def test_a_kind_without_figures_of_its_own_has_an_estimate(catalogue: Catalogue) -> None:
    seconds, memory = needs(catalogue, "brand-new", {"image_id": image(catalogue, 1024)})
    assert seconds > 0 and memory > 0


def test_what_is_over_a_limit_is_refused_and_told_how_to_get_under_it(catalogue: Catalogue) -> None:
    largest = {"name": "richardson-lucy-total-variation", "steps": 200}
    by_default = deconvolution(catalogue, 4096, method=largest)
    checked("deconvolve", by_default, catalogue, OWNER, Settings())
    asked = deconvolution(catalogue, 4096, error_draws=64)
    free = Settings(worker_threads=1)
    said = checked("deconvolve", asked, catalogue, OWNER, free)
    for setting, code, figure, way in (
        ("max_job_memory_mib", "too-much-memory", said["memory_mib"], "margin_px"),
        ("max_job_s", "too-much-time", f"{said['seconds']:g}", "fewer steps"),
    ):
        limited = free.model_copy(update={setting: 500})
        message = refused(code, partial(checked, "deconvolve", asked, catalogue, OWNER, limited))
        for told in (str(figure), "500", setting.upper(), way):
            assert told in message
