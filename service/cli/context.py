"""``heliopsf context``: sets of PSFs that never change."""

from __future__ import annotations

import click

from service.cli.connection import ID, SERVER, remote, short, whole_ids
from service.cli.options import user_errors


@click.group(short_help="Pin sets of PSFs that never change.")
def context() -> None:
    """Pin sets of PSFs that never change, so that years of work use the same PSFs."""


@context.command("create", short_help="Create a context from certified PSFs.")
@click.argument("name")
@click.option(
    "--psf",
    "psf_ids",
    multiple=True,
    type=ID,
    metavar="ID",
    help="Id of a PSF to pin; can be repeated [default: all certified PSFs]",
)
@click.option("--reason", default="", help="Reason, kept in the history")
@SERVER
def create(name: str, psf_ids: tuple[str, ...], reason: str, server: str | None) -> None:
    """Create a context NAME that pins all PSFs that are certified now, or the PSFs that you name."""
    with user_errors(), remote(server) as service:
        pins = [{"psf_id": psf_id} for psf_id in whole_ids(service, "psfs", psf_ids)] or None
        made = service.create_context(name, pins, reason=reason)
    click.echo(f"{short(made['id'])}  {made['name']}  {made['size']} pinned")


@context.command("list", short_help="List contexts.")
@SERVER
def list_contexts(server: str | None) -> None:
    """List contexts. A * marks the default context."""
    with user_errors(), remote(server) as service:
        default = service.default_context()["context"]
        rows = list(service.contexts())
    if not rows:
        click.echo("no context yet; `heliopsf context create NAME` pins the certified PSFs")
    for row in rows:
        sign = "*" if default is not None and default["id"] == row["id"] else " "
        click.echo(
            f"{sign} {short(row['id'])}  {row['name']}  {row['size']} pinned  {row['reason']}".rstrip()
        )


@context.command("show", short_help="List the PSFs of a context.")
@click.argument("name")
@SERVER
def show(name: str, server: str | None) -> None:
    """List the PSFs that the context NAME (or id) pins."""
    with user_errors(), remote(server) as service:
        found = service.context(name)
    click.echo(f"{short(found['id'])}  {found['name']}")
    for pin in found["pins"]:
        times = f"[{pin['valid_from'] or 'always'}, {pin['valid_to'] or 'open'})"
        may = "  may be interpolated" if pin["interpolated"] else ""
        click.echo(f"  {pin['series']}  {times}  {pin['version']}  {short(pin['psf_id'])}{may}")


@context.command("use", short_help="Set the default context.")
@click.argument("name", required=False)
@click.option(
    "--none",
    "no_context",
    is_flag=True,
    help="Set no default: use the PSFs that are certified at the time of a request",
)
@click.option("--reason", default="", help="Reason, kept in the history")
@SERVER
def use(name: str | None, no_context: bool, reason: str, server: str | None) -> None:
    """Make the context NAME (or id) the default: the PSF is chosen from it if a request names no context."""
    if (name is None) != no_context:
        raise click.UsageError("expected either NAME or --none")
    with user_errors(), remote(server) as service:
        now = service.use_context(name, reason=reason)["context"]
    click.echo(
        "no default context: the certified PSFs are used"
        if now is None
        else f"default: {now['name']}  {short(now['id'])}"
    )


COMMANDS = (context,)
