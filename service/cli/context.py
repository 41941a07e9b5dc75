"""``heliopsf context``: sets of PSFs that stay as they are."""

from __future__ import annotations

import click

from service.cli.connection import SERVER, remote
from service.cli.options import user_errors


@click.group()
def context() -> None:
    """Sets of PSFs that stay as they are, to work with for years."""


@context.command("create")
@click.argument("name")
@click.option(
    "--psf", "psf_ids", multiple=True, metavar="PSF_ID", help="Pin this one [default: all certified]"
)
@click.option("--reason", default="", help="Why, for those who ask later")
@SERVER
def create(name: str, psf_ids: tuple[str, ...], reason: str, server: str | None) -> None:
    """Pin all PSFs that are certified now, or those named, under a NAME."""
    pins = [{"psf_id": psf_id} for psf_id in psf_ids] or None
    with user_errors(), remote(server) as service:
        made = service.create_context(name, pins, reason=reason)
    click.echo(f"{made['id']}  {made['name']}  {made['size']} pinned")


@context.command("list")
@SERVER
def list_contexts(server: str | None) -> None:
    """List contexts; * is the default."""
    with user_errors(), remote(server) as service:
        default = service.default_context()["context"]
        rows = list(service.contexts())
    if not rows:
        click.echo("no context yet: `heliopsf context create NAME` pins what is certified")
    for row in rows:
        sign = "*" if default is not None and default["id"] == row["id"] else " "
        click.echo(f"{sign} {row['id']}  {row['name']}  {row['size']} pinned  {row['reason']}".rstrip())


@context.command("show")
@click.argument("name")
@SERVER
def show(name: str, server: str | None) -> None:
    """Say what a context pins."""
    with user_errors(), remote(server) as service:
        found = service.context(name)
    click.echo(f"{found['id']}  {found['name']}")
    for pin in found["pins"]:
        times = f"[{pin['valid_from'] or 'from ever'}, {pin['valid_to'] or 'open'})"
        click.echo(f"  {pin['series']}  {times}  {pin['version']}  {pin['psf_id']}")


@context.command("use")
@click.argument("name", required=False)
@click.option("--none", "no_context", is_flag=True, help="No context: what is certified at the moment")
@click.option("--reason", default="", help="Why, for those who ask later")
@SERVER
def use(name: str | None, no_context: bool, reason: str, server: str | None) -> None:
    """Make a context the default, in which images are looked up where nobody names another."""
    if (name is None) != no_context:
        raise click.UsageError("expected a NAME, or --none")
    with user_errors(), remote(server) as service:
        now = service.use_context(name, reason=reason)["context"]
    click.echo("no default: what is certified" if now is None else f"default: {now['name']}  {now['id']}")


COMMANDS = (context,)
