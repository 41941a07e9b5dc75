"""The command ``demo``: starts a service, processes one image from upload to product, and stops the service."""

from __future__ import annotations

import os
import shlex
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

import click

from service.cli.options import (
    FILE,
    OUTPUT_FOLDER,
    check_fresh_folder,
    percent,
    progress_bar,
    user_errors,
)
from service.client.errors import WaitInterrupted
from service.client.http import Client
from service.client.operations import Progress
from service.client.outputs import check_outputs

DATA = "data"
LOG = "server.log"  # a later demo recognises the folder of an earlier demo by this file


@click.command()
@click.option("--image", type=FILE, help="Your own image (FITS) [default: a simulated image]")
@click.option(
    "-o",
    "--output",
    default="heliopsf-demo",
    show_default=True,
    type=OUTPUT_FOLDER,
    help="Folder for the results",
)
def demo(image: Path | None, output: Path) -> None:
    """Start a service, upload an image, deconvolve it, download the product, and stop the service.

    A second demo replaces the files of the first one. The folder must be new, empty, or the folder of an earlier demo.
    """
    check_fresh_folder(output, overwrite=(output / LOG).is_file())
    with user_errors(), progress_bar() as report:
        lines = run(image, output, report)
    click.echo("\n".join(lines))


def run(image: Path | None, output: Path, progress: Progress) -> list[str]:
    """Start a service on a free port, upload and deconvolve an image, download the product, stop the service. Returns lines to print."""
    if image is not None:
        product_file, picture = _results_for(image, output)
        check_outputs((product_file, picture), inputs=(image,), overwrite=True)
    output.mkdir(exist_ok=True)
    with (output / LOG).open("w") as log:
        server = subprocess.Popen(
            [
                sys.executable,
                "-P",  # nothing is imported from the working folder
                "-m",
                "service.cli",
                "serve",
                "--port",
                "0",
                "--data",
                str(output / DATA),
            ],
            # The demo uses its own service, even if the environment names another service.
            env={key: value for key, value in os.environ.items() if not key.startswith("HELIOPSF_")},
            stdout=subprocess.PIPE,
            stderr=log,
            text=True,
        )
        try:
            with Client(_address(server, output)) as service:
                if image is None:
                    image = _simulated(service, output, progress)
                product_file, picture = _results_for(image, output)
                product = service.deconvolve(
                    image, product_file, preview=picture, progress=progress, overwrite=True
                )
        except WaitInterrupted as stop:
            raise KeyboardInterrupt from stop  # the job does not continue, because the demo stops its service
        finally:
            server.terminate()
            server.wait(60)
    return said(output, image, product_file, picture, product)


def said(output: Path, image: Path, product_file: Path, picture: Path, product: dict[str, Any]) -> list[str]:
    """What the demo prints at its end: its files, what changed, and how to look at the product in a browser."""
    change = product["details"]
    return [
        f"image    {image}",
        f"product  {product_file}",
        f"picture  {picture}",
        f"PSF      {product['psf_version']} (id {product['psf_id'][:12]}, in the product's header)",
        f"change   brightest 1 % of pixels {percent(change['bright_change_pct'])}, "
        f"flux of the frame {percent(change['flux_change_pct'], 3)}",
        "",
        "To look at the product in a browser, start the service of the demo again:",
        f"    {_command()} serve --data {shlex.quote(str(output / DATA))}",
        f"and open its address with this path: /products/{product['id']}",
    ]


def _command() -> str:
    """How to call heliopsf: by its name if the shell finds this name, otherwise by its path in the folder of Python,
    as after ``make demo``."""
    beside = Path(sys.executable).with_name("heliopsf")
    if shutil.which("heliopsf") or not beside.exists():
        return "heliopsf"
    here = Path.cwd()
    return shlex.quote(str(beside.relative_to(here) if beside.is_relative_to(here) else beside))


def _results_for(image: Path, output: Path) -> tuple[Path, Path]:
    """The product and the picture of an image."""
    return output / f"{image.stem}-deconvolved.fits", output / f"{image.stem}-preview.png"


def _address(server: subprocess.Popen[str], output: Path) -> str:
    """The address of the server, which the server prints when it starts to listen."""
    assert server.stdout is not None
    line = server.stdout.readline()
    if " serves " not in line:
        raise OSError(f"the server of the demo did not start; read {output / LOG}")
    address = line.split(" serves ")[1].split()[0]
    with Client(address) as service:
        service.wait_until_up()
    return address


def _simulated(service: Client, output: Path, progress: Progress) -> Path:
    """A simulated image, convolved with the PSF that the service builds."""
    # The simulation is imported here, because a demo with the user's own image does not need it.
    from psfcore.fits.header import FitsLimits
    from psfcore.fits.psfs import read_psf
    from psfcore.simulate.observe import demo_image

    psf_file, image = output / "psf.fits", output / "simulated.fits"
    service.build_psf("hri_euv", psf_file, preview=output / "psf.png", progress=progress, overwrite=True)
    demo_image(image, read_psf(psf_file, FitsLimits(max_pixels=2048 * 2048)))
    return image
