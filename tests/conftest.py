"""What tests of every layer share: real data where it is there, and small files made by simulation."""

from __future__ import annotations

import gc
import os
import random
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
import psutil
import pytest
from astropy.io import fits
from threadpoolctl import threadpool_limits

from psfcore.memory import return_unused_memory

REPOSITORY = Path(__file__).parents[1]
pytest_plugins = ("tests.chromium", "tests.shared_stack")

# The files that take longest, so that they are begun first: begun last, one of them would leave a core idle.
LONGEST_FIRST = (
    "psfcore/gap/test_diagnose.py",
    "service/pages/browser/test_every_page.py",
    "psfcore/test_build.py",
    "psfcore/scatter/test_fit.py",
    "whole/test_killed.py",
    "service/pages/browser/test_viewer.py",
    "service/pages/browser/test_waiting.py",
    "service/pages/browser/test_login.py",
    "workers/tasks/test_transit_jobs.py",
    "service/pages/browser/test_bulk.py",
    "service/pages/browser/test_product.py",
    "service/cli/test_transits.py",
    "workers/files/test_garbage.py",
    "service/pages/browser/test_way_through.py",
    "workers/run/test_stopping.py",
    "service/api/bulk/test_bulk.py",
)

# Files that use the same fits and diagnoses: one process runs all files of a row, so that it computes these once.
TOGETHER = {
    "gap": (
        "tests/psfcore/gap/",
        "tests/workers/tasks/test_gap.py",
        "tests/service/pages/test_transits.py",
    ),
    "fits": (
        "tests/psfcore/scatter/",
        "tests/psfcore/evaluation/",
        "tests/psfcore/report/",
        "tests/heliopsf/test_heliopsf.py",
    ),
}

_CACHE = TemporaryDirectory(prefix="heliopsf-tests-")


MUCH_BYTES = 100 * 2**20
_held_bytes = 0


@pytest.fixture(autouse=True, scope="module")
def _return_memory() -> Iterator[None]:
    """Return the memory that a file of tests no longer uses, if its process holds much more than after the last return.

    C libraries keep freed blocks.
    """
    global _held_bytes
    yield
    process = psutil.Process()
    if process.memory_info().rss > _held_bytes + MUCH_BYTES:
        return_unused_memory()
        _held_bytes = process.memory_info().rss


def pytest_collection_finish() -> None:
    """Leave what was imported out of later searches for garbage: it is never garbage, and it is most of all objects."""
    gc.collect()
    gc.freeze()


def pytest_addoption(parser: pytest.Parser) -> None:
    """Add the option that shows whether a test depends on the order of the tests."""
    parser.addoption(
        "--shuffle", type=int, metavar="SEED", help="run files, and the tests of a file, in random order"
    )


def pytest_configure(config: pytest.Config) -> None:
    """Have xdist keep our order of files: its own begins with those of the most tests.

    No test may use the cache folder of the user. Fixtures of modules use that of this process.
    """
    config.option.loadscopereorder = False
    # Plugins load numpy before `tests` sets the number of its threads.
    threadpool_limits(limits=1, user_api="blas")
    os.environ["HELIOPSF_CACHE_DIR"] = _CACHE.name


@pytest.hookimpl(optionalhook=True)
def pytest_xdist_make_scheduler(config: pytest.Config, log: Any) -> Any:
    """Give a process of xdist whole files, and the files of TOGETHER to the same process."""
    from xdist.scheduler import LoadFileScheduling

    class ByFilesTogether(LoadFileScheduling):
        def _split_scope(self, nodeid: str) -> str:
            return next(
                (name for name, paths in TOGETHER.items() if nodeid.startswith(paths)),
                super()._split_scope(nodeid),
            )

    return ByFilesTogether(config, log) if config.getoption("dist") == "loadfile" else None


@pytest.fixture(autouse=True)
def _own_cache(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """An empty cache of built PSFs, so that no test depends on what another one built."""
    with TemporaryDirectory(dir=_CACHE.name) as folder:
        monkeypatch.setenv("HELIOPSF_CACHE_DIR", folder)
        yield


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """Put the longest files first; refuse tests of one id: of these only one is run, and nobody sees it."""
    twice = [name for name, count in Counter(item.nodeid for item in items).items() if count > 1]
    if twice:
        raise pytest.UsageError(
            f"expected an id of its own for each test; got several of {', '.join(twice[:5])}"
        )
    seed = config.getoption("--shuffle")
    if seed is None:
        rank = {REPOSITORY / "tests" / name: place for place, name in enumerate(LONGEST_FIRST)}
        items.sort(key=lambda item: rank.get(item.path, len(rank)))
    else:
        generator = random.Random(seed)
        place = {path: generator.random() for path in dict.fromkeys(item.path for item in items)}
        items.sort(key=lambda item: (place[item.path], generator.random()))


# An instrument so small that its PSF is built in a second.
SMALL_INSTRUMENT = """
name = "small"
version = "1.0.0"
status = "draft"
wavelength_angstrom = 171.0
focal_length_mm = 1000.0
[aperture]
diameter_mm = 4.0
[detector]
pixel_pitch_um = 10.0
pixels = 512
readout_pixels = 512
plate_scale_arcsec = 2.0
"""


@pytest.fixture(scope="session")
def shared() -> Path:
    """The folder of real and practice data; the test is skipped where it is missing."""
    folder = Path(os.environ.get("HELIOPSF_SHARED", REPOSITORY.parent / "shared"))
    if not folder.is_dir():
        pytest.skip(f"real data are not here: no folder {folder} (HELIOPSF_SHARED names another)")
    return folder


@pytest.fixture
def psf_file(tmp_path: Path) -> Path:
    """A PSF of 64 px: a Gaussian core of 1.2 px and a faint wide wing, sum 1."""
    path = tmp_path / "psf.fits"
    write_psf(path)
    return path


@pytest.fixture
def image_file(tmp_path: Path) -> Path:
    """An image of 96 x 128 px whose instrument is unknown to the software."""
    path = tmp_path / "image.fits"
    write_image(path)
    return path


def write_psf(path: Path, *, size: int = 64, scale: float = 1.0) -> None:
    """Write a symmetric PSF that sums to ``scale``."""
    y, x = np.indices((size, size)) - size // 2
    r = np.hypot(x, y)
    kernel = 0.8 * np.exp(-0.5 * (r / 1.2) ** 2) / (2 * np.pi * 1.2**2) + 0.02 / (3 + r) ** 2.5
    fits.PrimaryHDU((scale * kernel / kernel.sum()).astype("f4")).writeto(path)


def write_image(path: Path, *, shape: tuple[int, int] = (96, 128), seed: int = 1, **cards: object) -> None:
    """Write an image with two blobs on a background, in DN/s."""
    rng = np.random.default_rng(seed)
    y, x = np.indices(shape)
    pixels = 20 + 300 * np.exp(-((x - 40) ** 2 + (y - 50) ** 2) / 18) + rng.poisson(30, shape)
    header = fits.Header({"TELESCOP": "TEST", "BUNIT": "DN/s", "XPOSURE": 2.0, **cards})
    fits.PrimaryHDU(pixels.astype("f4"), header).writeto(path)
