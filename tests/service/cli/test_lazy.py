"""Tab completion without imports, and Control-C."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import click
import pytest
from click.testing import CliRunner

from service.cli.main import Lazy, LazyGroup
from service.client.errors import WaitInterrupted

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
