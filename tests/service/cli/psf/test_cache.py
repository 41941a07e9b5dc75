"""The command ``heliopsf cache``: lists and removes the built PSFs that are kept."""

from __future__ import annotations

from pathlib import Path

from click.testing import CliRunner

from service.cli.main import main
from tests.conftest import SMALL_INSTRUMENT


def run(*words: str) -> str:
    done = CliRunner().invoke(main, list(words))
    assert done.exit_code == 0, done.output
    return done.output


def test_the_cache_is_listed_and_cleared(tmp_path: Path) -> None:
    assert run("cache", "list").startswith("0 PSFs, 0.0 of 2048 MiB")
    (tmp_path / "small.toml").write_text(SMALL_INSTRUMENT)
    run("psf", "build", "--instrument", str(tmp_path / "small.toml"), "--size", "64", "-o", str(tmp_path / "a.fits"), "--local")  # fmt: skip
    listed = run("cache", "list").splitlines()
    assert len(listed) == 2 and listed[0].endswith("your instrument file, 64 px")
    assert listed[1].startswith("1 PSFs")
    assert run("cache", "clear").startswith("removed 1 PSFs")
    assert run("cache", "list").startswith("0 PSFs")


def test_a_wrong_size_is_told_in_one_line() -> None:
    done = CliRunner(env={"HELIOPSF_CACHE_MIB": "much"}).invoke(main, ["cache", "list"])
    assert done.exit_code == 1
    assert done.output.startswith("Error: HELIOPSF_CACHE_MIB: expected a whole number")
