"""The stage of a job while its kernels are compiled, and the stages of a deconvolution with errors."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from threading import Thread
from typing import Any

import pytest

from psfcore.compiled import KernelFiles, listening
from tests.in_process import InProcess
from workers.catalogue.catalogue import Catalogue
from workers.catalogue.tables import DEFAULT_OWNER
from workers.files.store import Store
from workers.run.attempt import COMPILING
from workers.run.runner import Runner
from workers.settings import Settings
from workers.tasks.context import Context


def test_a_job_that_compiles_says_so(
    tmp_path: Path, settings: Settings, catalogue: Catalogue, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A kernel is compiled after its file was looked for in vain, and before its file is written."""
    files = KernelFiles(str(tmp_path), "f.py311", "source")
    told: list[tuple[str, int, int]] = []
    stages: list[str] = []

    def task(context: Context, _: Mapping[str, Any]) -> str:
        context.report("reading", 0, 20)
        for _time in range(2):
            if files.load(("float32",)) is None:
                row = context.catalogue.jobs.get(context.job_id)
                stages.append("" if row is None else row.stage)
                files.save(("float32",), "code")
            context.report("deconvolving", 1, 20)
        stages.extend(sorted(context.times.spent))
        return "0" * 64

    monkeypatch.setattr("workers.tasks.psf_build.psf_build", task)
    job, _ = catalogue.jobs.submit("psf-build", {}, "k", DEFAULT_OWNER)
    runner = Runner(settings, catalogue, Store(settings.data_dir))
    runner.run(job.id, lambda *progress: told.append(progress))
    assert told == [("reading", 0, 20), (COMPILING, 0, 1), ("deconvolving", 1, 20), ("deconvolving", 1, 20)]
    assert stages == [COMPILING, COMPILING, "deconvolving", "reading", "starting"]


def test_only_the_thread_that_listens_is_told(tmp_path: Path) -> None:
    files, told = KernelFiles(str(tmp_path), "f.py311", "source"), []
    with listening(told.append):
        other = Thread(target=lambda: files.load(("float64",)))
        other.start()
        other.join()
        assert told == []
        files.load(("float32",))
        files.save(("float32",), "code")
        assert files.load(("float32",)) == "code" and told == [False, True]
    files.load(("float64",))
    assert told == [False, True]


def test_noise_realisations_are_a_stage_of_their_own(
    local: InProcess, image_file: Path, psf_file: Path
) -> None:
    told: list[tuple[str, int, int]] = []
    local.deconvolve(
        image_file,
        psf_id=local.upload_psf(psf_file)["id"],
        steps=2,
        noise=(5.0, 2.0),
        error_draws=3,
        progress=lambda *progress: told.append(progress),
    )
    draws = [step for stage, step, steps in told if stage == "error estimate" and steps == 3]
    assert draws == [0, 0, 1, 2, 3]
    last = told.index(("deconvolving", 2, 2))
    assert told[last + 1] == ("error estimate", 0, 3), "at once, before the first of them is done"
