"""Where a command sends its request: to a service over HTTP, or to a service inside this process."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

import click

from service.cli.options import is_psf_id
from service.client.operations import DEFAULT_SERVER, Operations

if TYPE_CHECKING:
    from service.client.http import Client

_KEY = "heliopsf.key"
Command = TypeVar("Command", bound=Callable[..., Any])


def _remember(context: click.Context, _parameter: click.Parameter, key: str | None) -> None:
    context.meta[_KEY] = key


def server_option(what: str) -> Callable[[Command], Command]:
    """The options ``--server`` and ``--key`` of a command that needs a service."""
    key = click.option(
        "--key",
        envvar="HELIOPSF_KEY",
        expose_value=False,
        callback=_remember,
        help="Access key. Other users can read command lines, so set HELIOPSF_KEY instead",
    )
    server = click.option("--server", envvar="HELIOPSF_SERVER", help=f"{what} [default: {DEFAULT_SERVER}]")
    return lambda command: server(key(command))


SERVER = server_option("Address of the service")
LOCAL = click.option("--local", is_flag=True, help="Run in this process, without a service")
PSF = click.option(
    "--psf",
    metavar="ID|FILE",
    help="PSF: an id or a file [default: the certified PSF for the image, else the PSF built for its instrument]",
)


def remote(server: str | None) -> Client:
    """A client of the service at ``server``, with the key that the command was given."""
    from service.client.http import Client

    return Client(server, key=click.get_current_context().meta.get(_KEY))


@contextmanager
def connection(server: str | None, local: bool, *, gap_effects: str = "") -> Iterator[Operations]:
    """A service over HTTP, or with ``local`` a service in this process. gap_effects: further effects of the local service."""
    if not local:
        with remote(server) as service:
            service.health()
            yield service
        return
    from service.local import local_service

    with local_service(gap_effects=gap_effects) as here:
        yield here


def named_psf(service: Operations, psf: str | None) -> str | None:
    """The id of the PSF that the user named; a file is uploaded first. Raises ``ClickException``."""
    if psf is None or is_psf_id(psf):
        return psf
    if not Path(psf).is_file():
        raise click.ClickException(f"--psf: expected a PSF id (64 hexadecimal digits) or a file; got {psf!r}")
    uploaded: str = service.upload_psf(psf)["id"]
    return uploaded
