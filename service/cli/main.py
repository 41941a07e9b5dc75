"""The ``heliopsf`` command."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory, TemporaryFile
from typing import Any, get_args

import click
from sqlalchemy.exc import SQLAlchemyError

from service.cli import bulk as cli_bulk
from service.cli import changes as cli_effects
from service.cli import context as cli_context
from service.cli import diffraction as cli_diffraction
from service.cli import evaluate as cli_evaluate
from service.cli import flare as cli_flare
from service.cli.gap import diagnose as cli_gap
from service.cli import report as cli_report
from service.cli import simulate as cli_simulate
from service.cli.connection import LOCAL, SERVER, connection, named_psf
from service.cli.operator import database as cli_database
from service.cli.operator import doctor as cli_doctor
from service.cli.operator import key as cli_key
from service.cli.operator import store as cli_store
from service.cli.options import (
    FILE,
    METHODS,
    NOISE,
    OUTPUT,
    OUTPUT_FOLDER,
    PLOT,
    SATURATION,
    check_writable,
    progress_bar,
    read_settings,
    user_errors,
)
from service.cli.psf import query as cli_psf_query
from service.cli.psf import versions as cli_psf_versions
from service.client.http import percent
from workers import checks
from workers.catalogue.schema import SchemaError
from workers.contract.contract import Component, ShapeName
from workers.contract.queues import Queue, queues_named
from workers.settings import software_version


@click.group(context_settings={"help_option_names": ["-h", "--help"]})
@click.version_option(software_version(), prog_name="heliopsf")
def main() -> None:
    """Point-spread functions of solar EUV telescopes, and images freed of their stray light."""


@main.command()
@click.option("--host", default="127.0.0.1", show_default=True)
@click.option("--port", default=8765, show_default=True, help="0 takes a free port")
@click.option("--data", type=OUTPUT_FOLDER, help="Folder for everything kept")
def serve(host: str, port: int, data: Path | None) -> None:
    """Serve over HTTP until interrupted.

    With no broker set (HELIOPSF_BROKER_URL) a worker is started beside the service. On an address that other machines
    reach, every request needs a key: `heliopsf key create`.
    """
    from service.http.access import NoKeyYet
    from service.server import serve as run

    settings = read_settings(data)
    where = settings.data_dir.resolve()
    try:
        where.mkdir(parents=True, exist_ok=True)
        with TemporaryFile(dir=where):
            pass
    except OSError as error:
        raise click.ClickException(f"cannot keep data in {where}: {error.strerror or error}") from error
    try:
        run(settings, host, port, lambda url: click.echo(f"heliopsf serves {url} (data in {where})"))
    except (SchemaError, NoKeyYet) as error:
        raise click.ClickException(str(error)) from error
    except SQLAlchemyError as error:
        raise click.ClickException(f"the database: {checks.database_said(error)}") from error
    except OSError as error:
        raise click.ClickException(f"cannot listen on {host}:{port}: {error.strerror or error}") from error


@main.command()
@click.option("--processes", type=click.IntRange(1), help="Worker processes [default: 1]")
@click.option("--queues", help=f"Of {', '.join(Queue)}, separated by commas [default: all]")
@click.option("--data", type=OUTPUT_FOLDER, help="Folder for everything kept")
@click.option("--stop-with-parent", type=int, metavar="PID", hidden=True)
def worker(
    processes: int | None, queues: str | None, data: Path | None, stop_with_parent: int | None
) -> None:
    """Run jobs from the broker until interrupted. Start as many as there are machines.

    What people wait for (interactive) goes before cross-validations (crossval), and these before bulk, whatever the
    order that queues are named in.
    """
    import os

    from service.server import environment

    # The worker's module reads its settings when Celery imports it, so they go by the environment.
    update: dict[str, Any] = {"worker_processes": processes, "worker_queues": queues}
    given = {name: value for name, value in update.items() if value is not None}
    if queues is not None:
        try:
            queues_named(queues)
        except ValueError as error:
            raise click.BadParameter(str(error), param_hint="--queues") from error
    os.environ |= environment(read_settings(data).model_copy(update=given))
    from workers.run.worker import main as run

    run(stop_with_parent)


@main.command()
@click.argument("image", type=FILE)
@click.option("-o", "--output", required=True, type=OUTPUT)
@click.option("--psf", metavar="ID|FILE", help="PSF id, or a PSF file [default: the image's instrument]")
@click.option("--method", type=click.Choice(METHODS), default=METHODS[0], show_default=True)
@click.option(
    "--steps", type=click.IntRange(1, 200), help="Steps [default: the method's; Richardson-Lucy 20]"
)
@click.option("--stop", type=click.Choice(["fixed", "discrepancy"]), help="When to stop [default: fixed]")
@click.option(
    "--edges", type=click.Choice(["zero", "symmetric", "extended"]), help="[default: the method's best]"
)
@NOISE
@SATURATION
@click.option(
    "--errors",
    "error_draws",
    type=click.IntRange(0, 64),
    default=0,
    help="Noise draws for an ERROR plane: 2 or more, with --noise",
)
@click.option("--preview", type=OUTPUT, help="Write a picture too (PNG)")
@click.option("--effects", type=OUTPUT, help="And one of all effects (PNG)")
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
    check_writable(output, preview, effects)
    with user_errors(), connection(server, local) as service, progress_bar() as report:
        psf_id = named_psf(service, psf)
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
    """Build, fit, look at, certify and list PSFs."""


@psf.command("build")
@click.option(
    "--instrument", required=True, metavar="NAME|FILE", help="hri_euv, or an instrument file (TOML)"
)
@click.option("--size", default=2048, show_default=True, help="Edge of the array in pixels")
@click.option(
    "--component", type=click.Choice(get_args(Component)), help="One part alone [default: the whole PSF]"
)
@click.option("-o", "--output", required=True, type=OUTPUT)
@click.option("--preview", type=OUTPUT, help="Write a picture too (PNG)")
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
    check_writable(output, preview)
    with (
        user_errors(),
        _mask_beside(instrument) as mask,
        connection(server, local) as service,
        progress_bar() as report,
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
@click.option("-o", "--output", required=True, type=OUTPUT)
@click.option("--json", "report_file", type=OUTPUT, help="Write the report")
@click.option("--plot", type=OUTPUT, help="Write a picture too (PNG)")
@click.option("--shape", type=click.Choice(get_args(ShapeName)), help="[default: softened-power-law]")
@click.option("--as-published", is_flag=True, help="Also the published recipe and its four biases (slow)")
@NOISE
@SATURATION
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
    check_writable(output, report_file, plot)
    with user_errors(), connection(server, local) as service, progress_bar() as report:
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
    type=OUTPUT,
    help="Write the report",
)
@click.option("--plot", type=OUTPUT, help="Write a picture too (PNG)")
@click.option("--scheme", type=click.Choice(["shared", "exact"]), help="[default: shared; exact is slow]")
@click.option("--runs", type=click.IntRange(1, 50), help="Each holds every block out once [default: 10]")
@click.option("--shape", type=click.Choice(get_args(ShapeName)), help="[default: softened-power-law]")
@NOISE
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
    check_writable(report_file, plot)
    with user_errors(), connection(server, local) as service, progress_bar() as report:
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
@click.argument("file", type=FILE)
@PLOT
def psf_show(file: Path, plot: Path | None) -> None:
    """Say what a PSF file holds: its numbers, and a picture."""
    with user_errors():
        click.echo("\n".join(cli_diffraction.show(file, plot)))


@main.command()
@click.option("--image", type=FILE, help="An image of yours")
@click.option(
    "--output",
    default="heliopsf-demo",
    show_default=True,
    type=OUTPUT_FOLDER,
    help="Folder for the results",
)
def demo(image: Path | None, output: Path) -> None:
    """Show the whole way: a service, an upload, a deconvolution, the product and its picture."""
    from service.cli.demo import run

    with user_errors(), progress_bar() as report:
        found = run(image, output, report)
    click.echo("\n".join(found))


@contextmanager
def _mask_beside(instrument: str) -> Iterator[Path | None]:
    """The mask image that an instrument file of the user's names, as FITS; None where there is none."""
    if not instrument.endswith(".toml"):
        yield None
        return
    with TemporaryDirectory() as folder:
        yield cli_diffraction.mask_as_fits(Path(instrument), Path(folder))


for module in (
    cli_diffraction,
    cli_simulate,
    cli_gap,
    cli_evaluate,
    cli_report,
    cli_flare,
    cli_effects,
    cli_bulk,
    cli_doctor,
    cli_database,
    cli_store,
    cli_key,
    cli_context,
):
    for command in module.COMMANDS:
        main.add_command(command)
for command in (*cli_psf_query.COMMANDS, *cli_psf_versions.COMMANDS):
    psf.add_command(command)
