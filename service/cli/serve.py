"""The commands ``serve``, ``worker`` and ``demo``."""

from __future__ import annotations

import os
import shlex
import shutil
import subprocess
import sys
from pathlib import Path
from tempfile import TemporaryFile
from typing import TYPE_CHECKING
from urllib.parse import urlsplit

import click

from psfcore.deconvolve.summary import percent
from service.cli.options import (
    DATA,
    FILE,
    OUTPUT_FOLDER,
    Text,
    check_fresh_folder,
    read_settings,
)
from service.cli.progress import echo, progress_bar
from service.client.errors import WaitInterrupted
from service.client.operations import Progress, without_none
from service.client.outputs import check_outputs
from workers.contract.jobs import Queue, queues_named

if TYPE_CHECKING:
    from service.client.answers import Product
    from service.client.http import Client

# Longer than HELIOPSF_LEASE_S and HELIOPSF_RECONCILE_S together: the job of a lost worker is then found before others
# end.
IDLE_S = 30.0
DEMO_DATA = "data"
DEMO_LOG = "server.log"  # a later demo recognises the folder of an earlier demo by this file


@click.command()
@click.option("--host", default="127.0.0.1", help="Address to listen on")
@click.option("--port", default=8765, help="Port to listen on; 0: any free port")
@DATA
@click.option(
    "-v",
    "--verbose",
    is_flag=True,
    help="Also log every request on a terminal; a log that is not on a terminal always contains every request",
)
def serve(host: str, port: int, data: Path | None, verbose: bool) -> None:
    """Start a service over HTTP, and keep it running until it is interrupted.

    If no broker is set (HELIOPSF_BROKER_URL), the command also starts a worker. If other machines can reach the
    address, every request needs a key; make keys with `heliopsf key create`.
    """
    from sqlalchemy.exc import SQLAlchemyError

    from service.http.state import Access, NoKeyYet
    from service.server import serve as run
    from workers import checks
    from workers.catalogue.schema import SchemaError
    from workers.files.modes import keep_private, private_folder

    settings = read_settings(data)
    where = settings.data_dir.resolve()
    keep_private()
    try:
        private_folder(where)
        with TemporaryFile(dir=where):
            pass
    except OSError as error:
        raise click.ClickException(f"cannot keep data in {where}: {error.strerror or error}") from error
    log_in = " and log in with a key" if Access.of(settings, host).keys else ""

    def announce(url: str) -> None:
        echo(f"heliopsf serves {url} (data in {where})\nOpen {browser_address(url)} in a browser{log_in}.")

    try:
        run(settings, host, port, announce, verbose=verbose)
    except (SchemaError, NoKeyYet) as error:
        raise click.ClickException(str(error)) from error
    except SQLAlchemyError as error:
        raise click.ClickException(f"the database: {checks.database_said(error)}") from error
    except OSError as error:
        raise click.ClickException(f"cannot listen on {host}:{port}: {error.strerror or error}") from error


def browser_address(url: str) -> str:
    """The address at which a browser on this machine reaches a service that listens at ``url``."""
    parts = urlsplit(url)
    # All addresses of the machine; a browser cannot open this one.
    everywhere = parts.hostname in ("0.0.0.0", "::")  # noqa: S104  # a comparison
    return f"http://localhost:{parts.port}" if everywhere else url


@click.command()
@click.option("--processes", type=click.IntRange(1), help="Number of worker processes [default: 1]")
@click.option(
    "--queues",
    type=Text(queues_named, keep=True),
    help=f"Queues to serve, separated by commas: {', '.join(Queue)} [default: all]",
)
@click.option(
    "--until-idle",
    type=click.FloatRange(0, min_open=True),
    is_flag=False,
    flag_value=IDLE_S,
    metavar="[SECONDS]",
    help="End with status 0 when this worker has run no job, and no job of its queues has waited, for SECONDS "
    f"[without SECONDS: {IDLE_S:g}]",
)
@DATA
@click.option("--stop-with-parent", type=int, metavar="PID", hidden=True)
def worker(
    processes: int | None,
    queues: str | None,
    until_idle: float | None,
    data: Path | None,
    stop_with_parent: int | None,
) -> None:
    """Run jobs from the broker until interrupted. Start one worker on each machine.

    Jobs that people wait for (queue interactive) run first, then cross-validations (crossval), then bulk runs (bulk).
    The order of the queues in --queues has no effect. Use --until-idle in jobs of Slurm, HTCondor or Kubernetes.
    """
    from service.server import environment
    from workers.files.modes import keep_private

    # Celery imports the worker's module, which reads its settings from the environment.
    options = without_none({"worker_processes": processes, "worker_queues": queues})
    settings = read_settings(data)
    os.environ |= environment(settings.model_copy(update=options))
    from workers.run.worker import main as run

    keep_private()
    run(stop_with_parent, until_idle)


@click.command()
@click.option("--image", type=FILE, help="Your own image (FITS) [default: a simulated image]")
@click.option("-o", "--output", default="heliopsf-demo", type=OUTPUT_FOLDER, help="Folder for the results")
def demo(image: Path | None, output: Path) -> None:
    """Start a service, upload an image, deconvolve it, download the product, and stop the service.

    A second demo replaces the files of the first one. The folder must be new, empty, or the folder of an earlier demo.
    """
    check_fresh_folder(output, overwrite=(output / DEMO_LOG).is_file())
    with progress_bar() as report:
        lines = run_demo(image, output, report)
    echo("\n".join(lines))


def run_demo(image: Path | None, output: Path, progress: Progress) -> list[str]:
    """Start a service on a free port, upload and deconvolve an image, download the product, stop the service. Returns
    lines to print.
    """
    from service.client.http import Client

    if image is not None:
        product_file, picture = _results_for(image, output)
        check_outputs((product_file, picture), inputs=(image,), overwrite=True)
    output.mkdir(exist_ok=True)
    with (output / DEMO_LOG).open("w") as log:
        # -P: nothing is imported from the working folder
        python = [sys.executable, "-P", "-m", "service.cli"]
        server = subprocess.Popen(
            [*python, "serve", "--port", "0", "--data", str(output / DEMO_DATA)],
            # The demo uses its own service, even if the environment names another service.
            env={key: value for key, value in os.environ.items() if not key.startswith("HELIOPSF_")},
            stdout=subprocess.PIPE,
            stderr=log,
            text=True,
        )
        try:
            assert server.stdout is not None
            line = server.stdout.readline()  # the server prints its address when it starts to listen
            if " serves " not in line:
                raise OSError(f"the server of the demo did not start; read {output / DEMO_LOG}")
            with Client(line.split(" serves ")[1].split()[0]) as service:
                service.wait_until_up()
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
    return demo_lines(output, image, product_file, picture, product)


def demo_lines(output: Path, image: Path, product_file: Path, picture: Path, product: Product) -> list[str]:
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
        f"    {_command()} serve --data {shlex.quote(str(output / DEMO_DATA))}",
        f"and open its address with this path: /products/{product['id']}",
    ]


def _command() -> str:
    """How to call heliopsf: by its name if the shell finds this name, otherwise by its path in the folder of Python,
    as after ``make demo``.
    """
    beside = Path(sys.executable).with_name("heliopsf")
    if shutil.which("heliopsf") or not beside.exists():
        return "heliopsf"
    here = Path.cwd()
    return shlex.quote(str(beside.relative_to(here) if beside.is_relative_to(here) else beside))


def _results_for(image: Path, output: Path) -> tuple[Path, Path]:
    """The product and the picture of an image."""
    return output / f"{image.stem}-deconvolved.fits", output / f"{image.stem}-preview.png"


def _simulated(service: Client, output: Path, progress: Progress) -> Path:
    """A simulated image, convolved with the PSF that the service builds."""
    # The simulation is imported here, because a demo with the user's own image does not need it.
    from psfcore.fits.blocks import FitsLimits
    from psfcore.fits.psfs import read_psf
    from psfcore.simulate.scene import demo_image

    psf_file, image = output / "psf.fits", output / "simulated.fits"
    service.build_psf("hri_euv", psf_file, preview=output / "psf.png", progress=progress, overwrite=True)
    demo_image(image, read_psf(psf_file, FitsLimits(max_pixels=2048 * 2048)))
    return image
