"""What is installed: the wheel, its metadata and annotations, and what works without the packages of the extras."""

from __future__ import annotations

import subprocess
import sys
import zipfile
from pathlib import Path

import pytest

from tests.conftest import REPOSITORY, SMALL_INSTRUMENT, write_image, write_psf

# What pip installs for the core: its dependencies and what these need.
CORE = {"annotated_types", "astropy", "astropy_iers_data", "click", "dotenv", "erfa", "llvmlite", "numba"}
CORE |= {"numpy", "packaging", "platformdirs", "pydantic", "pydantic_core", "pydantic_settings", "scipy"}
CORE |= {"threadpoolctl", "typing_extensions", "typing_inspection", "yaml"}
OURS = {"heliopsf", "psfcore", "workers", "service"}
BLOCKED = """
import sys
class Allowed:
    def __init__(self, finder):
        self.finder = finder
    def __getattr__(self, name):
        return getattr(self.finder, name)
    def find_spec(self, name, path=None, target=None):
        top = name.partition(".")[0]
        if top not in ALLOWED and top not in sys.stdlib_module_names and not top.startswith("_"):
            return None
        return self.finder.find_spec(name, path, target)
sys.meta_path[:] = map(Allowed, sys.meta_path)
"""
THREE_LINES = """
import heliopsf
psf = heliopsf.build_psf("small.toml", size=64)
sharp = heliopsf.deconvolve("image.fits", psf)
assert sharp.pixels.shape == (96, 128) and sharp.quality.shape == (96, 128)
heliopsf.fit_scatter, heliopsf.diagnose_gap
try:
    heliopsf.Client
except heliopsf.MissingExtra as error:
    assert "pip install 'heliopsf[service]'" in str(error), error
else:
    raise AssertionError("Client")
try:
    psf.plot()
except heliopsf.MissingExtra as error:
    assert "the package matplotlib" in str(error) and "heliopsf[plot]" in str(error)
else:
    raise AssertionError("plot")
"""


COMMANDS = """
from service.start import main
for command in SEVERAL:
    sys.argv = ["heliopsf", *command.split()]
    try:
        main()
    except SystemExit as end:
        if len(SEVERAL) == 1 or end.code:
            raise
"""
FAST = (
    "psf build --instrument small.toml --size 64 -o psf.fits --local",
    "psf show psf.fits",
    "deconvolve image.fits --psf psf.fits -o out.fits --local",
)
SLOW = (
    "simulate transit -o transit --size 128 --images 6 --diffraction known.fits",
    "psf fit transit -o fitted.fits --local",
    "gap transit --json gap.json --local",
    "psf crossval transit --json folds.json --runs 1 --local",
)


def _run(folder: Path, *commands: str, first: str = "") -> subprocess.CompletedProcess[str]:
    """Run code and commands in one process, with the packages of the core alone."""
    script = (
        BLOCKED.replace("ALLOWED", repr(CORE | OURS)) + first + COMMANDS.replace("SEVERAL", repr(commands))
    )
    return subprocess.run([sys.executable, "-c", script], cwd=folder, capture_output=True, text=True)


@pytest.mark.parametrize(
    ("code", "commands"),
    [(THREE_LINES, FAST), pytest.param("", SLOW, marks=pytest.mark.slow)],
    ids=["images", "transits"],
)
def test_three_lines_and_commands_with_local_need_the_core_alone(
    tmp_path: Path, code: str, commands: tuple[str, ...]
) -> None:
    write_image(tmp_path / "image.fits", WAVELNTH=171, CDELT1=2.0, CDELT2=2.0)
    (tmp_path / "small.toml").write_text(SMALL_INSTRUMENT)
    write_psf(tmp_path / "known.fits", size=31)
    done = _run(tmp_path, *commands, first=code)
    assert done.returncode == 0, done.stderr
    assert (tmp_path / ("out.fits" if commands is FAST else "folds.json")).is_file()


def test_a_command_whose_packages_are_missing_names_the_extra(tmp_path: Path) -> None:
    write_image(tmp_path / "image.fits")
    for command, package, extra in (
        ("serve", "sqlalchemy", "service"),
        ("job list", "httpx", "service"),
        ("deconvolve image.fits -o out.fits", "httpx", "service"),
        ("deconvolve image.fits -o out.fits --local --plot out.png", "matplotlib", "plot"),
    ):
        done = _run(tmp_path, command)
        assert done.returncode == 1 and done.stderr.count("\n") == 1 and "Traceback" not in done.stderr
        assert f"the package {package}" in done.stderr and f"'heliopsf[{extra}]'" in done.stderr, command
        assert ("--local" in done.stderr) == (package == "httpx")


@pytest.fixture(scope="module")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("wheel")
    # A copy: a build writes into the folder of the sources.
    listing = ["git", "ls-files", "--cached", "--others", "--exclude-standard"]
    tracked = subprocess.run(listing, cwd=REPOSITORY, capture_output=True, text=True)
    if tracked.returncode:
        pytest.skip("not a git checkout")
    for name in tracked.stdout.splitlines():
        if name.split("/")[0] in OURS or "/" not in name:
            (folder / "source" / name).parent.mkdir(parents=True, exist_ok=True)
            if (REPOSITORY / name).is_file():
                (folder / "source" / name).write_bytes((REPOSITORY / name).read_bytes())
    command = [sys.executable, "-m", "build", "--no-isolation", "-o", str(folder / "dist")]
    subprocess.run([*command, str(folder / "source")], check=True, capture_output=True)
    (found,) = (folder / "dist").glob("*.whl")
    return found


def test_wheel_and_source_have_complete_metadata(wheel: Path) -> None:
    files = sorted(map(str, wheel.parent.iterdir()))
    assert len(files) == 2
    subprocess.run(
        [sys.executable, "-m", "twine", "check", "--strict", *files], check=True, capture_output=True
    )
    with zipfile.ZipFile(wheel) as archive:
        (path,) = (name for name in archive.namelist() if name.endswith("METADATA"))
        metadata = archive.read(path).decode()
    assert "Requires-Python: >=3.11" in metadata and "License-Expression: BSD-3-Clause" in metadata


def test_the_wheel_holds_the_packages_and_their_files_and_stays_small(wheel: Path) -> None:
    with zipfile.ZipFile(wheel) as archive:
        names = set(archive.namelist())
    assert {name.split("/")[0] for name in names if ".dist-info" not in name} == OURS
    for name in (
        "heliopsf/py.typed",
        "psfcore/instruments/hri_euv.toml",
        "psfcore/published_psfs.toml",
        "psfcore/drawing/page.html",
    ):
        assert name in names
    kept = {f"{path.relative_to(REPOSITORY)}" for path in (REPOSITORY / "service" / "pages").rglob("*.html")}
    assert kept and kept <= names
    # The wheel is code and texts; only a second wheel for the service would bring it below 1 MB. PSFs that change over
    # the field and kernels without numba brought it above 1.6 MB.
    assert wheel.stat().st_size < 1.7e6


SCRIPT = """
import numpy as np

import heliopsf

psf: heliopsf.Psf = heliopsf.build_psf("hri_euv", size=512, progress=True)
result: heliopsf.Deconvolution = heliopsf.deconvolve("image.fits", psf, iterations=25, threads=2)
before: np.ndarray[tuple[int, ...], np.dtype[np.float64]] = result.pixels
array: np.ndarray[tuple[int, ...], np.dtype[np.float64]] = heliopsf.deconvolve(before, psf.kernel)
beyond = float(heliopsf.psf_for("image.fits").light_beyond([10.0])[0])
sigma = heliopsf.fit_scatter("transit", progress=lambda stage, step, steps: None).value_sigma
print(beyond, sigma["total"], result.quality.max(), result.error is None)
with heliopsf.Client("http://127.0.0.1:8765") as client:
    client.deconvolve("image.fits", "out.fits")
"""
MISTAKES = {
    'heliopsf.build_psf("hri_euv", size="large")': 'has incompatible type "str"; expected "int"',
    'heliopsf.deconvolve("image.fits", 3)': "No overload variant",
    'heliopsf.deconvolve("image.fits").pixel': 'has no attribute "pixel"',
}


@pytest.mark.slow  # mypy reads the annotations of numpy for ten seconds
def test_a_script_passes_the_strict_check_and_mistakes_do_not(tmp_path: Path) -> None:
    (tmp_path / "script.py").write_text(SCRIPT)
    (tmp_path / "mistakes.py").write_text("\n".join(["import heliopsf", *MISTAKES]) + "\n")
    done = subprocess.run(
        [
            sys.executable, "-m", "mypy", "--strict", "--config-file", "", "--no-error-summary",
            "--follow-imports", "silent", "--cache-dir", str(tmp_path / "mypy"), "script.py", "mistakes.py",
        ],
        cwd=tmp_path, capture_output=True, text=True, env={"PATH": "", "MYPYPATH": str(Path(__file__).parents[2])},
    )  # fmt: skip
    assert done.stderr == ""
    errors = [line for line in done.stdout.splitlines() if ": error: " in line]
    assert len(errors) == len(MISTAKES), done.stdout
    for number, (error, text) in enumerate(zip(errors, MISTAKES.values(), strict=True), start=2):
        assert error.startswith(f"mistakes.py:{number}: ") and text in error
