"""The ``heliopsf`` command."""

from __future__ import annotations

import re
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory, TemporaryFile
from typing import Any, get_args

import click
from pydantic import ValidationError

from psfcore.errors import DataError
from service import (
    cli_diffraction,
    cli_effects,
    cli_evaluate,
    cli_flare,
    cli_gap,
    cli_psf_query,
    cli_simulate,
)
from service.client import DEFAULT_SERVER, Heliopsf, Operations, ServiceError, percent
from workers.contract import Component, Method, ShapeName
from workers.settings import Settings, software_version

METHODS = [get_args(kind.model_fields["name"].annotation)[0] for kind in get_args(get_args(Method)[0])]
Report = Callable[[str, int, int], None]
SERVER = click.option(
    "--server", envvar="HELIOPSF_SERVER", help=f"Service to use [default: {DEFAULT_SERVER}]"
)
LOCAL = click.option("--local", is_flag=True, help="Run in this process, without a service")


@click.group(context_settings={"help_option_names": ["-h", "--help"]})
@click.version_option(software_version(), prog_name="heliopsf")
def main() -> None:
    """Point-spread functions of solar EUV telescopes, and images freed of their stray light."""


@main.command()
@click.option("--host", default="127.0.0.1", show_default=True)
@click.option("--port", default=8765, show_default=True, help="0 takes a free port")
@click.option("--data", type=click.Path(file_okay=False, path_type=Path), help="Folder for everything kept")
def serve(host: str, port: int, data: Path | None) -> None:
    """Serve over HTTP until interrupted.

    With no broker set (HELIOPSF_BROKER_URL) a worker is started beside the service.
    """
    from service.server import serve as run

    settings = _settings(data)
    where = settings.data_dir.resolve()
    try:
        where.mkdir(parents=True, exist_ok=True)
        with TemporaryFile(dir=where):
            pass
    except OSError as error:
        raise click.ClickException(f"cannot keep data in {where}: {error.strerror or error}") from error
    try:
        run(settings, host, port, lambda url: click.echo(f"heliopsf serves {url} (data in {where})"))
    except OSError as error:
        raise click.ClickException(f"cannot listen on {host}:{port}: {error.strerror or error}") from error


@main.command()
@click.option("--processes", type=click.IntRange(1), help="Worker processes [default: 1]")
@click.option("--data", type=click.Path(file_okay=False, path_type=Path), help="Folder for everything kept")
@click.option("--stop-with-parent", type=int, metavar="PID", hidden=True)
def worker(processes: int | None, data: Path | None, stop_with_parent: int | None) -> None:
    """Run jobs from the broker until interrupted. Start as many as there are machines."""
    import os

    from service.server import environment

    # The worker's module reads its settings when Celery imports it, so they go by the environment.
    update: dict[str, Any] = {} if processes is None else {"worker_processes": processes}
    os.environ |= environment(_settings(data).model_copy(update=update))
    from workers.worker import main as run

    run(stop_with_parent)


@main.command()
@click.argument("image", type=click.Path(exists=True, dir_okay=False, path_type=Path))
@click.option("-o", "--output", required=True, type=click.Path(dir_okay=False, path_type=Path))
@click.option("--psf", metavar="ID|FILE", help="PSF id, or a PSF file [default: the image's instrument]")
@click.option("--method", type=click.Choice(METHODS), default=METHODS[0], show_default=True)
@click.option(
    "--steps", type=click.IntRange(1, 200), help="Steps [default: the method's; Richardson-Lucy 20]"
)
@click.option("--stop", type=click.Choice(["fixed", "discrepancy"]), help="When to stop [default: fixed]")
@click.option(
    "--edges", type=click.Choice(["zero", "symmetric", "extended"]), help="[default: the method's best]"
)
@click.option("--noise", nargs=2, type=float, metavar="GAIN READ", help="DN a photon, DN rms of the readout")
@click.option("--saturation", "saturation_dn", type=float, help="DN from which a pixel is not trusted")
@click.option(
    "--errors", "error_draws", type=click.IntRange(0, 64), default=0, help="Noise draws for an ERROR plane"
)
@click.option("--preview", type=click.Path(dir_okay=False, path_type=Path), help="Write a picture too (PNG)")
@click.option(
    "--effects", type=click.Path(dir_okay=False, path_type=Path), help="And one of all effects (PNG)"
)
@SERVER
@LOCAL
def deconvolve(
    image: Path,
    output: Path,
    psf: str | None,
    method: str,
    steps: int | None,
    stop: str | None,
    edges: str | None,
    noise: tuple[float, float] | None,
    saturation_dn: float | None,
    error_draws: int,
    preview: Path | None,
    effects: Path | None,
    server: str | None,
    local: bool,
) -> None:
    """Deconvolve IMAGE with the PSF of its instrument, or with one that you name."""
    _check_writable(output, preview, effects)
    with _errors(), _connection(server, local) as service, _progress_bar() as report:
        psf_id = _psf_id(service, psf)
        product = service.deconvolve(
            image,
            output,
            psf_id=psf_id,
            method=method,
            preview=preview,
            progress=report,
            noise=noise or None,
            saturation_dn=saturation_dn,
            error_draws=error_draws,
            effects=effects,
            steps=steps,
            stop=stop,
            edges=edges,
        )
    details = product["details"]
    click.echo(f"{output}: PSF {product['psf_version']}, product {product['id'][:12]}")
    click.echo(f"{details['steps_done']} steps ({details['stopped_because']}), edges {details['edges']}")
    click.echo(
        f"flux {percent(details['flux_change_pct'], 3)}, brightest 1 % of pixels "
        f"{percent(details['bright_change_pct'])}, darkest 1 % {percent(details['dark_change_pct'])}"
    )


@main.group()
def psf() -> None:
    """Build and list PSFs."""


@psf.command("build")
@click.option(
    "--instrument", required=True, metavar="NAME|FILE", help="hri_euv, or an instrument file (TOML)"
)
@click.option("--size", default=2048, show_default=True, help="Edge of the array in pixels")
@click.option(
    "--component", type=click.Choice(get_args(Component)), help="One part alone [default: the whole PSF]"
)
@click.option("-o", "--output", required=True, type=click.Path(dir_okay=False, path_type=Path))
@click.option("--preview", type=click.Path(dir_okay=False, path_type=Path), help="Write a picture too (PNG)")
@SERVER
@LOCAL
def psf_build(
    instrument: str,
    size: int,
    component: str | None,
    output: Path,
    preview: Path | None,
    server: str | None,
    local: bool,
) -> None:
    """Build the PSF of an instrument."""
    _check_writable(output, preview)
    with (
        _errors(),
        _mask_beside(instrument) as mask,
        _connection(server, local) as service,
        _progress_bar() as report,
    ):
        built = service.build_psf(
            instrument,
            output,
            size=size,
            component=component,
            mask=mask,
            preview=preview,
            progress=report,
        )
    click.echo(f"{output}: {built['name']} {built['version']} ({built['status']})")
    for radius, beyond_pct in built["details"]["cumulative_curve_pct"].items():
        click.echo(f"  light beyond {radius:>5} px  {beyond_pct:6.2f} %")


@psf.command("fit")
@click.argument("transit", type=click.Path(exists=True, path_type=Path))
@click.option("-o", "--output", required=True, type=click.Path(dir_okay=False, path_type=Path))
@click.option(
    "--json", "report_file", type=click.Path(dir_okay=False, path_type=Path), help="Write the report"
)
@click.option("--plot", type=click.Path(dir_okay=False, path_type=Path), help="Write a picture too (PNG)")
@click.option("--shape", type=click.Choice(get_args(ShapeName)), help="[default: softened-power-law]")
@click.option("--as-published", is_flag=True, help="Also the published recipe and its four biases (slow)")
@click.option("--noise", nargs=2, type=float, metavar="GAIN READ", help="DN a photon, DN rms of the readout")
@click.option("--saturation", "saturation_dn", type=float, help="DN from which a pixel is not trusted")
@SERVER
@LOCAL
def psf_fit(
    transit: Path,
    output: Path,
    report_file: Path | None,
    plot: Path | None,
    shape: str | None,
    as_published: bool,
    noise: tuple[float, float] | None,
    saturation_dn: float | None,
    server: str | None,
    local: bool,
) -> None:
    """Fit the scattered light of TRANSIT, a folder (or a .zip or .tar of one) with a transit.json."""
    _check_writable(output, report_file, plot)
    with _errors(), _connection(server, local) as service, _progress_bar() as report:
        fitted = service.fit_psf(
            transit,
            output,
            report=report_file,
            preview=plot,
            progress=report,
            noise=noise or None,
            shape=shape,
            as_published=as_published,
            saturation_dn=saturation_dn,
        )
    found = fitted["details"]["fit"]
    click.echo(f"{output}: {fitted['name']} {fitted['version']} ({fitted['status']})")
    click.echo(found["sentence"])
    for name, parameter in found["parameters"].items():
        click.echo(f"  {name:<12} {parameter['value']:10.4f} +- {parameter['sigma']:.4f} {parameter['unit']}")
    curve = found["curve"]
    for radius, beyond, sigma in zip(
        curve["radii_px"], curve["light_beyond_pct"], curve["sigma"], strict=True
    ):
        click.echo(f"  light beyond {radius:>6g} px  {beyond:6.2f} +- {sigma:.2f} %")
    for limit in found["limits"]:
        click.echo(f"  note: {limit}")


@psf.command("crossval")
@click.argument("transit", type=click.Path(exists=True, path_type=Path))
@click.option(
    "--json",
    "report_file",
    required=True,
    type=click.Path(dir_okay=False, path_type=Path),
    help="Write the report",
)
@click.option("--plot", type=click.Path(dir_okay=False, path_type=Path), help="Write a picture too (PNG)")
@click.option("--scheme", type=click.Choice(["shared", "exact"]), help="[default: shared; exact is slow]")
@click.option("--runs", type=click.IntRange(1, 50), help="Each holds every block out once [default: 10]")
@click.option("--shape", type=click.Choice(get_args(ShapeName)), help="[default: softened-power-law]")
@click.option("--noise", nargs=2, type=float, metavar="GAIN READ", help="DN a photon, DN rms of the readout")
@SERVER
@LOCAL
def psf_crossval(
    transit: Path,
    report_file: Path,
    plot: Path | None,
    scheme: str | None,
    runs: int | None,
    shape: str | None,
    noise: tuple[float, float] | None,
    server: str | None,
    local: bool,
) -> None:
    """Say how well the fit of TRANSIT is known: blocks of images held out, the others drawn again."""
    _check_writable(report_file, plot)
    with _errors(), _connection(server, local) as service, _progress_bar() as report:
        found = service.cross_validate(
            transit,
            report_file,
            preview=plot,
            progress=report,
            noise=noise or None,
            scheme=scheme,
            runs=runs,
            shape=shape,
        )
    click.echo(f"{report_file}: {found['details']['sentence']}")


@psf.command("show")
@click.argument("file", type=click.Path(exists=True, dir_okay=False, path_type=Path))
@click.option("--plot", type=click.Path(dir_okay=False, path_type=Path), help="Write a picture (PNG)")
def psf_show(file: Path, plot: Path | None) -> None:
    """Say what a PSF file holds: its numbers, and a picture."""
    with _errors():
        click.echo("\n".join(cli_diffraction.show(file, plot)))


@psf.command("list")
@click.option("--instrument", help="Only this instrument's")
@SERVER
def psf_list(instrument: str | None, server: str | None) -> None:
    """List the PSF versions of a service."""
    with _errors(), Heliopsf(server) as service:
        rows = list(service.psfs(**({"instrument": instrument} if instrument else {})))
    if not rows:
        click.echo("no PSF yet: `heliopsf psf build` makes one, and so does the first deconvolution")
    for row in rows:
        size = "x".join(map(str, row["details"]["shape"]))
        click.echo(f"{row['id']}  {row['name']}  {row['version']}  {row['status']}  {size}")


@main.command()
@click.option(
    "--image", type=click.Path(exists=True, dir_okay=False, path_type=Path), help="An image of yours"
)
@click.option(
    "--output",
    default="heliopsf-demo",
    show_default=True,
    type=click.Path(file_okay=False, path_type=Path),
    help="Folder for the results",
)
def demo(image: Path | None, output: Path) -> None:
    """Show the whole way: a service, an upload, a deconvolution, the product and its picture."""
    from service.demo import run

    with _errors(), _progress_bar() as report:
        found = run(image, output, report)
    click.echo("\n".join(found))


def _settings(data: Path | None) -> Settings:
    try:
        return Settings() if data is None else Settings(data_dir=data)
    except ValidationError as error:
        faults = (
            f"HELIOPSF_{str(e['loc'][0]).upper()}: {e['msg']}; got {e['input']!r}" for e in error.errors()
        )
        raise click.ClickException("; ".join(faults)) from error


@contextmanager
def _connection(server: str | None, local: bool) -> Iterator[Operations]:
    """A service over HTTP, or one that lives in this process."""
    if not local:
        with Heliopsf(server) as remote:
            remote.health()
            yield remote
        return
    from service.local import local_service

    with local_service() as service:
        yield service


def _check_writable(*files: Path | None) -> None:
    """Say so before the work, not after it, where a result could not be written."""
    for file in files:
        if file is not None and not file.resolve().parent.is_dir():
            raise click.ClickException(f"cannot write {file}: there is no folder {file.resolve().parent}")


def _psf_id(service: Operations, psf: str | None) -> str | None:
    """The id of the PSF that the user named: a file is uploaded, an id taken as it is."""
    if psf is None or re.fullmatch(r"[0-9a-f]{64}", psf):
        return psf
    if not Path(psf).is_file():
        raise click.ClickException(f"--psf: expected a PSF id (64 hexadecimal digits) or a file; got {psf!r}")
    uploaded: str = service.upload_psf(psf)["id"]
    return uploaded


@contextmanager
def _mask_beside(instrument: str) -> Iterator[Path | None]:
    """The mask image that an instrument file of the user's names, as FITS; None where there is none."""
    if not instrument.endswith(".toml"):
        yield None
        return
    with TemporaryDirectory() as folder:
        yield cli_diffraction.mask_as_fits(Path(instrument), Path(folder))


@contextmanager
def _errors() -> Iterator[None]:
    """Errors of the user's in one line, without a traceback."""
    try:
        yield
    except DataError as error:
        raise click.ClickException(error.message) from error
    except (ServiceError, TimeoutError, OSError) as error:
        raise click.ClickException(str(error)) from error


@contextmanager
def _progress_bar() -> Iterator[Report]:
    """A bar on a terminal; nothing where the output is no terminal."""
    if not sys.stderr.isatty():
        yield lambda stage, step, steps: None
        return
    lock = threading.Lock()
    started = time.monotonic()

    def report(stage: str, step: int, steps: int) -> None:
        done = step / steps
        bar = "#" * round(30 * done) + "-" * (30 - round(30 * done))
        elapsed = time.monotonic() - started
        left = f", {elapsed * (steps - step) / step:.0f} s left" if step else ""
        with lock:
            sys.stderr.write(f"\r{stage:<24.24} [{bar}] {step}/{steps}  {elapsed:5.1f} s{left:<14}")
            sys.stderr.flush()

    try:
        yield report
    finally:
        sys.stderr.write("\n")


for module in (cli_diffraction, cli_simulate, cli_gap, cli_evaluate, cli_flare, cli_effects):
    for command in module.COMMANDS:
        main.add_command(command)
for command in cli_psf_query.COMMANDS:
    psf.add_command(command)


if __name__ == "__main__":
    main()
