"""A service for a command: over HTTP, or in this process."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, TypeVar

import click

from service.client.http import DEFAULT_SERVER, Heliopsf, Operations

_KEY = "heliopsf.key"
Command = TypeVar("Command", bound=Callable[..., Any])


def _remember(context: click.Context, _parameter: click.Parameter, key: str | None) -> None:
    context.meta[_KEY] = key


def server_option(what: str) -> Callable[[Command], Command]:
    """The options of a command that asks a service: which one, and the key that lets it in."""
    key = click.option(
        "--key",
        envvar="HELIOPSF_KEY",
        expose_value=False,
        callback=_remember,
        help="Key for it; HELIOPSF_KEY keeps it out of the list of processes",
    )
    server = click.option("--server", envvar="HELIOPSF_SERVER", help=f"{what} [default: {DEFAULT_SERVER}]")
    return lambda command: server(key(command))


SERVER = server_option("Service to use")
LOCAL = click.option("--local", is_flag=True, help="Run in this process, without a service")


def remote(server: str | None) -> Heliopsf:
    """A service over HTTP, with the key that the command was given."""
    return Heliopsf(server, key=click.get_current_context().meta.get(_KEY))


@contextmanager
def connection(server: str | None, local: bool) -> Iterator[Operations]:
    """A service over HTTP, or one that lives in this process."""
    if not local:
        with remote(server) as service:
            service.health()
            yield service
        return
    from service.local import local_service

    with local_service() as here:
        yield here


def named_psf(service: Operations, psf: str | None) -> str | None:
    """The id of the PSF that the user named: a file is uploaded, an id taken as it is. Raises ``ClickException``."""
    if psf is None or re.fullmatch(r"[0-9a-f]{64}", psf):
        return psf
    if not Path(psf).is_file():
        raise click.ClickException(f"--psf: expected a PSF id (64 hexadecimal digits) or a file; got {psf!r}")
    uploaded: str = service.upload_psf(psf)["id"]
    return uploaded
