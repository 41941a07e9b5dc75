"""``heliopsf demo``: the whole way of one image, with everything real and nothing left running."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

from service.client.http import Heliopsf, Progress, percent


def run(image: Path | None, output: Path, progress: Progress) -> list[str]:
    """Serve on a free port, upload, deconvolve, download, stop; returns what to tell the user."""
    output.mkdir(parents=True, exist_ok=True)
    with (output / "server.log").open("w") as log:
        server = subprocess.Popen(
            [
                sys.executable,
                "-m",
                "service.cli",
                "serve",
                "--port",
                "0",
                "--data",
                str(output / "data"),
            ],
            # Whatever service the environment names, the demo keeps to itself.
            env={key: value for key, value in os.environ.items() if not key.startswith("HELIOPSF_")},
            stdout=subprocess.PIPE,
            stderr=log,
            text=True,
        )
        try:
            with Heliopsf(_address(server, output)) as service:
                if image is None:
                    image = _simulated(service, output, progress)
                product_file = output / f"{image.stem}-deconvolved.fits"
                picture = output / f"{image.stem}-preview.png"
                product = service.deconvolve(image, product_file, preview=picture, progress=progress)
        finally:
            server.terminate()
            server.wait(60)
    change = product["details"]
    return [
        f"image    {image}",
        f"product  {product_file}",
        f"picture  {picture}",
        f"PSF      {product['psf_version']} (id {product['psf_id'][:12]}, in the product's header)",
        f"change   brightest 1 % of pixels {percent(change['bright_change_pct'])}, "
        f"flux of the frame {percent(change['flux_change_pct'], 3)}",
    ]


def _address(server: subprocess.Popen[str], output: Path) -> str:
    """The address that the server announces once it listens."""
    assert server.stdout is not None
    line = server.stdout.readline()
    if " serves " not in line:
        raise OSError(f"the demo's server did not start; see {output / 'server.log'}")
    address = line.split(" serves ")[1].split()[0]
    with Heliopsf(address) as service:
        service.wait_until_up()
    return address


def _simulated(service: Heliopsf, output: Path, progress: Progress) -> Path:
    """An image seen through the very PSF that the service then takes away again."""
    # Imported here, so that a demo of an image of your own does not load it.
    from psfcore.fits.header import FitsLimits
    from psfcore.fits.psfs import read_psf
    from psfcore.simulate.observe import demo_image

    psf_file, image = output / "psf.fits", output / "simulated.fits"
    service.build_psf("hri_euv", psf_file, preview=output / "psf.png", progress=progress)
    demo_image(image, read_psf(psf_file, FitsLimits(max_pixels=2048 * 2048)))
    return image
