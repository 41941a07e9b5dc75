"""The commands ``serve`` and ``worker``."""

from __future__ import annotations

import os
from pathlib import Path
from tempfile import TemporaryFile
from typing import Any
from urllib.parse import urlsplit

import click

from service.cli.options import DATA, read_settings
from workers.contract.queues import Queue, queues_named


@click.command()
@click.option("--host", default="127.0.0.1", show_default=True, help="Address to listen on")
@click.option("--port", default=8765, show_default=True, help="Port to listen on; 0: any free port")
@DATA
@click.option(
    "-v",
    "--verbose",
    is_flag=True,
    help="Also log every request on a terminal; a log that is not on a terminal always contains every request",
)
def serve(host: str, port: int, data: Path | None, verbose: bool) -> None:
    """Start a service over HTTP, and keep it running until it is interrupted.

    If no broker is set (HELIOPSF_BROKER_URL), the command also starts a worker. If other machines can reach the address, every
    request needs a key; make keys with `heliopsf key create`.
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
        click.echo(
            f"heliopsf serves {url} (data in {where})\nOpen {browser_address(url)} in a browser{log_in}."
        )

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
    everywhere = parts.hostname in (
        "0.0.0.0",
        "::",
    )  # all addresses of the machine; a browser cannot open this one
    return f"http://localhost:{parts.port}" if everywhere else url


@click.command()
@click.option("--processes", type=click.IntRange(1), help="Number of worker processes [default: 1]")
@click.option("--queues", help=f"Queues to serve, separated by commas: {', '.join(Queue)} [default: all]")
@DATA
@click.option("--stop-with-parent", type=int, metavar="PID", hidden=True)
def worker(
    processes: int | None, queues: str | None, data: Path | None, stop_with_parent: int | None
) -> None:
    """Run jobs from the broker until interrupted. Start one worker on each machine.

    Jobs that people wait for (queue interactive) run first, then cross-validations (crossval), then bulk runs (bulk).
    The order of the queues in --queues has no effect.
    """
    from service.server import environment
    from workers.files.modes import keep_private

    # Celery imports the worker's module, which reads its settings from the environment.
    update: dict[str, Any] = {"worker_processes": processes, "worker_queues": queues}
    given = {name: value for name, value in update.items() if value is not None}
    if queues is not None:
        try:
            queues_named(queues)
        except ValueError as error:
            raise click.BadParameter(str(error), param_hint="--queues") from error
    settings = read_settings(data)
    if stop_with_parent is None:  # otherwise the server that started this worker has printed the folder
        click.echo(f"heliopsf worker (data in {settings.data_dir.resolve()})", err=True)
    os.environ |= environment(settings.model_copy(update=given))
    from workers.run.worker import main as run

    keep_private()
    run(stop_with_parent)
