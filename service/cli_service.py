"""A service for a command: over HTTP, or in this process."""

from __future__ import annotations

import re
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import click

from service.client import DEFAULT_SERVER, Heliopsf, Operations

SERVER = click.option(
    "--server", envvar="HELIOPSF_SERVER", help=f"Service to use [default: {DEFAULT_SERVER}]"
)
LOCAL = click.option("--local", is_flag=True, help="Run in this process, without a service")


@contextmanager
def connection(server: str | None, local: bool) -> Iterator[Operations]:
    """A service over HTTP, or one that lives in this process."""
    if not local:
        with Heliopsf(server) as remote:
            remote.health()
            yield remote
        return
    from service.local import local_service

    with local_service() as service:
        yield service


def named_psf(service: Operations, psf: str | None) -> str | None:
    """The id of the PSF that the user named: a file is uploaded, an id taken as it is. Raises ``ClickException``."""
    if psf is None or re.fullmatch(r"[0-9a-f]{64}", psf):
        return psf
    if not Path(psf).is_file():
        raise click.ClickException(f"--psf: expected a PSF id (64 hexadecimal digits) or a file; got {psf!r}")
    uploaded: str = service.upload_psf(psf)["id"]
    return uploaded
