"""The command line as a whole: its headings, its length, old names, and what starting it loads.
Tab completion without imports, and Control-C."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace

import click
import pytest
from click.testing import CliRunner

from service.cli.main import Lazy, LazyGroup, main
from service.cli.options import METHODS
from service.client.errors import WaitInterrupted

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


def test_the_help_of_a_command_fits_a_screen_and_explains_every_option(subtests: pytest.Subtests) -> None:
    for path in [path for path, _ in ALL]:
        with subtests.test(str(path)):
            helped = CliRunner().invoke(main, [*path, "-h"])
            assert helped.exit_code == 0 and len(helped.output.splitlines()) < MOST_LINES
            command = dict(ALL)[path]
            assert command.help
            unexplained = [
                option.name
                for option in command.params
                if isinstance(option, click.Option) and not option.hidden and not option.help
            ]
            assert unexplained == []


def test_the_help_says_when_to_use_which_method() -> None:
    lines = CliRunner().invoke(main, ["deconvolve", "-h"]).output.splitlines()
    rows = dict(line.split(None, 1) for line in lines[lines.index("  Methods:") + 1 :])
    assert list(rows) == list(METHODS) and len(set(rows.values())) == len(METHODS)


def test_the_help_is_grouped() -> None:
    lines = CliRunner().invoke(main, ["--help"]).output.splitlines()
    assert len(lines) < MOST_LINES
    headings = [line for line in lines if line.endswith(":") and not line.startswith(" ")]
    assert headings[1:] == [
        "Images:", "PSFs:", "Transits:", "Archives:", "Jobs:", "Service and operation:", "Studies:",
    ]  # fmt: skip


def test_options_have_the_same_name_everywhere() -> None:
    """A picture is --plot, numbers are --json, a result is -o/--output."""
    for path, command in ALL:
        names = {name for option in command.params for name in option.opts}
        assert names & {"--preview", "--html", "--page", "--picture", "--out"} == set(), path
        if "-o" in names:
            assert "--output" in names, path
        if "--local" in names:
            assert "--server" in names, path


def options_of(name: str) -> dict[str, click.Option]:
    """The option of this name, by the command that has it."""
    return {
        " ".join(path): option
        for path, command in ALL
        for option in command.params
        if isinstance(option, click.Option) and name in option.opts
    }


def test_an_option_is_explained_in_the_same_words_everywhere(subtests: pytest.Subtests) -> None:
    for name in ("--local", "--context", "--centre", "--key", "--saturation", "--method"):
        with subtests.test(str(name)):
            found = options_of(name)
            found.pop("simulate transit", None)  # its --saturation is the level of the simulated camera
            assert len(found) > 1
            assert len({(option.help, option.nargs, option.metavar) for option in found.values()}) == 1, (
                found.keys()
            )
    # The help of --noise also has the default, which is another one for images and for transits.
    assert {(option.nargs, option.metavar) for option in options_of("--noise").values()} == {(2, "GAIN READ")}


def test_a_psf_is_an_id_or_a_file_everywhere() -> None:
    shown = {name: (option.metavar, option.help) for name, option in options_of("--psf").items()}
    only_ids = {"context create", "product list"}
    assert {shown.pop(name)[0] for name in only_ids} == {"ID"}
    built = {"deconvolve", "changes"}  # the PSF of an instrument may be named too
    assert {shown[name][0] for name in built} == {"ID|FILE|NAME"}
    assert {shown[name][0] for name in shown.keys() - built} == {"ID|FILE"}
    assert all("an id or a file" in (text or "") for _, text in shown.values())


def test_the_help_says_whether_a_command_needs_a_service() -> None:
    for path, command in ALL:
        names = {name for option in command.params for name in option.opts}
        if "--server" not in names:
            continue
        helped = " ".join(CliRunner().invoke(main, [*path, "-h"]).output.split())
        needs, for_ids = "which this command needs" in helped, "only if a PSF is given by its id" in helped
        assert needs != for_ids, path
        assert ("--local needs none" in helped) == ("--local" in names), path


def test_the_version_is_told(subtests: pytest.Subtests) -> None:
    for option in ("-V", "--version"):
        with subtests.test(str(option)):
            assert CliRunner().invoke(main, [option]).output.startswith("heliopsf, version ")


def test_a_row_of_the_table_is_the_command_of_that_name() -> None:
    for path, command in ALL:
        assert command.name == path[-1], path
    groups = [main, *(group for _, group in ALL if isinstance(group, LazyGroup))]
    for group in groups:
        assert all(row.summary.endswith(".") for row in group.rows.values())


def test_a_misspelt_command_is_answered_with_the_close_one(subtests: pytest.Subtests) -> None:
    for arguments, meant in ((["deconvolv"], "`deconvolve`"), (["psf", "sho"], "`show`")):
        with subtests.test(str((arguments, meant))):
            refused = CliRunner().invoke(main, arguments)
            assert refused.exit_code == 2 and f"Did you mean {meant}" in refused.output


def test_an_unknown_name_is_refused() -> None:
    refused = CliRunner().invoke(main, ["xyzzy"])
    assert refused.exit_code == 2 and "there is no command 'xyzzy'" in refused.output
    assert "Did you mean" not in refused.output


def test_version_and_help_load_nothing_heavy(subtests: pytest.Subtests) -> None:
    for option in ("-V", "--help"):
        with subtests.test(str(option)):
            script = (
                "import sys, json, atexit\n"
                "atexit.register(lambda: print(json.dumps(sorted(sys.modules))))\n"
                f"sys.argv = ['heliopsf', {option!r}]\n"
                "from service.cli.main import main\n"
                "main()\n"
            )
            done = subprocess.run([sys.executable, "-c", script], check=True, capture_output=True, text=True)
            loaded = set(json.loads(done.stdout.splitlines()[-1]))
            assert "service.cli.main" in loaded and loaded & HEAVY == set()


# --- the groups of commands -----------------------------------------------------------------------------


# The function that `eval "$(_HELIOPSF_COMPLETE=bash_source heliopsf)"` defines, called as bash does when Tab is pressed.
TAB = """
eval "$(_HELIOPSF_COMPLETE=bash_source heliopsf)"
COMP_WORDS=({words})
COMP_CWORD={at}
_heliopsf_completion heliopsf
printf '%s\\n' "${{COMPREPLY[@]}}"
"""


@pytest.fixture(scope="module")
def command(tmp_path_factory: pytest.TempPathFactory) -> dict[str, str]:
    """An environment with the command `heliopsf` of this checkout."""
    folder = tmp_path_factory.mktemp("bin")
    script = folder / "heliopsf"
    script.write_text(f"#!{sys.executable}\nfrom service.cli.main import main\nmain(prog_name='heliopsf')\n")
    script.chmod(0o755)
    here = str(Path(__file__).parents[3])
    path = os.pathsep.join([here, *filter(None, [os.environ.get("PYTHONPATH")])])
    return os.environ | {"PATH": f"{folder}{os.pathsep}{os.environ['PATH']}", "PYTHONPATH": path}


@pytest.mark.skipif(shutil.which("bash") is None, reason="bash is missing")
def test_bash_completes_commands_and_options(subtests: pytest.Subtests, command: dict[str, str]) -> None:
    for words, found in (
        (["heliopsf", "des"], {"design"}),
        (["heliopsf", "psf", "l"], {"list", "lineage"}),
        (["heliopsf", "job", ""], {"list", "show", "wait", "cancel"}),
        (["heliopsf", "job", "wait", "--s"], {"--server"}),
    ):
        with subtests.test(str((words, found))):
            quoted = " ".join(f"'{word}'" for word in words)
            script = TAB.format(words=quoted, at=len(words) - 1)
            done = subprocess.run(
                ["bash", "-c", script], env=command, capture_output=True, text=True, check=True, timeout=60
            )
            assert set(done.stdout.split()) == found, done.stderr


def test_names_are_completed_without_importing_commands() -> None:
    group = LazyGroup(sections={"All": {"one": Lazy("no_such_module", "one", "The one.")}})
    found = group.shell_complete(click.Context(group), "o")
    assert [(item.value, item.help) for item in found] == [("one", "The one.")]


def test_control_c_ends_with_status_130_and_says_how_to_go_on(
    subtests: pytest.Subtests, monkeypatch: pytest.MonkeyPatch
) -> None:
    for stop, told in (
        (KeyboardInterrupt(), ["interrupted"]),
        (
            WaitInterrupted("job", "0123456789abcdef" * 2, "http://127.0.0.1:8765"),
            [
                "job 0123456789ab goes on",
                "run the same command again",
                "heliopsf job wait 0123456789ab\n",
                "heliopsf product get ID -o FILE",
                "heliopsf job cancel 0123456789ab\n",
            ],
        ),
        (
            WaitInterrupted("job", "a" * 32, "http://127.0.0.1:8765", ("b" * 32, "c" * 32)),
            [
                "jobs aaaaaaaaaaaa bbbbbbbbbbbb cccccccccccc go on",
                "heliopsf job wait aaaaaaaaaaaa bbbbbbbbbbbb cccccccccccc\n",
                "heliopsf job cancel aaaaaaaaaaaa bbbbbbbbbbbb cccccccccccc\n",
            ],
        ),
        (
            WaitInterrupted("bulk", "f" * 32, "http://127.0.0.1:9"),
            [
                "heliopsf bulk status ffffffffffff --wait --server http://127.0.0.1:9\n",
                "heliopsf bulk cancel ffffffffffff --server http://127.0.0.1:9\n",
            ],
        ),
    ):
        with subtests.test(str((stop, told))):

            @click.command()
            def one() -> None:
                raise stop  # noqa: B023

            monkeypatch.setitem(sys.modules, "module_of_one", SimpleNamespace(one=one))  # type: ignore[arg-type]
            group = LazyGroup(sections={"All": {"one": Lazy("module_of_one", "one", "The one.")}})
            done = CliRunner().invoke(group, ["one"])
            assert done.exit_code == 130
            assert all(line in done.stderr for line in told), done.stderr
