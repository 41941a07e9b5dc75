"""The PSFs of the seven channels of AIA beside those of aiapy, and an image deconvolved by both: the tables of
docs/aia.md.

    python -m benchmarks.race.aia IMAGE PAGE

aiapy runs in a process and an environment of its own. A PSF of aiapy has 4096 x 4096 px and takes minutes to an hour to
compute, because aiapy adds every order to the whole array. Therefore this module evaluates aiapy's published equations
only near each order, with aiapy's numbers (`filter_mesh_parameters`). For three orders aiapy itself is fast enough, and
the process checks that both results agree.

    I(x) = sum over arms and orders m of sinc^2(m w / d) exp(-k |x - m s|^2),   k = 4.5 / px^2

PSFs are compared on 2048 x 2048 px, on which each of them sums to 1.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Callable, Sequence
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
from numpy.typing import NDArray

from benchmarks.race.peers import CONTENDERS, REPOSITORY, STEPS, aia_map, heliopsf, python_of
from benchmarks.timing import answer_of

CHANNELS = (94, 131, 171, 193, 211, 304, 335)
RADII_PX = (2, 10, 100)
PEER_PX, SIZE_PX = 4096, 2048
IMAGE_CHANNEL = 171
CHECKED_ORDERS = (-1, 0, 1)
BEYOND_DN = 1e-6
EDGE_PX = 64  # this many pixels at each edge of the image are not compared
NEAR_PX = 6  # exp(-4.5 * 6^2) is below the smallest double
ARM_ORDERS = (*range(4, 10), *range(12, 21))  # the light of orders 10, 11 and 21 is almost zero
BOUNDS = {"angle": 0.1, "spacing": 0.1, "light": 0.3}

Kernel = NDArray[np.float64]


def arms(kernel: Kernel, angles_deg: Sequence[float], spacing_px: float) -> list[tuple[float, float]]:
    """(angle in degrees, spacing in px) of each arm: a line through the centroids of its orders, in both directions."""
    middle = kernel.shape[0] // 2
    box = np.arange(-2, 3)
    found = []
    for angle in np.deg2rad(angles_deg):
        moment = np.zeros(2)
        for order in (sign * m for m in ARM_ORDERS for sign in (1, -1)):
            x, y = (round(middle + order * spacing_px * f(angle)) for f in (np.cos, np.sin))
            light = kernel[y - 2 : y + 3, x - 2 : x + 3]
            dx, dy = light.sum(axis=0) @ box / light.sum(), light.sum(axis=1) @ box / light.sum()
            moment += order * np.array([x + dx - middle, y + dy - middle])
        slope = moment / (2 * sum(m * m for m in ARM_ORDERS))
        found.append((float(np.rad2deg(np.arctan2(slope[1], slope[0]))), float(np.hypot(*slope))))
    return found


def light_beyond(kernel: Kernel, radius_px: float) -> float:
    """The light in pixels farther than the radius from the centre, in percent."""
    y, x = np.indices(kernel.shape) - kernel.shape[0] // 2
    return float(100 * kernel[np.hypot(x, y) > radius_px].sum())


# The functions from here on run in the process of aiapy.


def peer_mesh(
    spacing_px: float, ratio: float, k: float, angles: Kernel, orders: Sequence[int], line: Any
) -> Kernel:
    """The PSF of a mesh as in aiapy: 82 % of the light in the core and 18 % in the orders.

    line(centre, k, places): function that returns the profile of an order.
    """
    spikes, middle = np.zeros((PEER_PX, PEER_PX)), PEER_PX // 2
    for angle in angles:
        for order in (m for m in orders if m):
            x, y = middle + order * spacing_px * np.cos(angle), middle + order * spacing_px * np.sin(angle)
            columns, rows = (
                np.arange(max(round(p) - NEAR_PX, 0), min(round(p) + NEAR_PX + 1, PEER_PX)) for p in (x, y)
            )
            if len(rows) and len(columns):
                part = np.outer(line(y, k, rows), line(x, k, columns))
                spikes[rows[0] : rows[-1] + 1, columns[0] : columns[-1] + 1] += (
                    np.sinc(order / ratio) ** 2 * part
                )
    core = line(middle, k, np.arange(PEER_PX))
    return 0.18 * spikes / spikes.sum() + 0.82 * np.outer(core, core) / core.sum() ** 2


def at_pixel_centres(centre: float, k: float, places: NDArray[np.int_]) -> Kernel:
    """The profile of an order as aiapy computes it: a Gaussian, evaluated at the centres of the pixels."""
    return np.asarray(np.exp(-k * (places - centre) ** 2))


def over_pixels(centre: float, k: float, places: NDArray[np.int_]) -> Kernel:
    """The same profile, integrated over each pixel."""
    from scipy.special import erf

    root = np.sqrt(k)
    return np.asarray(erf(root * (places + 0.5 - centre)) - erf(root * (places - 0.5 - centre)))


def peer_psf(mesh: dict[str, Any], orders: Sequence[int], line: Any = at_pixel_centres) -> Kernel:
    import scipy.fft

    ratio, k = float(mesh["mesh_pitch"] / mesh["mesh_width"]), mesh["width"].value
    entrance = peer_mesh(mesh["spacing_e"].value, ratio, k, mesh["angle_arm"].to_value("rad"), orders, line)
    focal = peer_mesh(mesh["spacing_fp"].value, ratio, k, np.deg2rad([45.0, -45.0]), orders, line)
    product = scipy.fft.rfft2(entrance)
    product *= scipy.fft.rfft2(focal)
    return np.asarray(np.roll(scipy.fft.irfft2(product), (PEER_PX // 2, PEER_PX // 2), axis=(0, 1)))


def cut(kernel: Kernel) -> Kernel:
    """The inner SIZE_PX x SIZE_PX pixels, normalised to sum 1."""
    first = (PEER_PX - SIZE_PX) // 2
    inner = kernel[first : first + SIZE_PX, first : first + SIZE_PX]
    return inner / inner.sum()


def run_peer(folder: Path) -> None:
    """Compute and measure aiapy's PSFs, and deconvolve the image with aiapy."""
    import aiapy
    import aiapy.psf
    import astropy.units as u

    calculate: Callable[..., Any] = getattr(aiapy.psf, "calculate_psf", None) or aiapy.psf.psf
    meshes = aiapy.psf.filter_mesh_parameters()
    of_image = meshes[IMAGE_CHANNEL * u.angstrom]
    own = calculate(IMAGE_CHANNEL * u.angstrom, diffraction_orders=np.array(CHECKED_ORDERS))
    deviation = float(np.abs(peer_psf(of_image, CHECKED_ORDERS) - own).sum())
    found: dict[str, Any] = {"version": aiapy.__version__, "deviation": deviation, "channels": {}}
    for channel in CHANNELS:
        mesh = meshes[channel * u.angstrom]
        angles, spacing = list(map(float, mesh["angle_arm"].value)), float(mesh["spacing_e"].value)
        kernel = cut(peer_psf(mesh, range(-100, 101)))
        smooth = cut(peer_psf(mesh, range(-100, 101), over_pixels))
        found["channels"][channel] = {
            "angles": angles,
            "spacing": spacing,
            "arms": arms(kernel, angles, spacing),
            "light": [light_beyond(kernel, radius) for radius in RADII_PX],
            "smooth": [light_beyond(smooth, radius) for radius in RADII_PX],
        }
        if channel == IMAGE_CHANNEL:
            np.save(folder / "aiapy.npy", kernel)
    image = np.load(folder / "image.npy")
    # aiapy's image and PSF must have the same shape. With 0 beyond the image, its loop divides 0 by 0.
    plane = np.full((SIZE_PX, SIZE_PX), BEYOND_DN)
    plane[: image.shape[0], : image.shape[1]] = image
    for name in ("aiapy", "heliopsf"):
        done = aiapy.psf.deconvolve(aia_map(plane), psf=np.load(folder / f"{name}.npy"), iterations=STEPS)
        np.save(folder / f"by_aiapy_{name}.npy", np.asarray(done.data)[: image.shape[0], : image.shape[1]])
    print(json.dumps(found))


# The functions from here on run in the process of heliopsf.


def own_psf(channel: int, folder: Path) -> dict[str, Any]:
    from psfcore.build import build_psf
    from psfcore.diffraction.mesh_series import order_spacing_px
    from psfcore.instruments.model import load_instrument

    aia = load_instrument(f"aia_{channel}")
    psf = build_psf(aia, size=SIZE_PX)
    if channel == IMAGE_CHANNEL:
        np.save(folder / "heliopsf.npy", psf.kernel)
    first, second, _ = aia.meshes
    spacing = order_spacing_px(
        wavelength_angstrom=aia.wavelength_angstrom,
        distance_mm=aia.focal_length_mm,
        pitch_um=first.pitch_um,
        pixel_pitch_um=aia.detector.pixel_pitch_um,
    )
    angles = [first.angle_deg, second.angle_deg, first.angle_deg - 90, second.angle_deg - 90]
    return {
        "arms": arms(psf.kernel, angles, spacing),
        "light": [light_beyond(psf.kernel, radius) for radius in RADII_PX],
        "aperture": [light_beyond(psf.components["AIRY"], radius) for radius in RADII_PX],
    }


def inner(pixels: Kernel) -> Kernel:
    return pixels[EDGE_PX:-EDGE_PX, EDGE_PX:-EDGE_PX]


def deviations(one: Kernel, other: Kernel, image: Kernel) -> str:
    """Median and 99th percentile of the relative deviation, in pixels brighter than the median of the image."""
    bright = inner(image) > np.median(inner(image))
    apart = np.abs(inner(one)[bright] / inner(other)[bright] - 1)
    return " | ".join(f"{100 * value:.2g} %" for value in (np.median(apart), np.percentile(apart, 99)))


def marked(value: float, what: str, form: str) -> str:
    """The value as text, bold beyond its bound."""
    return f"{value:{form}}" if abs(value) <= BOUNDS[what] else f"**{value:{form}}**"


def geometry_table(peer: dict[int, Any], own: dict[int, Any]) -> list[str]:
    """The angles and spacings of the arms of each channel."""
    lines = [
        "| channel | arms, heliopsf | arms, aiapy | largest deviation | spacing, heliopsf | spacing, aiapy | largest "
        "deviation |",
        "|---|---|---|---|---|---|---|",
    ]
    for channel in CHANNELS:
        ours, theirs = own[channel]["arms"], peer[channel]["arms"]
        angles = [", ".join(f"{angle:.2f}" for angle, _ in arms) for arms in (ours, theirs)]
        spacings = [f"{np.mean([spacing for _, spacing in arms]):.2f}" for arms in (ours, theirs)]
        apart = np.abs(np.array(ours) - np.array(theirs)).max(axis=0)
        cells = [
            f"{channel}",
            *angles,
            marked(apart[0], "angle", ".2f"),
            *spacings,
            marked(apart[1], "spacing", ".3f"),
        ]
        lines.append(f"| {' | '.join(cells)} |")
    return lines


def light_table(peer: dict[int, Any], own: dict[int, Any]) -> list[str]:
    """The light beyond each radius, and the largest deviation from the integrated equations."""
    lines = [
        "| channel | radius (px) | heliopsf | aiapy | deviation | aiapy, integrated | aperture |",
        "|---|---|---|---|---|---|---|",
    ]
    for channel in CHANNELS:
        ours, theirs = own[channel], peer[channel]
        columns = (RADII_PX, ours["light"], theirs["light"], theirs["smooth"], ours["aperture"])
        for radius, light, other, smooth, aperture in zip(*columns, strict=True):
            cells = [
                f"{channel}",
                f"{radius}",
                f"{light:.2f}",
                f"{other:.2f}",
                marked(light - other, "light", "+.2f"),
            ]
            lines.append(f"| {' | '.join([*cells, f'{smooth:.2f}', f'{aperture:.2f}'])} |")
    apart = [np.abs(np.subtract(own[n]["light"], peer[n]["smooth"])) for n in CHANNELS]
    worst = dict(zip(RADII_PX, np.max(apart, axis=0), strict=True))
    told = " and ".join(f"{worst[radius]:.2f} at {radius} px" for radius in RADII_PX[1:])
    return [*lines, "", f"The integrated equations deviate from heliopsf by at most {told}."]


def image_table(image_path: Path, folder: Path) -> list[str]:
    """The deviations of the deconvolved images."""
    image = np.load(folder / "image.npy")
    kernels = {name: np.load(folder / f"{name}.npy") for name in ("heliopsf", "aiapy")}
    ours = {name: heliopsf(image, kernel, STEPS) for name, kernel in kernels.items()}
    theirs = {name: np.load(folder / f"by_aiapy_{name}.npy") for name in kernels}
    rows = {
        "the loops of heliopsf and aiapy, both with heliopsf's PSF": (ours["heliopsf"], theirs["heliopsf"]),
        "the loops of heliopsf and aiapy, both with aiapy's PSF": (ours["aiapy"], theirs["aiapy"]),
        "heliopsf with its PSF, aiapy with its PSF": (ours["heliopsf"], theirs["aiapy"]),
        "for comparison: the image and heliopsf's result": (image, ours["heliopsf"]),
    }
    return [
        f"`{image_path.name}`, {image.shape[1]} x {image.shape[0]} px:",
        "",
        "| compared | median | 99th percentile |",
        "|---|---|---|",
        *(f"| {name} | {deviations(one, other, image)} |" for name, (one, other) in rows.items()),
    ]


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("image", type=Path, help="level 1 image of AIA at 171 angstrom, at most 2048 px")
    parser.add_argument("page", type=Path, help="the page with the tables")
    parser.add_argument("--peer", action="store_true", help=argparse.SUPPRESS)
    chosen = parser.parse_args()
    if chosen.peer:
        run_peer(chosen.page)
        return
    if not chosen.image.exists():
        print(f"expected a level 1 image of AIA; {chosen.image} does not exist: name one with AIA_IMAGE=FILE")
        return
    from benchmarks.figures import write_part
    from psfcore.fits.blocks import FitsLimits
    from psfcore.fits.observation import read_observation

    with TemporaryDirectory(prefix="heliopsf-aia-") as name:
        folder = Path(name)
        observed = read_observation(chosen.image, FitsLimits(max_pixels=2**22))
        np.save(folder / "image.npy", np.where(observed.mask == 0, np.maximum(observed.pixels, 0), 0))
        own = {channel: own_psf(channel, folder) for channel in CHANNELS}
        words = (str(chosen.image), str(folder), "--peer")
        python = python_of(CONTENDERS["aiapy"].requirement)
        found = answer_of("benchmarks.race.aia", *words, python=python, PYTHONPATH=str(REPOSITORY))
        peer = {int(channel): values for channel, values in found["channels"].items()}
        checked = (
            f"aiapy {found['version']}; the sum of all absolute deviations is {found['deviation']:.0e} of the "
            "light."
        )
        for part, lines in (
            ("arms", [checked, "", *geometry_table(peer, own)]),
            ("light", light_table(peer, own)),
            ("image", image_table(chosen.image, folder)),
        ):
            write_part(chosen.page, f"benchmarks.race.aia {part}", "\n".join(lines))


if __name__ == "__main__":
    main()
