"""``heliopsf key``: access keys for people and programs."""

from __future__ import annotations

import json
import re
import time
from datetime import UTC, datetime
from pathlib import Path

import click
from sqlalchemy import make_url

from service.cli.operator.database import opened_catalogue
from service.cli.options import DATA, read_settings
from workers.catalogue.access import MEANINGS, OWNER, Scope
from workers.catalogue.tables import KeyRow

UNITS_S = {"h": 3600, "d": 86_400, "w": 604_800}
DEFAULT_SCOPES = (Scope.READ, Scope.SUBMIT)


class Duration(click.ParamType):
    """A duration in seconds, written as 12h, 30d or 8w."""

    name = "duration"

    def convert(self, value: object, param: click.Parameter | None, ctx: click.Context | None) -> float:
        """Convert a text such as 30d to seconds."""
        parts = re.fullmatch(r"([0-9]{1,5})([hdw])", str(value))
        if parts is None or not int(parts[1]):
            self.fail(f"expected a duration such as 12h, 30d or 8w; got {value!r}", param, ctx)
        return int(parts[1]) * UNITS_S[parts[2]]


@click.group(short_help="Create, list and revoke access keys.")
def key() -> None:
    """Create, list and revoke access keys for people and programs."""


@key.command(
    "create",
    short_help="Create a key and print it once.",
    epilog="Scopes: " + "; ".join(f"{name}: {text}" for name, text in MEANINGS.items()),
)
@click.option(
    "--owner",
    required=True,
    help="Owner of all data that is made with this key; an owner may have several keys",
)
@click.option(
    "--scope",
    "scopes",
    multiple=True,
    type=click.Choice([scope.value for scope in Scope]),
    help=f"Scope of the key; can be repeated [default: {', '.join(DEFAULT_SCOPES)}]",
)
@click.option("--expires", type=Duration(), metavar="30d", help="Lifetime [default: until it is revoked]")
@click.option("--label", default="", help="Note that `key list` shows, for example the purpose of the key")
@DATA
def create(owner: str, scopes: tuple[str, ...], expires: float | None, label: str, data: Path | None) -> None:
    """Create a key and print it once. Only its hash is stored, so it cannot be shown again."""
    if not OWNER.fullmatch(owner):
        raise click.BadParameter(
            "expected lower-case letters, digits, '.', '_' and '-', at most 64", param_hint="--owner"
        )
    wanted = {Scope(scope) for scope in scopes} or set(DEFAULT_SCOPES)
    expires_at = None if expires is None else time.time() + expires
    url = make_url(read_settings(data).catalogue_url).render_as_string(hide_password=True)
    with opened_catalogue(data) as catalogue:
        catalogue.upgrade()
        made = catalogue.keys.make(owner, wanted, label=label, expires_at=expires_at)
    click.echo(made)
    ends = "until it is revoked" if expires_at is None else f"until {_day(expires_at)}"
    click.echo(
        f"for {owner}: {', '.join(sorted(wanted))}; {ends}. The key cannot be shown again. Clients read it from "
        f"HELIOPSF_KEY. Servers that use the database {url} accept it.",
        err=True,
    )


@key.command("list", short_help="List all keys.")
@click.option("--json", "as_json", is_flag=True, help="Print as JSON")
@DATA
def list_keys(as_json: bool, data: Path | None) -> None:
    """List all keys, oldest first, including expired and revoked keys.

    The list shows the ids, not the secret keys.
    """
    with opened_catalogue(data) as catalogue:
        rows = catalogue.keys.all()
    if as_json:
        click.echo(json.dumps([_described(row) for row in rows], indent=1))
        return
    if not rows:
        click.echo("no key yet; `heliopsf key create --owner NAME` makes a key")
    for row in rows:
        used = "never used" if row.last_used_at is None else f"used {_day(row.last_used_at)}"
        click.echo(
            f"{row.id}  {row.owner:<16}  {_state(row):<8}  {','.join(row.scopes):<24}  "
            f"made {_day(row.created_at)}, {used}  {row.label}".rstrip()
        )


@key.command("revoke", short_help="Revoke a key.")
@click.argument("identity", metavar="ID")
@DATA
def revoke(identity: str, data: Path | None) -> None:
    """Revoke the key with this id: further requests with it are refused. Jobs that were submitted with it continue."""
    # The whole key is also accepted instead of its id.
    identity = identity.removeprefix("hpsf_").partition("_")[0]
    with opened_catalogue(data) as catalogue:
        if not catalogue.keys.revoke(identity):
            raise click.ClickException(
                f"there is no key {identity[:16]!r}; `heliopsf key list` shows all keys"
            )
    click.echo(f"{identity} is revoked")


def _state(row: KeyRow) -> str:
    if row.revoked_at is not None:
        return "revoked"
    return "expired" if row.expires_at is not None and row.expires_at <= time.time() else "good"


def _described(row: KeyRow) -> dict[str, object]:
    """A key as JSON, without its hash."""
    shown = ("id", "owner", "scopes", "label", "created_at", "expires_at", "revoked_at", "last_used_at")
    return {name: getattr(row, name) for name in shown} | {"state": _state(row)}


def _day(seconds: float) -> str:
    return datetime.fromtimestamp(seconds, UTC).strftime("%Y-%m-%d %H:%MZ")


COMMANDS = (key,)
