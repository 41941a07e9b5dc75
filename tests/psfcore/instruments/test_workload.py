"""An instrument file cannot ask for more memory than its estimate, and counts beyond all telescopes are refused."""

from __future__ import annotations

import subprocess
import sys
import tracemalloc

import pytest

from psfcore.build import build_psf
from psfcore.diffraction.pupil import MaskGrid, entrance_pupil
from psfcore.errors import DataError
from psfcore.instruments.files import instrument_names
from psfcore.instruments.model import MOST_BYTES, load_instrument, parse_instrument
from psfcore.instruments.workload import MOST_CELLS, MOST_SAMPLES, PERIOD_PX, check_workload, workload
from tests.conftest import REPOSITORY, SMALL_INSTRUMENT
from workers.intake.costs import WORKER_MIB
from workers.intake.estimates import estimate_build

MIB = 2**20
MESH = "[[meshes]]\nname = 'm'\nplace = 'entrance'\npitch_um = 300.0\nwire_um = 30.0\n"
POLYGON = "{ corners_mm = [[0, 0], [1, 0], [1, 1]] }"


def small(added: str = "", **values: str) -> str:
    """The small instrument with other values of its keys, and more tables."""
    lines = SMALL_INSTRUMENT.splitlines()
    changed = [
        next((f"{k} = {v}" for k, v in values.items() if line.startswith(f"{k} =")), line) for line in lines
    ]
    return "\n".join(changed) + "\n" + added


def mount(text: str) -> str:
    return small("[mount]\nbasis = 'assumed'\n" + text)


TOO_MANY = {
    "windows": small(MESH + "windows = 100000\nangle_deg = 45.0"),
    "rays of one set": mount("rays = [{ count = 257, width_mm = 0.01 }]"),
    "rays of all sets": mount(f"rays = [{','.join(100 * ['{ count = 100, width_mm = 0.01 }'])}]"),
    "rings": mount(f"rings = [{','.join(65 * ['{ radius_mm = 1, width_mm = 0.01 }'])}]"),
    "polygons": mount(f"polygons = [{','.join(65 * [POLYGON])}]"),
    "corners": mount(f"polygons = [{{ corners_mm = [{','.join(1025 * ['[0, 1]'])}] }}]"),
    "corners of all polygons": mount("polygons = "
                                     f"[{','.join(3 * ['{ corners_mm = [' + ','.join(400 * ['[0, 1]']) + '] }'])}]"),
    "lines": small(65 * "[[bandpass]]\nwavelength_angstrom = 171.0\nweight = 1.0\n"),
    "gain modes": small("[detector.gain_modes]\n" + "\n".join(f"m{n} = {{ basis = 'assumed' }}" for n in range(65))),
    "characters": small("# " + "x" * MOST_BYTES),
}  # fmt: skip
TOO_LARGE = {
    "cells of a rotated mesh": small(MESH + "windows = 10000\nangle_deg = 45.0", focal_length_mm="100.0"),
    "samples of the aperture": small(diameter_mm="4e6"),
}


def test_too_many_parts_are_refused_when_the_file_is_read(subtests: pytest.Subtests) -> None:
    for name, text in TOO_MANY.items():
        with subtests.test(name), pytest.raises(DataError, match=r"bad-instrument-file: .*(at most|less)"):
            parse_instrument(text, "greedy.toml")


def test_too_large_arrays_are_refused_before_they_exist() -> None:
    for name, text in TOO_LARGE.items():
        instrument = parse_instrument(text, "greedy.toml")
        tracemalloc.start()
        with pytest.raises(DataError, match=r"bad-instrument-file: .*expected .*; got"):
            build_psf(instrument)
        peak = tracemalloc.get_traced_memory()[1]
        tracemalloc.stop()
        assert peak < MIB, name


def test_shipped_instruments_are_far_from_the_limits() -> None:
    for name in instrument_names():
        instrument = load_instrument(name)
        check_workload(instrument, name)
        work = workload(instrument, 4096)
        assert max(work.cells, default=0) < MOST_CELLS / 5 and work.samples < MOST_SAMPLES / 2, name


def test_the_mask_and_its_edges_are_not_larger_than_said() -> None:
    hri = load_instrument("hri_euv")
    work = workload(hri, PERIOD_PX)
    period_mm = PERIOD_PX * hri.detector.pixel_pitch_um * 1e-3
    cell_mm = hri.wavelength_angstrom * 1e-7 * hri.focal_length_mm / period_mm
    grid = MaskGrid(entrance_pupil(hri.aperture, mount=hri.mount), cell_mm)
    assert work.mask and abs(grid.cells - work.mask_cells) <= 4
    assert len(grid._entries) <= work.mount_entries + 8 * work.mask_cells


SIZE_PX = 1024
BUILD = """
import sys
from psfcore.build import build_psf
from psfcore.instruments.model import parse_instrument
from workers.run.child import Child
with Child(1).limited(int(sys.argv[1])):
    print(build_psf(parse_instrument(sys.stdin.read(), "greedy.toml"), size=int(sys.argv[2])).kernel.shape)
"""
GREEDY = small(MESH + "windows = 400\nangle_deg = 45.0\n", focal_length_mm="200.0", diameter_mm="20.0")


def test_a_greedy_file_within_the_limits_keeps_to_its_estimate() -> None:
    """The mesh is computed on the full grid, in a process that may use 1.5 times the estimate."""
    instrument = parse_instrument(GREEDY, "greedy.toml")
    check_workload(instrument, "greedy.toml")
    assert max(workload(instrument, SIZE_PX).cells) > 200_000
    estimate_mib = round(WORKER_MIB + estimate_build({"instrument_file": GREEDY, "size": SIZE_PX})[1])
    command = [sys.executable, "-c", BUILD, str(estimate_mib), str(SIZE_PX)]
    done = subprocess.run(command, input=GREEDY, cwd=REPOSITORY, capture_output=True, text=True, timeout=170)
    assert done.stdout == f"({SIZE_PX}, {SIZE_PX})\n", done.stderr
