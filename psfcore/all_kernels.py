"""Compile the kernels of all methods, of all telescopes and of a fit, in as many processes as there are cores.

A kernel is compiled when it is called, and for the types of arguments that it is called with. Therefore each process
does small work that calls kernels as the large work does.

    python -m psfcore.all_kernels WORK     # does one piece of the work in this process
"""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from functools import partial

import numpy as np

from psfcore.build import build_psf
from psfcore.convolution.engine import Engine
from psfcore.convolution.fft_kernels import make_plan
from psfcore.deconvolve.kernels import compile_kernels
from psfcore.deconvolve.methods.registry import method_names
from psfcore.diffraction.fraunhofer import far_field
from psfcore.diffraction.mesh_series import hexagonal_mesh_kernel
from psfcore.diffraction.pupil import MaskPicture, Pupil
from psfcore.instruments.files import instrument_names, telescope_of
from psfcore.instruments.model import load_instrument
from psfcore.kernel_files import SUFFIX, folder_of_kernels
from psfcore.scatter.segments import Segments, segment_sums
from psfcore.scatter.shapes import SHAPES

SHAPE = (1024, 1024)


def works() -> dict[str, Callable[[], object]]:
    """The pieces of work, the longest first."""
    of_telescope = {telescope_of(name): name for name in instrument_names()}
    return {
        **{name: partial(compile_kernels, name, SHAPE) for name in method_names()},
        **{f"PSF of {name}": partial(_build, name) for name in of_telescope.values()},
        "other masks and meshes": _diffract,
        "PSFs that change over the field": _change_over_field,
        "transforms": _transform,
        "scatter": _scatter,
    }


def compile_all(processes: int) -> tuple[int, int]:
    """Do all the work, each piece in a process of its own. Returns how many kernels were compiled and how many are kept
    in the folder now.

    Raises CalledProcessError if a process fails.

    Parameters
    ----------
    processes
        How many processes run at the same time.
    """
    before = _kept_files()
    with ThreadPoolExecutor(processes) as pool:
        list(pool.map(_in_process, works()))
    after = _kept_files()
    return len(after - before), len(after)


def _kept_files() -> set[tuple[str, int]]:
    """Name and time of change of the kernel files in the folder of this package."""
    found = folder_of_kernels()[0].glob(f"*{SUFFIX}")
    return {(one.name, one.stat().st_mtime_ns) for one in found}


def _in_process(name: str) -> None:
    subprocess.run([sys.executable, "-m", __name__, name], stdout=subprocess.DEVNULL, check=True)


def _build(name: str) -> None:
    build_psf(load_instrument(name), size=64)


def _diffract() -> None:
    """A mask without symmetry, which is partly a picture, and a mesh with hexagonal openings."""
    corners = np.array([[-5.0, -5.0], [5.0, -4.0], [-3.0, 5.0]])
    pupil = Pupil((corners,), picture=MaskPicture(np.ones((4, 4)), 12.0))
    far_field(pupil, wavelength_angstrom=174.0, focal_length_mm=4187.0, pixel_pitch_um=10.0, size=32)
    hexagonal_mesh_kernel(4.0, pitch_um=400.0, wire_um=40.0, windows=9, angle_deg=10.0, size=32)


def _change_over_field() -> None:
    for name in method_names():
        compile_kernels(name, SHAPE, changing=True)


def _transform() -> None:
    for length in (16, 32, 48, 64, 80):  # 2 x 8, 4 x 8, 3 x 2 x 8, 8 x 8, 5 x 2 x 8
        make_plan(length)


def _scatter() -> None:
    """What a fit of scatter needs beside a deconvolution."""
    engine = Engine(np.full((3, 3), 1 / 9), (32, 32))
    engine.rows_forward(engine.to_lanes(np.ones((32, 32))))
    engine.rows_cut()
    engine.transform_columns()
    engine.multiply_kept(engine.transfer)
    segments = Segments((1.0, 3.0, 6.0), reach_grid_px=16)
    for kind in (np.float32, np.float64):
        segment_sums(np.ones((16, 16), kind), np.array([[4, 4], [8, 9]]), segments)
    shape = SHAPES["stretched"]
    shape.kernel(shape.start, 16)


if __name__ == "__main__":
    works()[sys.argv[1]]()
