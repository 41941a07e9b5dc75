"""The command line as a whole: its headings, its length, old names, and what starting it loads.
Tab completion without imports, and Control-C."""

from __future__ import annotations

import json
import os
import shlex
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace

import click
import pytest
from click.testing import CliRunner

from service.cli.main import Lazy, LazyGroup, main, named_by_options, user_errors
from service.client.errors import WaitInterrupted
from tests.conftest import write_image

HEAVY = {
    "astropy",
    "celery",
    "fastapi",
    "httpx",
    "matplotlib",
    "numba",
    "numpy",
    "pydantic",
    "scipy",
    "sqlalchemy",
}
MOST_LINES = 60


def commands(group: click.Group, *path: str) -> Iterator[tuple[tuple[str, ...], click.Command]]:
    context = click.Context(group)
    for name in group.list_commands(context):
        command = group.get_command(context, name)
        assert command is not None
        yield (*path, name), command
        if isinstance(command, click.Group):
            yield from commands(command, *path, name)


ALL = list(commands(main))


def test_every_command_is_explained_and_its_options_are_named_alike() -> None:
    """The help fits a screen. A picture is --plot, numbers are --json, a result is -o/--output."""
    assert "\nImages:" in CliRunner().invoke(main, ["--help"]).output, "commands are grouped"
    for path, command in ALL:
        helped = CliRunner().invoke(main, [*path, "-h"])
        assert helped.exit_code == 0 and len(helped.output.splitlines()) < MOST_LINES, path
        assert command.help and command.name == path[-1], path
        options = [one for one in command.params if isinstance(one, click.Option)]
        assert [one.name for one in options if not one.hidden and not one.help] == [], path
        names = {name for option in command.params for name in option.opts}
        assert names & {"--preview", "--html", "--page", "--picture", "--out"} == set(), path
        assert "--output" in names or "-o" not in names, path
        said = " ".join(helped.output.split())
        if "--server" in names:
            assert ("--local needs none" in said) == ("--local" in names), path
        else:
            assert "--local" not in names, path


def test_a_misspelt_command_is_answered_with_the_close_one() -> None:
    for arguments, meant in ((["deconvolv"], "`deconvolve`"), (["psf", "sho"], "`show`")):
        refused = CliRunner().invoke(main, arguments)
        assert refused.exit_code == 2 and f"Did you mean {meant}" in refused.output
    unknown = CliRunner().invoke(main, ["xyzzy"])
    assert unknown.exit_code == 2 and "there is no command 'xyzzy'" in unknown.output
    assert "Did you mean" not in unknown.output


def test_without_arguments_up_to_three_commands_fit_the_folder(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)

    def commands_shown() -> list[list[str]]:
        shown = CliRunner().invoke(main, [])
        assert shown.exit_code == 0, shown.output
        return [shlex.split(line)[1:6] for line in shown.output.splitlines() if line.startswith("  heliopsf")]

    assert [row[0] for row in commands_shown()] == ["demo", "serve", "deconvolve"]
    write_image(tmp_path / "a psf.fits", PSFSUM=1.0)
    (tmp_path / "notes.txt").write_text("no image")
    assert commands_shown()[0][0] == "demo", "a PSF is not an image"
    write_image(tmp_path / "an image.fits")
    one = ["deconvolve", "an image.fits", "-o", "an image-deconvolved.fits", "--local"]
    assert commands_shown() == [one]
    (tmp_path / "many").mkdir()
    for number in range(3):
        write_image(tmp_path / "many" / f"{number}.fits")
    assert commands_shown() == [one, ["deconvolve", "many", "-o", "deconvolved/", "--local"]]
    (tmp_path / "mercury").mkdir()
    (tmp_path / "mercury" / "transit.json").write_text("{}")
    write_image(tmp_path / "mercury" / "0.fits")
    assert [row[:2] for row in commands_shown()] == [["report", "mercury"], ["gap", "mercury"], one[:2]]


def test_version_help_and_no_arguments_load_nothing_heavy() -> None:
    script = (
        "import sys, json, atexit\n"
        "atexit.register(lambda: print(json.dumps(sorted(sys.modules))))\n"
        "from service.cli.main import main\n"
        "main(sys.argv[1:])\n"
    )
    cases: list[tuple[list[str], str]] = [(["-V"], "heliopsf, version "), (["--help"], "Usage:"), ([], "")]
    for options, said in cases:
        command = [sys.executable, "-c", script, *options]
        done = subprocess.run(command, check=True, capture_output=True, text=True)
        loaded = set(json.loads(done.stdout.splitlines()[-1]))
        assert done.stdout.startswith(said) and "service.cli.main" in loaded and loaded & HEAVY == set()


# --- the groups of commands -----------------------------------------------------------------------------


def test_names_are_completed_without_importing_commands() -> None:
    group = LazyGroup(sections={"All": {"one": Lazy("no_such_module", "one", "The one.")}})
    found = group.shell_complete(click.Context(group), "o")
    assert [(item.value, item.help) for item in found] == [("one", "The one.")]


def test_control_c_ends_with_status_130_and_says_how_to_go_on(monkeypatch: pytest.MonkeyPatch) -> None:
    for stop, told in (
        (KeyboardInterrupt(), ["interrupted"]),
        (
            WaitInterrupted("job", "0123456789abcdef" * 2, "http://127.0.0.1:8765"),
            [
                "job 0123456789ab goes on",
                "heliopsf job wait 0123456789ab\n",
                "heliopsf job cancel 0123456789ab\n",
            ],
        ),
        (
            WaitInterrupted("job", "a" * 32, "http://127.0.0.1:8765", ("b" * 32, "c" * 32)),
            ["go on", "heliopsf job wait aaaaaaaaaaaa bbbbbbbbbbbb cccccccccccc\n"],
        ),
        (
            WaitInterrupted("bulk", "f" * 32, "http://127.0.0.1:9"),
            ["heliopsf bulk status ffffffffffff --wait --server http://127.0.0.1:9\n"],
        ),
    ):

        @click.command()
        def one() -> None:
            raise stop  # noqa: B023

        monkeypatch.setitem(sys.modules, "module_of_one", SimpleNamespace(one=one))  # type: ignore[arg-type]
        group = LazyGroup(sections={"All": {"one": Lazy("module_of_one", "one", "The one.")}})
        done = CliRunner().invoke(group, ["one"])
        assert done.exit_code == 130
        assert all(line in done.stderr for line in told), done.stderr


def test_a_reader_that_ends_first_ends_the_command_quietly() -> None:
    """The status is that of a command which SIGPIPE ended. A service that breaks its connection is another matter."""
    reading, writing = os.pipe()
    os.close(reading)
    script = "from service.cli.main import main; main(['psf', 'published'])"
    done = subprocess.run(  # our own script
        [sys.executable, "-c", script], stdout=writing, stderr=subprocess.PIPE, text=True, check=False
    )
    os.close(writing)
    assert (done.returncode, done.stderr) == (141, "")
    with pytest.raises(click.ClickException), user_errors():
        raise BrokenPipeError


@pytest.mark.parametrize(
    ("of_request", "option"),
    [
        ("parameters/size: even", "--size: even"),
        ("parameters/noise/photon_gain_dn: a; body/deconvolve/parameters/steps: b", "--noise: a; --steps: b"),
        ("parameters: Value error, error_draws: expected 0", "--errors: expected 0"),
        ("body: Value error, expected images", "expected images"),
        ("expected an id; got parameters/size: 3", "expected an id; got parameters/size: 3"),
    ],
)
def test_an_error_names_the_option_and_not_the_place_in_a_request(of_request: str, option: str) -> None:
    assert named_by_options(of_request) == option
