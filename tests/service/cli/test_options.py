"""What the commands share: limits of the operator's, folders checked first, errors in one line.
The progress that commands tell: a bar on a terminal, lines elsewhere, and the time left in a count of steps."""

from __future__ import annotations

import json
from pathlib import Path

import click
import numpy as np
import pytest
from astropy.io import fits
from click.testing import CliRunner

from psfcore.errors import DataError
from psfcore.fits.header import seen_by
from psfcore.instruments.unknown import unknown_instrument
from service.cli import options as cli_options
from service.cli import progress
from service.cli.local import Local
from service.cli.main import NO_KEY, main, user_errors
from service.cli.progress import Pace, progress_bar, say
from service.client.http import ServiceError
from tests.conftest import write_image, write_psf
from workers.contract.kinds import Kind
from workers.tasks.workspace import Workspace


@pytest.fixture
def psf_file(tmp_path: Path) -> Path:
    kernel = np.zeros((33, 33))
    kernel[16, 16] = 1.0
    fits.PrimaryHDU(kernel).writeto(tmp_path / "psf.fits")
    return tmp_path / "psf.fits"


def test_a_command_reads_as_many_pixels_as_the_settings_let_it(
    psf_file: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert CliRunner().invoke(main, ["psf", "query", str(psf_file)]).exit_code == 0
    monkeypatch.setenv("HELIOPSF_MAX_PSF_PIXELS", str(32 * 32))
    for command in (["query"], ["show"]):
        result = CliRunner().invoke(main, ["psf", *command, str(psf_file)])
        assert result.exit_code == 1
        assert str(32 * 32) in result.output.replace(",", "")


def test_an_error_of_the_user_is_a_line_and_an_error_of_ours_keeps_its_traceback() -> None:
    no_key = ServiceError("expected a key: 'Authorization: Bearer ...'", status=401, code="no-key")
    for error, told in (
        (DataError("code", "expected a; got b"), "expected a; got b"),
        (ServiceError("refused"), "refused"),
        (OSError("disk full"), "disk full"),
        (TimeoutError("late"), "late"),
        (no_key, NO_KEY),
    ):
        with pytest.raises(click.ClickException) as caught, user_errors():
            raise error
        assert caught.value.message == told
    with pytest.raises(ZeroDivisionError), user_errors():
        raise ZeroDivisionError


def test_json_is_written_where_a_path_is_given_and_holds_no_nan(tmp_path: Path) -> None:
    cli_options.write_json(None, {"x": 1})
    cli_options.write_json(tmp_path / "x.json", {"x": 1})
    assert json.loads((tmp_path / "x.json").read_text()) == {"x": 1}
    with pytest.raises(ValueError, match="JSON"):
        cli_options.write_json(tmp_path / "y.json", {"x": float("nan")})
    assert not (tmp_path / "y.json").exists()
    with pytest.raises(ServiceError, match="cannot write"):
        cli_options.write_json(tmp_path, {"x": 1})


def test_an_image_without_a_known_psf_prints_the_ways_on(tmp_path: Path, image_file: Path) -> None:
    """Through --local and through a service, whose error has the same fields."""
    arguments = ["deconvolve", str(image_file), "-o", str(tmp_path / "o.fits"), "--local"]
    result = CliRunner().invoke(main, arguments)
    assert result.exit_code == 1 and not (tmp_path / "o.fits").exists()
    lines = result.output.splitlines()
    assert len(lines) == 4 and "TEST" in lines[0], result.output
    assert "--psf FILE.toml" in lines[2] and "psf fit TRANSIT" in lines[3] and "--local" in lines[3]
    psf = {"id": "a" * 64, "name": "p", "version": "1", "status": "draft", "same": ["plate_scale"]}
    error = unknown_instrument(seen_by(fits.Header({"INSTRUME": "TRACE"})), [psf])
    with pytest.raises(click.ClickException) as caught, user_errors():
        raise ServiceError(str(error), code=error.code, fields=error.fields)
    lines = caught.value.message.splitlines()
    assert len(lines) == 4 and lines[0].endswith(error.fields["reason"])
    assert f"--psf ID, such as {12 * 'a'} (p 1)" in lines[2] and "--local" not in caught.value.message


def test_a_folder_stands_for_its_fits_files(tmp_path: Path) -> None:
    for name in ("b.fits.fz", "a.fts.gz", "._a.fits", "notes.txt"):
        (tmp_path / name).touch()
    first, second, notes = (tmp_path / name for name in ("a.fts.gz", "b.fits.fz", "notes.txt"))
    assert cli_options.fits_files([notes, second, tmp_path]) == [notes, second, first]


def test_warnings_of_a_product_are_printed(tmp_path: Path) -> None:
    write_image(tmp_path / "i.fits", WAVELNTH=193)
    write_psf(tmp_path / "p.fits")
    fits.setval(tmp_path / "p.fits", "WAVELNTH", value=171)
    line = f"deconvolve {tmp_path}/i.fits -o {tmp_path}/o.fits --psf {tmp_path}/p.fits --steps 2 --local"
    arguments = line.split()
    refused = CliRunner().invoke(main, arguments)
    assert refused.exit_code == 1 and "--other-channel" in refused.output
    taken = CliRunner().invoke(main, [*arguments, "--other-channel"])
    assert taken.exit_code == 0 and "warning: the PSF" in taken.stderr and "193 angstrom" in taken.stderr


def test_a_minus_is_no_name_of_an_output(image_file: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for line in ("deconvolve IMAGE -o - --local", "simulate transit -o -"):
        monkeypatch.chdir(image_file.parent)
        refused = CliRunner().invoke(main, line.replace("IMAGE", str(image_file)).split())
        assert refused.exit_code == 2 and "'./-' is a file of this name" in refused.output
        assert not (image_file.parent / "-").exists()


# --- progress --------------------------------------------------------------------------------------------


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> list[float]:
    """The time in its only entry, s."""
    now = [100.0]
    monkeypatch.setattr(progress.time, "monotonic", lambda: now[0])
    return now


def test_the_time_left_counts_this_count_of_steps_alone_and_shrinks_while_a_step_lasts() -> None:
    """Reading took 250 s; then each of ten steps takes 1 s; then the count begins again, 2 s a step."""
    pace = Pace()
    assert pace.left_s(0, 5, 0.0) is None
    assert pace.left_s(4, 5, 240.0) == pytest.approx(60.0)
    assert pace.left_s(5, 5, 250.0) == 0.0
    assert pace.left_s(1, 11, 251.0) is None, "one report has no pace"
    assert pace.left_s(2, 11, 252.0) == pytest.approx(9.0)
    assert pace.left_s(5, 11, 255.0) == pytest.approx(6.0)
    assert pace.left_s(0, 11, 400.0) is None, "the same number of steps, a new round"
    assert [pace.left_s(1, 11, 402.0 + wait) for wait in (0, 5, 50)] == pytest.approx([20.0, 15.0, 0.0])


def test_a_terminal_shows_a_bar(
    clock: list[float], monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr("sys.stderr.isatty", lambda: True)
    with progress_bar() as report:
        report("reading", 1, 4)
        clock[0] += 3
        report("reading", 2, 4)
        say("the service answers again")
        report("nothing to do", 0, 0)
        report("\x1b[2J", 0, 0)
        say("\x1b[2J")
    told = capsys.readouterr().err
    assert f"[{'#' * 10}{'-' * 10}] 2/4    3.0 s, 6 s left" in told
    assert "\nthe service answers again\n" in told and "0/0    3.0 s              " in told
    assert "\x1b" not in told and told.endswith("\\x1b[2J\n")


def test_without_a_terminal_a_line_is_written_now_and_then(
    clock: list[float], capsys: pytest.CaptureFixture[str]
) -> None:
    with progress_bar() as report:
        for second in range(25):
            report("reading" if second < 12 else "fitting", second % 12, 24)
            clock[0] += 1
        say("a note")
    told = capsys.readouterr().err.splitlines()
    assert told == [
        "reading: step 10 of 24 after 10 s, 14 s left",
        "fitting: step 8 of 24 after 20 s, 16 s left",
        "a note",
    ]


def test_a_job_that_takes_longer_than_estimated_tells_its_steps(
    clock: list[float], capsys: pytest.CaptureFixture[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A job whose estimate is 20 s."""

    def task(workspace: Workspace, _: object) -> str:
        for second in range(45):
            workspace.report("fit (1 of 4): errors", second, 60)
            clock[0] += 1
        return "0"

    monkeypatch.setattr(Kind, "load_task", lambda _: task)
    monkeypatch.setattr(Local, "_expected_s", lambda *_: 20.0)
    with progress_bar() as report:
        service = Local(tmp_path)
        job = service.submit("psf-build", instrument="hri_euv")
        service.wait(job, progress=report)
    assert capsys.readouterr().err.splitlines() == [
        "fit (1 of 4): errors: 50 % of the estimated time after 10 s, 10 s left",
        "fit (1 of 4): errors: step 20 of 60 after 20 s",
        "fit (1 of 4): errors: step 30 of 60 after 30 s, 30 s left",
        "fit (1 of 4): errors: step 40 of 60 after 40 s, 20 s left",
    ]
