"""`make bench-peers`: compare heliopsf's PSFs of the seven AIA channels with those of aiapy; deconvolve an image with
both.

The command writes docs/aia.md. aiapy runs in a separate process, with the interpreter that the command names. A PSF of
aiapy has 4096 x 4096 px and takes minutes to an hour to compute, because aiapy adds every order to the whole array.
Therefore this module evaluates aiapy's published equations only near each order, with aiapy's numbers
(`filter_mesh_parameters`). For three orders aiapy itself is fast enough, and the process checks that both results
agree.

    I(x) = sum over arms and orders m of sinc^2(m w / d) exp(-k |x - m s|^2),   k = 4.5 / px^2

PSFs are compared on 2048 x 2048 px, on which each of them sums to 1.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
from numpy.typing import NDArray

CHANNELS = (94, 131, 171, 193, 211, 304, 335)
RADII_PX = (2, 10, 100)
PEER_PX, SIZE_PX = 4096, 2048
STEPS = 20
IMAGE_CHANNEL = 171
CHECKED_ORDERS = (-1, 0, 1)
BEYOND_DN = 1e-6
EDGE_PX = 64  # this many pixels at each edge of the image are not compared
NEAR_PX = 6  # exp(-4.5 * 6^2) is below the smallest double
ARM_ORDERS = (*range(4, 10), *range(12, 21))  # the light of orders 10, 11 and 21 is almost zero
BOUNDS = {"angle": 0.1, "spacing": 0.1, "light": 0.3}
REPOSITORY = Path(__file__).parents[2]

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

    from benchmarks.race.peers import aia_map

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
    (folder / "peer.json").write_text(json.dumps(found))


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


def by_heliopsf(image: Kernel, kernel: Kernel) -> Kernel:
    from astropy.io.fits import Header

    from psfcore.deconvolve.conditions import Conditions
    from psfcore.deconvolve.methods.richardson_lucy import deconvolve
    from psfcore.image import Image
    from psfcore.psf import Psf

    observed = Image(image, np.zeros(image.shape, np.uint8), Header(), "DN", 1.0)
    psf = Psf(kernel, "bench", "1", None, "draft")
    return deconvolve(observed, psf, Conditions(edges="zero"), steps=STEPS).pixels


def inner(pixels: Kernel) -> Kernel:
    return pixels[EDGE_PX:-EDGE_PX, EDGE_PX:-EDGE_PX]


def deviations(one: Kernel, other: Kernel, image: Kernel) -> str:
    """Median and 99th percentile of the relative deviation, in pixels brighter than the median of the image."""
    bright = inner(image) > np.median(inner(image))
    apart = np.abs(inner(one)[bright] / inner(other)[bright] - 1)
    return " | ".join(f"{100 * value:.2g} %" for value in (np.median(apart), np.percentile(apart, 99)))


def geometry_row(channel: int, peer: dict[str, Any], own: dict[str, Any]) -> str:
    angles = [", ".join(f"{angle:.2f}" for angle, _ in one["arms"]) for one in (own, peer)]
    spacings = [np.mean([spacing for _, spacing in one["arms"]]) for one in (own, peer)]
    apart = np.abs(np.array(own["arms"]) - np.array(peer["arms"])).max(axis=0)
    cells = [f"{channel}", *angles, marked(apart[0], "angle"), *(f"{s:.2f}" for s in spacings)]
    return f"| {' | '.join([*cells, marked(apart[1], 'spacing', 3)])} |"


def light_row(channel: int, index: int, peer: dict[str, Any], own: dict[str, Any]) -> str:
    ours, theirs, smooth = own["light"][index], peer["light"][index], peer["smooth"][index]
    aperture = own["aperture"][index]
    cells = [
        f"{channel}",
        f"{RADII_PX[index]}",
        f"{ours:.2f}",
        f"{theirs:.2f}",
        marked(ours - theirs, "light"),
    ]
    return f"| {' | '.join([*cells, f'{smooth:.2f}', f'{aperture:.2f}'])} |"


def marked(value: float, what: str, digits: int = 2) -> str:
    text = f"{value:+.{digits}f}" if what == "light" else f"{value:.{digits}f}"
    return text if abs(value) <= BOUNDS[what] else f"**{text}**"


PAGE = """# AIA beside aiapy

`make bench-peers` makes this page. It compares the PSFs of the instrument files `aia_94` to `aia_335` with those of aiapy {version}, on {size} x {size} px, on which
each PSF sums to 1. Deviations beyond 0.1 degrees, 0.1 px or 0.3 percentage points are bold.

aiapy adds every diffraction order to 4096 x 4096 px. The command evaluates the same equations near each order only, with the numbers of aiapy
(`filter_mesh_parameters`). With the orders -1 to 1, this evaluation was compared with aiapy itself: the sum of all absolute deviations is {deviation:.0e} of the light.

## Arms and orders

The angles (degrees) and the spacing (px) are measured in both PSFs, from the centroids of orders 4 to 9 and 12 to 20 of each arm. aiapy has four separate arms. An
instrument file has two square meshes, whose arms are 90 degrees apart; the measured arms (Grigis et al. 2012) deviate from 90 degrees by up to 0.12 degrees.

| channel | arms, heliopsf | arms, aiapy | largest deviation | spacing, heliopsf | spacing, aiapy | largest deviation |
|---|---|---|---|---|---|---|
{geometry}

## Light beyond a radius

The table gives percentages of all light. For `aiapy, integrated`, each order of the equations of aiapy is integrated over the pixels. `aperture` is the light that the
aperture alone diffracts beyond the radius (a ring of 200 mm with an obscuration of 80 mm); aiapy leaves out the aperture.

| channel | radius (px) | heliopsf | aiapy | deviation | aiapy, integrated | aperture |
|---|---|---|---|---|---|---|
{light}

The deviations above 0.3 have three reasons:

- At 2 px: only heliopsf contains the diffraction by the aperture, up to 1 % of the light.
- At 2 px: the orders of the focal-plane mesh are 0.2 px to 0.7 px apart. In heliopsf, an order is narrower than a pixel; in aiapy it is a Gaussian with a full width of
  0.8 px. Orders near the circle are therefore counted on different sides of it: at 304 A the third order is at 2.01 px.
- At 10 px and 100 px: aiapy evaluates the Gaussian of each order at the centres of the pixels and does not integrate it over their area. The light of an order then depends on its place
  within the pixel, by factors of 0.6 to 1.5: of the first orders at 94 A (at 8.99 px), and of the orders at 131 A and 304 A beyond 100 px. The integrated
  equations deviate from heliopsf by at most {smooth_10:.2f} at 10 px and {smooth_100:.2f} at 100 px.

The meshes of heliopsf are two-dimensional. Therefore its PSFs also have orders between the arms; the PSFs of aiapy do not. These orders hold 0.9 % of the light of each mesh.

## One image deconvolved by both

{image}: {shape} px of a level 1 image at {channel} A, {steps} Richardson-Lucy steps, no light beyond the field. (aiapy needs an image of the size of the PSF; it
gets {beyond:g} DN beyond the field, because with 0 its result is NaN.) Relative deviation in pixels brighter than the median of the image, without {edge} px at each edge:

| compared | median | 99th percentile |
|---|---|---|
| the loops of heliopsf and aiapy, both with heliopsf's PSF | {loops_own} |
| the loops of heliopsf and aiapy, both with aiapy's PSF | {loops_peer} |
| heliopsf with its PSF, aiapy with its PSF | {each} |
| for comparison: the image and heliopsf's result | {change} |
"""


def page(peer: dict[str, Any], image_path: Path, folder: Path, own: dict[int, dict[str, Any]]) -> str:
    image, kernels = (
        np.load(folder / "image.npy"),
        {n: np.load(folder / f"{n}.npy") for n in ("heliopsf", "aiapy")},
    )
    ours = {name: by_heliopsf(image, kernel) for name, kernel in kernels.items()}
    theirs = {name: np.load(folder / f"by_aiapy_{name}.npy") for name in kernels}
    rows = [(channel, peer["channels"][str(channel)], own[channel]) for channel in CHANNELS]
    smooth = np.array([np.subtract(mine["light"], one["smooth"]) for _, one, mine in rows])
    return PAGE.format(
        version=peer["version"],
        size=SIZE_PX,
        deviation=peer["deviation"],
        geometry="\n".join(geometry_row(*row) for row in rows),
        light="\n".join(light_row(row[0], i, *row[1:]) for row in rows for i in range(len(RADII_PX))),
        smooth_10=np.abs(smooth[:, 1]).max(),
        smooth_100=np.abs(smooth[:, 2]).max(),
        image=f"`{image_path.name}`",
        shape=" x ".join(str(n) for n in image.shape[::-1]),
        channel=IMAGE_CHANNEL,
        steps=STEPS,
        edge=EDGE_PX,
        beyond=BEYOND_DN,
        loops_own=deviations(ours["heliopsf"], theirs["heliopsf"], image),
        loops_peer=deviations(ours["aiapy"], theirs["aiapy"], image),
        each=deviations(ours["heliopsf"], theirs["aiapy"], image),
        change=deviations(image, ours["heliopsf"], image),
    )


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("peer", help="interpreter that has aiapy")
    parser.add_argument(
        "image", type=Path, help="level 1 image of AIA at 171 angstrom (FITS), at most 2048 px"
    )
    parser.add_argument("output", type=Path, help="the page to write")
    arguments = parser.parse_args()
    if not arguments.image.exists():
        print(
            f"expected a level 1 image of AIA; {arguments.image} does not exist, so {arguments.output} was not changed: name an "
            "image with AIA_IMAGE=FILE"
        )
        return
    from psfcore.fits.blocks import FitsLimits
    from psfcore.fits.observation import read_observation

    with TemporaryDirectory(prefix="heliopsf-aia-") as name:
        folder = Path(name)
        observed = read_observation(arguments.image, FitsLimits(max_pixels=2**22))
        np.save(folder / "image.npy", np.where(observed.mask == 0, np.maximum(observed.pixels, 0), 0))
        own = {channel: own_psf(channel, folder) for channel in CHANNELS}
        subprocess.run(
            [arguments.peer, str(Path(__file__).resolve()), "--peer", str(folder)],
            env=os.environ | {"PYTHONPATH": str(REPOSITORY)},
            check=True,
        )
        peer = json.loads((folder / "peer.json").read_text())
        text = page(peer, arguments.image, folder, own)
    arguments.output.write_text(text, "utf-8")
    print(f"wrote {arguments.output}")


if __name__ == "__main__":
    if sys.argv[1:2] == ["--peer"]:
        run_peer(Path(sys.argv[2]))
    else:
        main()
