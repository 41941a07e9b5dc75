"""A worker process of a test's own."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from workers.catalogue.catalogue import Catalogue
from workers.settings import Settings

STOPS_WITHIN_S = 30.0
_LIGHT = """
import contextlib, sys, time, types
sys.modules["psfcore.kernel_files"] = types.SimpleNamespace(listening=lambda report: contextlib.nullcontext())
import workers.run.runner
workers.run.runner.load_tasks = lambda: None
{task}
sys.modules["workers.tasks.psf_build"] = types.SimpleNamespace(psf_build=task)
from workers.run.worker import main
main({options})
"""


@contextmanager
def new_catalogue(settings: Settings) -> Iterator[Catalogue]:
    """The catalogue of a new data folder, with its tables."""
    settings.data_dir.mkdir()
    catalogue = Catalogue(settings.catalogue_url)
    catalogue.upgrade()
    yield catalogue
    catalogue.close()


def worker_of(task: str, options: str = "") -> str:
    """The code of a worker whose jobs of the kind psf-build call the function ``task`` that this text defines.

    The worker loads no numerical libraries, so that it starts quickly. options: arguments of its main function.
    """
    return _LIGHT.format(task=task, options=options)


@contextmanager
def started_worker(
    code: str, settings: Settings, log: Path, **changes: float | str
) -> Iterator[subprocess.Popen[bytes]]:
    """A process that runs this code with the data folder and the broker of the settings; its lines go into a file.

    changes: further settings by name. If the process still runs at the end of the block, it is stopped.
    """
    environment = {name: value for name, value in os.environ.items() if not name.startswith("HELIOPSF_")} | {
        "HELIOPSF_DATA_DIR": str(settings.data_dir),
        "HELIOPSF_BROKER_URL": settings.broker_url,
        "HELIOPSF_LOG_FORMAT": "json",
        "OMP_NUM_THREADS": "1",
    }
    environment |= {f"HELIOPSF_{name.upper()}": str(value) for name, value in changes.items()}
    command = [sys.executable, "-c", code]
    with (
        log.open("wb") as written,
        subprocess.Popen(command, env=environment, stdout=subprocess.DEVNULL, stderr=written) as process,
    ):
        try:
            yield process
        finally:
            process.terminate()
            try:
                process.wait(STOPS_WITHIN_S)
            except subprocess.TimeoutExpired:
                process.kill()
