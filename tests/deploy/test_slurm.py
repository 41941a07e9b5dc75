"""The scripts for Slurm, run as Slurm runs them, with a command `heliopsf` that only says how it was called."""

from __future__ import annotations

import os
import subprocess
from pathlib import Path

from tests.deploy.test_units import command_exists

SLURM = Path(__file__).parents[2] / "deploy" / "slurm"


def called(script: str, folder: Path, *arguments: str, **variables: str) -> list[str]:
    """The words of the command `heliopsf` that the script calls, and the number of its threads."""
    stand_in = folder / "heliopsf"
    stand_in.write_text('#!/bin/bash\nprintf "%s\\n" heliopsf "$@" "$HELIOPSF_WORKER_THREADS"\n')
    stand_in.chmod(0o755)
    environment = {"PATH": f"{folder}:{os.environ['PATH']}", "HOME": str(folder), "SLURM_CPUS_PER_TASK": "8"}
    done = subprocess.run(
        ["bash", str(SLURM / script), *arguments], env=environment | variables,
        capture_output=True, text=True, check=True, timeout=60,
    )  # fmt: skip
    return done.stdout.splitlines()


def test_an_array_of_workers_runs_until_idle(tmp_path: Path) -> None:
    (tmp_path / "heliopsf.env").touch()
    *command, threads = called("workers.sh", tmp_path)
    command_exists(command[:2])
    assert command == ["heliopsf", "worker", "--until-idle", "60"] and threads == "8"


def test_the_tasks_of_an_array_share_the_images(tmp_path: Path) -> None:
    images = [tmp_path / f"image {number}.fits" for number in range(7)]
    for image in images:
        image.touch()
    shares = []
    for task in (1, 2, 3):
        array = {"SLURM_ARRAY_TASK_ID": str(task), "SLURM_ARRAY_TASK_MIN": "1", "SLURM_ARRAY_TASK_COUNT": "3"}
        words = called("images.sh", tmp_path, str(tmp_path), "out", **array)
        command_exists(words[:2])
        assert words[-4:-1] == ["-o", "out/", "--local"]
        shares.append(words[2:-4])
    assert sorted(path for share in shares for path in share) == sorted(map(str, images))
    assert [len(share) for share in shares] == [3, 2, 2]
