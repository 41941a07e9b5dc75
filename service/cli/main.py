"""The commands ``heliopsf`` and ``heliopsf psf``: they list all commands, and the file of each command. A command is
imported when it is called, so that ``heliopsf --version`` is fast.
"""

from __future__ import annotations

import os
import re
import sys
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from difflib import get_close_matches
from pathlib import Path
from typing import Any, NamedTuple

import click
from click.shell_completion import CompletionItem

from psfcore.errors import DataError, MissingExtra, missing_extra, module_of_extra
from service.cli.first import first_screen
from service.cli.progress import OutputClosed, echo, printable
from service.client.errors import DEFAULT_SERVER, SHOWN_DIGITS, ServiceError, WaitInterrupted, error_lines

INTERRUPTED = 130  # exit status of a command that was ended by Control-C: 128 + the number of SIGINT
PIPE_CLOSED = 141  # that of a command whose reader ended first: 128 + the number of SIGPIPE
REJOIN = {"job": "heliopsf job wait {id}", "bulk": "heliopsf bulk status {id} --wait"}
NO_KEY = "this service needs a key: set HELIOPSF_KEY to your key (the operator makes keys with `heliopsf key create`)"
# Where the fault of a request is, such as "body/deconvolve/parameters/size: "; a check of several fields may name one.
_PLACE = re.compile(
    r"(?:^|(?<=; ))(?:(?:body/[a-z-]+/)?parameters|body)(?:/(?P<field>[a-z_]+)(?:/[\w-]+)*)?: "
    r"(?:Value error, (?:(?P<own>[a-z]+_[a-z_]+): )?)?"
)
_FETCH = "                      it prints the command that writes the result, such as heliopsf product get ID -o FILE\n"


class Lazy(NamedTuple):
    """A command that is not imported yet: its module, its name in the module, and the line that ``--help`` shows."""

    module: str
    name: str
    summary: str


class LazyGroup(click.Group):
    """Commands under headings. A command's file is imported when the command is called.

    Attributes
    ----------
    sections
        The commands under each heading, by name.
    """

    def __init__(self, *args: Any, sections: Mapping[str, Mapping[str, Lazy]], **options: Any) -> None:
        super().__init__(*args, **options)
        self.sections = sections
        self.rows = {name: row for rows in sections.values() for name, row in rows.items()}

    def list_commands(self, ctx: click.Context) -> list[str]:
        """Names in the order of the headings."""
        return list(self.rows)

    def get_command(self, ctx: click.Context, cmd_name: str) -> click.Command | None:
        """Import a command; None if the group has no command of this name."""
        row = self.rows.get(cmd_name)
        if row is None:
            return None
        command: click.Command = getattr(module_of_extra(row.module), row.name)
        return command

    def shell_complete(self, ctx: click.Context, incomplete: str) -> list[CompletionItem]:
        """The commands for tab completion. click's own version would import all of them."""
        if incomplete.startswith("-"):
            return super().shell_complete(ctx, incomplete)
        return [
            CompletionItem(name, help=row.summary)
            for name, row in self.rows.items()
            if name.startswith(incomplete)
        ]

    def resolve_command(
        self, ctx: click.Context, args: list[str]
    ) -> tuple[str | None, click.Command | None, list[str]]:
        """The command that the arguments call. If there is none, the ``UsageError`` names the command that the user may
        mean.
        """
        name = args[0]
        if name not in self.rows and not name.startswith("-"):
            close = get_close_matches(name, self.rows, n=1)
            hint = f" Did you mean `{close[0]}`?" if close else ""
            ctx.fail(f"there is no command '{name}'.{hint}")
        return super().resolve_command(ctx, args)

    def invoke(self, ctx: click.Context) -> object:
        """Run a command. Control-C ends it with status 130; if its job continues, a message says how to return to the
        job.

        The message of an error may contain texts of a service or a file; it is made printable.
        """
        try:
            with user_errors():
                return super().invoke(ctx)
        except click.ClickException as error:
            error.message = printable(error.message)  # type: ignore[misc]  # click declares it final
            raise
        except KeyboardInterrupt as stop:
            echo(_interrupted(stop), err=True)
            ctx.exit(INTERRUPTED)
        except OutputClosed:
            # Python writes the rest of its buffers when it ends, and would tell that nobody reads them.
            nowhere = os.open(os.devnull, os.O_WRONLY)
            for stream in (sys.stdout, sys.stderr):
                os.dup2(nowhere, stream.fileno())
            ctx.exit(PIPE_CLOSED)

    def format_commands(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        """Write the commands under their headings, without importing them."""
        width = max(map(len, self.rows))
        for heading, rows in self.sections.items():
            with formatter.section(heading):
                formatter.write_dl([(f"{name:<{width}}", row.summary) for name, row in rows.items()])


@contextmanager
def user_errors() -> Iterator[None]:
    """Turn an error of the user's data, files, packages or service into text and an exit status, without a traceback.

    If a package is missing, the text names the extra that installs it.
    """
    try:
        yield
    except DataError as error:  # of this process
        raise click.ClickException("\n".join(error_lines(error.message, error.fields, local=True))) from error
    except ServiceError as error:
        message = NO_KEY if error.code == "no-key" else str(error)
        lines = error_lines(named_by_options(message), error.fields, local=False)
        raise click.ClickException("\n".join(lines)) from error
    except ImportError as error:
        missing = missing_extra(error) if isinstance(error, ModuleNotFoundError) else error
        if not isinstance(missing, MissingExtra):
            raise
        local = "; or add --local, if the command has it" if missing.name == "httpx" else ""
        raise click.ClickException(f"{missing}{local}") from error
    except OSError as error:
        raise click.ClickException(str(error)) from error


def named_by_options(message: str) -> str:
    """The message of a refused request with the options of a command in place of the fields of the request."""
    from service.cli.options import option_name

    def option(found: re.Match[str]) -> str:
        field = found["field"] or found["own"]
        return "" if field is None else f"{option_name(field)}: "

    return _PLACE.sub(option, message)


def _interrupted(stop: KeyboardInterrupt) -> str:
    """What to tell a user who interrupted a command."""
    if not isinstance(stop, WaitInterrupted):
        return "interrupted"
    there = "" if stop.server == DEFAULT_SERVER else f" --server {stop.server}"
    ids = " ".join(one[:SHOWN_DIGITS] for one in (stop.identity, *stop.others))
    several = bool(stop.others)
    rejoin = REJOIN[stop.what].format(id=ids)
    # The command in ``rejoin`` only waits: it does not know which files the interrupted command would have written.
    files = "  write the files:    run the same command again; it continues with the same work\n"
    return (
        f"interrupted; {f'{stop.what}s {ids} go' if several else f'{stop.what} {ids} goes'} on\n"
        f"{files if stop.what == 'job' else ''}"
        f"  wait for {'them' if several else 'it'} again: {rejoin}{there}\n"
        f"{_FETCH if stop.what == 'job' else ''}"
        f"  {'cancel them:       ' if several else 'cancel it:        '} heliopsf {stop.what} cancel {ids}{there}"
    )


SECTIONS = {
    "Images": {
        "deconvolve": Lazy("service.cli.deconvolve", "deconvolve", "Deconvolve images."),
        "changes": Lazy("service.cli.deconvolve", "changes", "Deconvolve images and show what changed."),
        "convolve": Lazy("service.cli.convolve", "convolve", "Convolve a model image with a PSF."),
        "product": Lazy("service.cli.jobs", "product", "List, download and delete products."),
    },
    "PSFs": {
        "psf": Lazy("service.cli.main", "psf", "Build, fit, inspect, certify and list PSFs."),
        "context": Lazy("service.cli.psf.versions", "context", "Pin sets of PSFs that never change."),
    },
    "Transits": {
        "report": Lazy("service.cli.transits", "report", "Fit a PSF to a transit, or test a PSF on it."),
        "gap": Lazy("service.cli.transits", "gap", "Find why a fitted PSF and a transit differ."),
        "simulate": Lazy("service.cli.simulate", "simulate", "Simulate transits whose PSF is known."),
    },
    "Archives": {
        "bulk": Lazy("service.cli.bulk", "bulk", "Deconvolve many images on a service."),
    },
    "Jobs": {
        "job": Lazy("service.cli.jobs", "job", "List, show, wait for and cancel jobs."),
    },
    "Service and operation": {
        "serve": Lazy("service.cli.serve", "serve", "Start a service."),
        "worker": Lazy("service.cli.serve", "worker", "Start a worker for a service with a broker."),
        "demo": Lazy("service.cli.serve", "demo", "Process one image with a temporary service."),
        "doctor": Lazy("service.cli.doctor", "doctor", "Check settings, database, broker and disk."),
        "database": Lazy("service.cli.operator", "database", "Show or upgrade the database's tables."),
        "store": Lazy("service.cli.operator", "store", "Check and clean up stored files; set quotas."),
        "cache": Lazy("service.cli.psf.query", "cache", "List and remove built PSFs that are kept."),
        "key": Lazy("service.cli.operator", "key", "Create, list and revoke access keys."),
    },
    "Studies": {
        "arms": Lazy("service.cli.studies", "arms", "Measure the diffraction arms around a flare."),
        "flare": Lazy("service.cli.studies", "flare", "Test a PSF on the stray light of a flare."),
        "fresnel": Lazy("service.cli.studies", "fresnel", "Test the diffraction by Fresnel propagation."),
        "design": Lazy("service.cli.studies", "design", "Tabulate diffraction for mesh designs."),
    },
}  # fmt: skip
PSF_SECTIONS = {
    "Make": {
        "build": Lazy("service.cli.psf.make", "build", "Compute the PSF of an instrument."),
        "fit": Lazy("service.cli.psf.make", "fit", "Fit the scattered light of a transit."),
        "crossval": Lazy("service.cli.psf.make", "crossval", "Estimate the uncertainty of a fit."),
        "field": Lazy("service.cli.psf.field", "field", "Make a PSF that changes over the field."),
        "instruments": Lazy("service.cli.psf.versions", "instruments", "List instruments that can be built."),
    },
    "Read": {
        "published": Lazy("service.cli.psf.query", "list_published", "List PSFs that others published."),
        "get": Lazy("service.cli.psf.query", "get_psfs", "Bring published PSFs to this machine."),
        "show": Lazy("service.cli.psf.make", "show", "Show what a PSF file contains."),
        "query": Lazy("service.cli.psf.query", "query", "Show the light beyond given radii."),
        "cutout": Lazy("service.cli.psf.query", "cutout", "Write the central part of a PSF."),
        "rebin": Lazy("service.cli.psf.query", "rebin", "Write the PSF for binned images."),
    },
    "Versions on a service": {
        "list": Lazy("service.cli.psf.versions", "list_psfs", "List PSFs."),
        "download": Lazy("service.cli.psf.versions", "download", "Download a PSF."),
        "upload": Lazy("service.cli.psf.versions", "upload_psf", "Upload a PSF."),
        "certify": Lazy("service.cli.psf.versions", "certify", "Certify a PSF for a range of times."),
        "series": Lazy("service.cli.psf.versions", "series", "List series, and allow interpolation in time."),
        "interpolate": Lazy("service.cli.psf.versions", "interpolate", "Interpolate between two PSFs in time."),
        "deprecate": Lazy("service.cli.psf.versions", "deprecate", "Deprecate a certified PSF."),
        "delete": Lazy("service.cli.psf.versions", "delete_psf", "Delete a draft that nothing uses."),
        "best": Lazy("service.cli.psf.versions", "best", "Find the PSF for an image."),
        "lineage": Lazy("service.cli.psf.versions", "lineage", "Show what a PSF or product was made from."),
        "rerun": Lazy("service.cli.psf.versions", "rerun", "Make a PSF or product again and compare."),
    },
}  # fmt: skip


@click.group(
    cls=LazyGroup,
    sections=SECTIONS,
    invoke_without_command=True,
    context_settings={"help_option_names": ["-h", "--help"], "show_default": True},
)
@click.version_option(None, "-V", "--version", package_name="heliopsf", prog_name="heliopsf")
@click.pass_context
def main(ctx: click.Context) -> None:
    """Determine the point-spread functions (PSFs) of solar EUV telescopes, and deconvolve images.

    Most commands need a service (option --server), which `heliopsf serve` starts, or run here with --local:
    heliopsf COMMAND -h
    """
    if ctx.invoked_subcommand is None:
        echo(first_screen(Path.cwd()))


@click.group(cls=LazyGroup, sections=PSF_SECTIONS)
def psf() -> None:
    """Build, fit, inspect, certify and list PSFs."""
