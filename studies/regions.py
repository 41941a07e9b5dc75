"""Compare a box that is deconvolved alone with the same box of the whole deconvolved image.

    python -m studies.regions [--size 1024]

For boxes in a bright region, in quiet Sun, in a coronal hole and at an edge of a simulated image, and for several allowed
errors, this prints the width of the rim, the pixels of box and rim as a share of the image, the bound, and the differences.
All light is in percent of the mean light of the box.
"""

from __future__ import annotations

import argparse
from dataclasses import replace

import numpy as np
from astropy.io.fits import Header
from scipy.ndimage import uniform_filter

import heliopsf
from psfcore.deconvolve.conditions import PreparedPsfs
from psfcore.deconvolve.extent import Box
from psfcore.deconvolve.work import Options, Work, box_work
from psfcore.image import Image
from psfcore.simulate.scene import observe, solar_scene
from workers.machine import cores

ERRORS = (0.5, 0.2, 0.05, 0.02)
METHODS = ("richardson-lucy", "richardson-lucy-accelerated", "linear")


def boxes(image: Image) -> dict[str, Box]:
    """Boxes of a sixteenth of the image's width: where it is brightest, darkest and of median light, and at an edge."""
    size = image.pixels.shape[0]
    side, edge = size // 16, size // 5
    light = uniform_filter(image.pixels, side)[edge:-edge, edge:-edge]
    usual = np.abs(light - np.median(light))
    places = {"bright": np.argmax(light), "quiet": np.argmin(usual), "dark": np.argmin(light)}
    found = {}
    for name, place in places.items():
        y, x = (int(n) + edge - side // 2 for n in np.unravel_index(place, light.shape))
        found[name] = Box(x, x + side, y, y + side)
    return found | {"edge": Box(0, side, size // 2, size // 2 + side)}


def compare(instrument: str, size: int) -> None:
    """Print the rim, the bound and the differences of each box, for the PSF of an instrument."""
    psf, scene = heliopsf.build_psf(instrument), solar_scene((size, size), 1)
    pixels = observe(scene, psf, exposure_s=1, photon_gain_dn=2, read_noise_dn=2, seed=1)
    image = Image(pixels, np.zeros(pixels.shape, np.uint8), Header(), "DN", 1.0)
    for method in METHODS:
        options = Options(method=method, threads=cores(), engine_for=PreparedPsfs().engine_for)
        whole = Work(image, psf, options).run().pixels
        for name, box in boxes(image).items():
            what, mean = f"{instrument} {method} {name}", image.pixels[box.slices].mean() / 100
            for error in ERRORS:
                alone = box_work(Work(image, psf, replace(options, region_error=error)), box)
                if alone.error == 0:
                    print(f"{what:<46} for {100 * error:g} %: whole image")
                    break
                difference = alone.run().pixels - whole[box.slices]
                largest, rms = np.abs(difference).max(), np.sqrt(np.mean(difference**2))
                share = np.prod(alone.rim.shape) / pixels.size
                told = f"{alone.error / mean:8.2f}%{largest / mean:8.2f}%{rms / mean:7.2f}%"
                print(
                    f"{what:<46}{alone.rim_px:6d}{share:7.2f}{told}{alone.error / largest:17.1f}", flush=True
                )


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--size", type=int, default=1024)
    size = parser.parse_args().size
    print(f"{'':<46}{'rim':>6}{'share':>7}{'bound':>9}{'largest':>9}{'rms':>8}{'bound / largest':>17}")
    for instrument in ("hri_euv", "aia_171"):
        compare(instrument, size)


if __name__ == "__main__":
    main()
