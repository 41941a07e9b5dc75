"""Where a command sends its request, and the options and ids that commands share."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from functools import wraps
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, TypeVar, cast

import click
from click.shell_completion import CompletionItem

from psfcore.errors import DataError, did_you_mean
from psfcore.instruments.files import instrument_names
from psfcore.instruments.published import PUBLISHED
from psfcore.published_psfs import PUBLISHED_OF_IMAGE, kept_file, published_of
from service.cli.options import LOCAL, Command, is_local, kept, options_of
from service.cli.progress import echo, say
from service.client.errors import DEFAULT_SERVER, SHOWN_DIGITS
from service.client.operations import Operations
from workers.contract.requests import FEWEST_DIGITS, Deconvolve
from workers.machine import published_folder

if TYPE_CHECKING:
    from service.client.answers import Uploaded
    from service.client.http import Client

_KEY = "heliopsf.key"
CHOSEN_SERVER = "heliopsf.server"  # where the context of a command has the address
DIGITS = 64  # number of digits of a whole id, except ids of jobs and bulk runs
_ID = re.compile(rf"[0-9a-f]{{{FEWEST_DIGITS},{DIGITS}}}")
_DIGITS = f"{FEWEST_DIGITS} or more hexadecimal digits"
Thing = TypeVar("Thing")


class _Id(click.ParamType):
    """The type of an option or argument for an id, or the first digits of an id.

    Parameters
    ----------
    or_file
        Whether the name of a file with a PSF is accepted too.
    or_instrument
        Whether an instrument, whose PSF is built, is accepted too (its name, or its file in TOML), or the name of a
        published PSF.
    """

    name = "id"

    def __init__(self, *, or_file: bool = False, or_instrument: bool = False) -> None:
        self.or_file, self.or_instrument = or_file, or_instrument

    def convert(self, value: object, param: click.Parameter | None, ctx: click.Context | None) -> str:
        """The digits in lower case, or the name of the file. Other texts never become part of an address of the
        service.
        """
        text = str(value)
        if self.or_file and Path(text).is_file():
            return text
        if _ID.fullmatch(text.lower()):
            return text.lower()
        names = [PUBLISHED_OF_IMAGE, *instrument_names(), *PUBLISHED] if self.or_instrument else []
        if text in names:
            return text
        expected = f"a PSF id ({_DIGITS}) or a file" if self.or_file else f"an id, or its first {_DIGITS}"
        if self.or_instrument:
            expected = f"a file, the name of an instrument or of a published PSF, or a PSF id ({_DIGITS})"
        self.fail(f"expected {expected}; got {value!r}{did_you_mean(text, names)}", param, ctx)

    def shell_complete(
        self, ctx: click.Context, param: click.Parameter, incomplete: str
    ) -> list[CompletionItem]:
        """Let the shell complete the name of a file."""
        return [CompletionItem(incomplete, type="file")] if self.or_file else []


def server_option(what: str, *, or_local: bool = False) -> Callable[[Command], Command]:
    """The options ``--server`` and ``--key`` of a command that can send a request to a service.

    The command does not get their values: `connection`, `remote` and `is_local` find them in the context.

    Parameters
    ----------
    what
        The help text of ``--server``, without the default.
    or_local
        Whether the command also has the option ``--local``.
    """
    key = kept(_KEY)(
        "--key",
        envvar="HELIOPSF_KEY",
        help="Access key. Other users can read command lines, so set HELIOPSF_KEY instead",
    )
    server = kept(CHOSEN_SERVER)(
        "--server",
        metavar="ADDRESS",
        envvar="HELIOPSF_SERVER",
        help=f"{what} [default: {DEFAULT_SERVER}]{'; --local needs none' if or_local else ''}",
    )
    local = kept(LOCAL)("--local", is_flag=True, help="Run in this process, without a service")
    return lambda command: server(key(local(command) if or_local else command))


def psf_option(
    what: str, *, required: bool = False, or_instrument: bool = False
) -> Callable[[Command], Command]:
    """The option ``--psf``. Its help text ``what`` says what the command does with the PSF, and which PSF is the
    default.
    """
    kind = _Id(or_file=True, or_instrument=or_instrument)
    metavar = "ID|FILE|NAME" if or_instrument else "ID|FILE"
    return click.option("--psf", type=kind, metavar=metavar, required=required, help=what)


ID, ID_OR_FILE = _Id(), _Id(or_file=True)
_ADDRESS = "Address of the service, which this command needs"
SERVER, SERVER_OR_LOCAL = server_option(_ADDRESS), server_option(_ADDRESS, or_local=True)
SERVER_FOR_IDS = server_option("Address of the service, which is needed only if a PSF is given by its id")
PSF = psf_option(
    "PSF: an id or a file; an instrument (aia_171, FILE.toml); or a published PSF (aia_171_2025; published: that "
    "of the first image) [default: the certified PSF for the image, else the one built]",
    or_instrument=True,
)
CONTEXT = options_of(Deconvolve, "context")


def id_argument(name: str = "identity", *, several: bool = False) -> Callable[[Command], Command]:
    """The argument for the id of a PSF, product, job, ... The first digits of the id are enough."""
    return click.argument(
        name, type=ID, metavar="ID..." if several else "ID", nargs=-1 if several else 1, required=True
    )


def short(identity: str) -> str:
    """The first digits of an id, as in lists. Every command accepts such a shortened id."""
    return identity[:SHOWN_DIGITS]


def remote() -> Client:
    """A client of the service that ``--server`` or HELIOPSF_SERVER names, with the key of ``--key`` or HELIOPSF_KEY, if
    one is given.
    """
    from service.client.http import Client

    options = click.get_current_context().meta
    return Client(options.get(CHOSEN_SERVER), key=options.get(_KEY), say=say)


def on_service(command: Command) -> Command:
    """Give a command the options ``--server`` and ``--key``, and the client of the service as the argument
    ``service``.
    """

    @SERVER
    @wraps(command)
    def connected(**given: object) -> object:
        with remote() as service:
            return command(service=service, **given)

    return connected  # type: ignore[return-value]  # wraps keeps the signature


def print_rows(rows: Iterable[Thing], line: Callable[[Thing], str], *, if_none: str) -> None:
    """Print a line for each row of a list, or the text ``if_none`` if there are no rows."""
    lines = [line(row).rstrip() for row in rows]
    echo("\n".join(lines or [if_none]))


@contextmanager
def connection(*, gap_effects: str = "") -> Iterator[Operations]:
    """A service over HTTP, or with ``--local`` this process.

    Parameters
    ----------
    gap_effects
        Files and modules that add effects to the gap library in a diagnosis with ``--local``.
    """
    if not is_local():
        with remote() as service:
            service.health()
            yield service
        return
    from service.cli import local as in_this_process

    with in_this_process.local(gap_effects=gap_effects) as here:
        yield here


def is_psf_id(psf: str) -> bool:
    """Whether a text that ``ID_OR_FILE`` accepted is an id. Otherwise it is the name of a file."""
    return not Path(psf).is_file()


def whole_id(service: Operations, things: str, identity: str) -> str:
    """Find the whole id of a PSF, product, job, ... from the first digits of the id.

    Parameters
    ----------
    things
        The type as it is written in the address, for example "psfs".
    identity
        The whole id, or its first digits.
    """
    if len(identity) == DIGITS:
        return identity
    return str(service.get(f"/v1/{things}/{identity}")["id"])


@contextmanager
def psf_file(psf: str) -> Iterator[Path]:
    """The file of the PSF that the user named. If the user named an id, the file is downloaded to a temporary
    folder.
    """
    if not is_psf_id(psf):
        yield Path(psf)
        return
    with TemporaryDirectory(prefix="heliopsf-") as folder, remote() as service:
        file = Path(folder) / "psf.fits"
        service.download(f"/v1/psfs/{psf}/file", file)
        yield file


def named_psf(service: Operations, psf: str | None, *, image: Path | None = None) -> str | None:
    """The id of the PSF that the user named with ``--psf``; None if the user named none.

    A file is uploaded first, the PSF of an instrument is built, and a published PSF is uploaded if the service has none
    of this name.

    Parameters
    ----------
    psf
        The value of ``--psf``; None: the option was not given.
    image
        The first image of the command: "published" means the published PSF of this image. None: the command has no
        image.
    """
    if psf is None:
        return None
    if psf == PUBLISHED_OF_IMAGE and is_psf_id(psf):
        assert image is not None  # the option of commands without images does not accept this name
        from psfcore.fits.blocks import LIMITS
        from psfcore.fits.header import read_summary

        psf = published_of(read_summary(image, LIMITS).cards).name
    if psf.endswith(".toml") or (psf in instrument_names() and is_psf_id(psf)):
        return service.psf_of_instrument(psf)
    if psf in PUBLISHED and is_psf_id(psf):
        # A service may have the PSF, so that it need not be sent.
        there = None if service.server is None else service.get(f"/v1/psfs?name={psf}&limit=1")["items"]
        known = cast("list[Uploaded] | None", there)
        return (known[0] if known else service.upload_psf(kept_file(published_folder(), psf)))["id"]
    if is_psf_id(psf) and service.server is None:
        raise DataError(
            "no-such-psf",
            f"expected a file or the name of a PSF, because this command asks no service; got the id {short(psf)}: "
            f"download the PSF first (`heliopsf psf download {short(psf)} -o FILE`)",
        )
    if is_psf_id(psf):
        return whole_id(service, "psfs", psf)
    return service.upload_psf(psf)["id"]
