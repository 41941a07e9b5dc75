"""The package that people import, as they use it: light to import, typed, equal to what it is made of, and drawn."""

from __future__ import annotations

import copy
import gzip
import json
import os
import pickle
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import fields, replace
from datetime import UTC, datetime
from functools import partial
from importlib.metadata import version
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import matplotlib
import numpy as np
import pytest
from astropy.io import fits
from click.testing import CliRunner
from matplotlib.figure import Figure

import heliopsf
from heliopsf import transits
from psfcore.build import known_diffraction
from psfcore.deconvolve.conditions import Conditions
from psfcore.deconvolve.methods.registry import method_named
from psfcore.fits.blocks import LIMITS
from psfcore.fits.observation import read_observation
from psfcore.gap import diagnose
from psfcore.scatter.fit import TransitFit
from psfcore.simulate.transit import write
from psfcore.transit.transit import Transit
from service.cli.main import main
from tests.conftest import write_image, write_psf
from tests.fitted_psfs import EARLY, LATE, fitted_psf, interpolated_on_a_small_grid, write_fitted
from tests.psfcore.small_transits import fitted, observed, sky

HEAVY = {"astropy", "celery", "fastapi", "httpx", "matplotlib", "numba", "numpy"}
HEAVY |= {"pydantic", "scipy", "sqlalchemy"}


@pytest.fixture(scope="module", autouse=True)
def _small_grid() -> Iterator[None]:
    with interpolated_on_a_small_grid():
        yield


def test_what_an_import_loads() -> None:
    """Of heliopsf itself nothing heavy, of the client no numerics, of the functions no server, of the core no extra."""
    numerics, servers = {"numba", "scipy", "numpy", "astropy"}, {"fastapi", "sqlalchemy", "celery"}
    extras = {"threadpoolctl", "matplotlib", "sunpy", "jinja2", "click"}
    functions = servers | {"httpx", "service", "sunpy", "matplotlib"}
    for code, needed, refused in (
        ("import heliopsf; dir(heliopsf)", "heliopsf", HEAVY | {"psfcore", "service", "workers"}),
        ("from heliopsf import Client; Client('http://127.0.0.1:1').close()", "httpx", numerics | servers),
        (
            "from heliopsf import deconvolve, build_psf, read_psf, fit_scatter, diagnose_gap",
            "psfcore.scatter.fit",
            functions,
        ),
        (
            "from heliopsf import deconvolve, build_psf, psf_for, Psf, Deconvolution; import psfcore.build",
            "psfcore.build",
            extras,
        ),
    ):
        script = f"{code}\nimport sys, json; print(json.dumps(sorted(sys.modules)))"
        done = subprocess.run([sys.executable, "-c", script], check=True, capture_output=True, text=True)
        loaded = set(json.loads(done.stdout.splitlines()[-1]))
        assert needed in loaded and loaded & refused == set(), code
        if refused is functions:
            ours = {name for name in loaded if name.startswith("workers.")}
            assert ours == {"workers.machine"}


def test_every_name_is_there_with_a_docstring_and_no_other() -> None:
    for name in heliopsf.__all__:
        assert getattr(heliopsf, name).__doc__, name
    assert sorted(dir(heliopsf)) == sorted([*heliopsf.__all__, "__version__"])
    assert heliopsf.__version__ == version("heliopsf")
    with pytest.raises(AttributeError, match="no attribute 'evaluate'"):
        heliopsf.evaluate  # noqa: B018
    assert (Path(heliopsf.__file__).parent / "py.typed").is_file()


def test_an_image_is_deconvolved_as_the_core_does(tmp_path: Path) -> None:
    write_image(tmp_path / "image.fits", WAVELNTH=171)
    write_psf(tmp_path / "psf.fits")
    fits.setval(tmp_path / "psf.fits", "WAVELNTH", value=171)
    steps: list[tuple[int, int]] = []
    paths = tmp_path / "image.fits", tmp_path / "psf.fits"
    result = heliopsf.deconvolve(*paths, steps=3, progress=lambda step, of: steps.append((step, of)))
    psf, image = heliopsf.read_psf(paths[1]), read_observation(paths[0], LIMITS)
    again = heliopsf.deconvolve(image, psf, steps=3)
    np.testing.assert_array_equal(result.pixels, again.pixels)
    core = method_named("richardson-lucy")(image, psf, Conditions(), steps=3)
    np.testing.assert_array_equal(result.pixels, core.pixels)
    assert steps[-1] == (3, 3) and result.steps_done == 3


@pytest.mark.filterwarnings("ignore::psfcore.errors.DataWarning")
def test_a_result_is_copied_and_goes_to_another_process(psf: heliopsf.Psf) -> None:
    pixels = 100 + 50 * np.random.default_rng(1).random((64, 80))
    cases: tuple[dict[str, Any], ...] = (
        {},
        {"noise": (5.0, 2.0), "error_draws": 2},
        {"region": np.s_[10:40, 20:60]},
    )
    for asked in cases:
        result = heliopsf.deconvolve(pixels, psf, steps=2, full=True, **asked)
        for again in (pickle.loads(pickle.dumps(result)), copy.deepcopy(result)):
            for name in ("pixels", "quality", "error"):
                np.testing.assert_array_equal(getattr(again, name), getattr(result, name))
            assert again.changes == result.changes and again.lines() == result.lines(), asked


def test_a_psf_is_written_as_its_name_says(psf: heliopsf.Psf, tmp_path: Path) -> None:
    psf.write(tmp_path / "psf.fits")
    psf.write(tmp_path / "psf.fits.gz")
    assert gzip.decompress((tmp_path / "psf.fits.gz").read_bytes()) == (tmp_path / "psf.fits").read_bytes()
    np.testing.assert_array_equal(heliopsf.read_psf(tmp_path / "psf.fits.gz").kernel, psf.kernel)
    with pytest.raises(OSError, match=r"\.fits\.gz"):
        psf.write(tmp_path / "psf.fits.fz")


@pytest.mark.filterwarnings("ignore::psfcore.errors.DataWarning")
def test_a_deconvolution_is_written_as_the_command_writes_it(psf: heliopsf.Psf, tmp_path: Path) -> None:
    image, weights, written, output = (tmp_path / f"{name}.fits" for name in ("image", "psf", "mine", "out"))
    write_image(image, WAVELNTH=171, CDELT1=2.0, CDELT2=2.0)
    psf.write(weights)
    result = heliopsf.deconvolve(image, weights, steps=2, noise=(5.0, 2.0), error_draws=2)
    result.write(written)
    options = ["--psf", str(weights), "--steps", "2", "--noise", "5", "2", "--errors", "2", "--local"]
    told = CliRunner().invoke(main, ["deconvolve", str(image), "-o", str(output), *options])
    assert told.exit_code == 0, told.output
    of_request = ("PRODID", "INPSHA", "FILENAME", "HISTORY", "CHECKSUM", "DATASUM", "DATE")
    with fits.open(written) as mine, fits.open(output) as of_command:
        assert [one.name for one in mine] == [one.name for one in of_command]
        for one, other in zip(mine, of_command, strict=True):
            np.testing.assert_array_equal(one.data, other.data)
        cards, others = (
            {key: value for key, value in one[0].header.items() if key not in of_request}
            for one in (mine, of_command)
        )
        assert cards == others and mine[0].header["FILENAME"] == "mine.fits"
        assert set(mine[0].header["HISTORY"]) < set(of_command[0].header["HISTORY"])
    with pytest.raises(heliopsf.DataError, match="output-exists"):
        result.write(written)
    result.write(written, overwrite=True)
    with pytest.raises(heliopsf.DataError, match="already-deconvolved"):
        heliopsf.deconvolve(written, weights)


def test_errors_have_a_code_and_what_is_not_sure_is_a_warning(
    tmp_path: Path,
) -> None:
    (tmp_path / "text.fits").write_text("no FITS" * 1000)
    with pytest.raises(heliopsf.DataError, match="not-fits"):
        heliopsf.read_psf(tmp_path / "text.fits")
    with pytest.raises(heliopsf.ServiceError):
        heliopsf.Client("http://127.0.0.1:1").health()
    with pytest.raises(heliopsf.DataError, match=r"known_psf.*hri_euv.*got my-telescope"):
        known_diffraction("my-telescope")
    write_image(tmp_path / "image.fits", WAVELNTH=193)
    write_psf(tmp_path / "psf.fits")
    paths = (tmp_path / "image.fits", tmp_path / "psf.fits")
    with pytest.warns(UserWarning, match="were not compared"):
        heliopsf.deconvolve(*paths, steps=1)
    fits.setval(tmp_path / "psf.fits", "WAVELNTH", value=171)
    with pytest.raises(heliopsf.DataError, match="channel-mismatch"):
        heliopsf.deconvolve(*paths, steps=1)
    with pytest.warns(UserWarning, match="193 angstrom"):
        heliopsf.deconvolve(*paths, steps=1, other_channel=True)


def test_a_transit_is_fitted_and_the_fit_drawn(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The fit is that of psfcore, which other tests use too."""
    write(observed(sky()), tmp_path / "transit")
    asked: list[dict[str, Any]] = []

    def fit_transit(transit: Transit, **how: Any) -> TransitFit:
        np.testing.assert_allclose(transit.frames[0].pixels, fitted().transit.frames[0].pixels, atol=1.0)
        asked.append(how)
        return replace(fitted(), transit=transit)

    monkeypatch.setattr(transits, "fit_transit", fit_transit)
    fit = heliopsf.fit_scatter(tmp_path / "transit", threads=2, seed=4)
    assert [(how["threads"], how["seed"], how["shape"]) for how in asked] == [(2, 4, "softened-power-law")]
    assert isinstance(fit, heliopsf.ScatterFit)
    psf = fit.psf(version="0.3.0")
    psf.write(tmp_path / "fitted.fits")
    again = heliopsf.read_psf(tmp_path / "fitted.fits")
    assert (again.version, again.name) == ("0.3.0", psf.name) and again.fitted is not None
    assert again.fitted.coordinates == pytest.approx(fit.inversion.coordinates)
    assert set(psf.provenance["inputs_sha256"]) == set(fit.transit.sha256) and fit.transit.sha256
    axes = fit.plot(Figure().subplots())
    np.testing.assert_array_equal(axes.lines[0].get_ydata(), fit.curve.pct)
    assert len(axes.collections) == 2 and len(fit.quicklook().axes) >= 6
    with pytest.raises(heliopsf.DataError, match="transit"):
        heliopsf.diagnose_gap(tmp_path)


def test_a_gap_is_diagnosed_with_the_coverage_that_was_asked_for(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    write(observed(sky()), tmp_path / "transit")
    asked: list[dict[str, object]] = []
    found = SimpleNamespace(**dict.fromkeys(one.name for one in fields(diagnose.Diagnosis)))
    monkeypatch.setattr(diagnose, "diagnose", lambda transit, **how: asked.append(how) or found)
    heliopsf.diagnose_gap(tmp_path / "transit", coverage=0.7, seed=4)
    heliopsf.diagnose_gap(tmp_path / "transit")
    assert [(how["coverage"], how["seed"]) for how in asked] == [(0.7, 4), (0.9, 1)]


@pytest.fixture(autouse=True)
def _no_windows() -> Iterator[None]:
    matplotlib.use("agg")
    yield
    from matplotlib import pyplot

    pyplot.close("all")


def test_a_psf_and_a_deconvolution_are_drawn(psf: heliopsf.Psf, tmp_path: Path) -> None:
    left, right = Figure().subplots(1, 2)
    assert psf.plot(left, size=33) is left and psf.plot_curve(right) is right
    np.testing.assert_array_equal(left.images[0].get_array(), psf.kernel[16:49, 16:49])
    radii, light = right.lines[0].get_data()
    np.testing.assert_allclose(light, psf.light_beyond(radii))
    assert psf.plot() is not psf.plot()
    assert psf.version in psf.plot_curve().get_title()
    psf.quicklook().savefig(tmp_path / "psf.png")
    assert (tmp_path / "psf.png").read_bytes().startswith(b"\x89PNG")
    write_image(tmp_path / "image.fits", WAVELNTH=171, CDELT1=2.0, CDELT2=2.0)
    result = heliopsf.deconvolve(tmp_path / "image.fits", psf)
    before, after = Figure().subplots(1, 2)
    assert result.plot(before) is before and result.plot_change(after) is after
    np.testing.assert_array_equal(before.images[0].get_array(), result.pixels)
    change = 100 * (result.pixels / result.image.pixels - 1)
    np.testing.assert_allclose(after.images[0].get_array(), change)
    assert [axes.get_title(loc="left")[:6] for axes in result.quicklook().axes[:3:2]] == ["Before", "After "]
    assert result.changes["pixels"] > 0


TIMES = {"before_time": "2022-03-01", "after_time": "2023-03-01T00:00:00Z"}


def test_files_and_psfs_give_the_same_psf_between_two_times(tmp_path: Path) -> None:
    files = [write_fitted(tmp_path / f"{name}.fits", values) for name, values in (("a", EARLY), ("b", LATE))]
    psf = heliopsf.interpolate_psf(*files, **TIMES, time="2022-08-30T12:00:00")
    assert psf.fitted is not None and psf.name == "hri_euv-interpolated"
    middle = np.log(EARLY["b_px"] * LATE["b_px"]) / 2
    assert psf.fitted.coordinates[0] == pytest.approx(middle)
    at = datetime(2022, 8, 30, 12, tzinfo=UTC)
    same = heliopsf.interpolate_psf(heliopsf.read_psf(files[0]), files[1], **TIMES, time=at)
    np.testing.assert_array_equal(psf.kernel, same.kernel)
    psf.write(tmp_path / "between.fits")
    assert heliopsf.read_psf(tmp_path / "between.fits").fitted == psf.fitted
    given = {"before": fitted_psf(EARLY), "after": fitted_psf(LATE), **TIMES, "time": "2022-06-01"}
    wrong: list[tuple[dict[str, Any], str]] = [
        ({"time": "soon"}, "bad-time"),
        ({"time": 2022}, "bad-time"),
        ({"time": "2024-01-01"}, "time-outside-epochs"),
        ({"after_time": "2021-01-01"}, "epochs-not-in-order"),
        ({"after": fitted_psf(LATE | {"bend": 0.0}, shape="knee")}, "shapes-differ"),
    ]
    for changes, code in wrong:
        with pytest.raises(heliopsf.DataError, match=code):
            heliopsf.interpolate_psf(**(given | changes))


def test_a_file_of_the_user_that_hides_a_package_is_named(tmp_path: Path, subtests: pytest.Subtests) -> None:
    command = Path(sys.executable).with_name("heliopsf")
    for name, hiding in (
        ("service", tmp_path / "a" / "service.py"),
        ("workers", tmp_path / "b" / "workers" / "__init__.py"),
    ):
        with subtests.test(name):
            hiding.parent.mkdir(parents=True)
            hiding.write_text("raise RuntimeError('the file of the user ran')\n")
            folder = tmp_path / hiding.relative_to(tmp_path).parts[0]
            code = "import heliopsf\ntry:\n    heliopsf.deconvolve\nexcept ImportError as error:\n    print(error)"
            environment = {key: value for key, value in os.environ.items() if key != "PYTHONPATH"}
            run = partial(
                subprocess.run, cwd=folder, env=environment, capture_output=True, text=True, check=False
            )
            said = run([sys.executable, "-c", code])
            assert f"package {name!r}" in said.stdout and str(hiding) in said.stdout and said.stderr == "", (
                said
            )
            assert run([command, "--version"]).returncode == 0
