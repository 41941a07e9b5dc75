"""Record the public surface of the product, and compare it with a stored record.

    python -m studies.surface -o RECORD.json
    python -m studies.surface --compare RECORD.json

The record contains the OpenAPI document, the HTTP status of every error code, the help of every command, the page of
the settings, and small results that are made in this process: the bytes of a PSF and of a product, their ids, a report
on a transit, and a gap report of schema gap/2. Values that differ between two runs of one version (job ids) or between
two machines (versions of libraries) are left out. --compare prints every difference, and exits with status 1 if there
is one. Results of two machines can differ in the last digits, so compare records of one machine.
"""

from __future__ import annotations

import argparse
import json
import os
import sys
from collections.abc import Iterator
from contextlib import chdir
from difflib import unified_diff
from hashlib import sha256
from itertools import islice
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import click
from astropy.io import fits
from click.testing import CliRunner

from psfcore.gap.report.report import gap_report
from psfcore.psf import REACH_GRID_PX, crop_or_pad
from psfcore.simulate.scatter_truth import total_kernel
from service.cli.main import main as heliopsf
from service.http.problems import STATUS_OF
from service.openapi import description
from tests.conftest import SMALL_INSTRUMENT, write_image
from tests.psfcore.gap.small_gaps import found
from tests.transit_files import TRUTH, diffraction, write_simulated
from workers.settings_table import settings_table

HELP_COLUMNS = 100
TRANSIT_PSF_PX = 256
VARYING = ("job_id", "software_version", "libraries")  # keys of the provenance of a report
DIFFERENCE_LINES = 60  # of each part of the record; further lines are counted

Record = dict[str, Any]


def record() -> Record:
    """The surface: its parts by name. A part is a text, or a value of JSON."""
    return {
        "openapi": json.loads(description()),
        "status of error codes": STATUS_OF,
        "settings": settings_table(),
        "help": dict(_help(heliopsf, "heliopsf", None)),
        **_results(),
        "gap report": gap_report(found()),
    }


def _help(command: click.Command, name: str, parent: click.Context | None) -> Iterator[tuple[str, str]]:
    """The help of a command and of all its subcommands, by the words of the command."""
    context = click.Context(command, parent, name, terminal_width=HELP_COLUMNS)
    yield context.command_path, command.get_help(context)
    if isinstance(command, click.Group):
        for word in command.list_commands(context):
            subcommand = command.get_command(context, word)
            assert subcommand is not None
            yield from _help(subcommand, word, context)


def _results() -> Record:
    """The results of three commands in an empty folder: `psf build`, `deconvolve` and `report`."""
    with TemporaryDirectory() as folder, chdir(folder):
        return _results_here()


def _results_here() -> Record:
    os.environ["HELIOPSF_CACHE_DIR"] = str(Path("cache").resolve())  # PSFs of the user's cache are not read
    Path("small.toml").write_text(SMALL_INSTRUMENT, "utf-8")
    write_image(Path("image.fits"), CDELT1=2.0, CDELT2=2.0, CUNIT1="arcsec", CUNIT2="arcsec", WAVELNTH=171)
    _run("psf build --instrument small.toml --size 128 -o psf.fits")
    _run("deconvolve image.fits --psf psf.fits -o product.fits --errors 2 --noise 6 2")
    write_simulated(Path("transit"))
    kernel = crop_or_pad(total_kernel(TRUTH, diffraction(), REACH_GRID_PX), TRANSIT_PSF_PX)
    fits.PrimaryHDU(kernel.astype("f4")).writeto("transit_psf.fits")
    _run("report transit --psf transit_psf.fits --json report.json")
    report = json.loads(Path("report.json").read_text("utf-8"))
    for key in VARYING:
        del report["provenance"][key]
    header = fits.getheader("product.fits")
    return {
        "SHA-256 of the PSF": _sha256("psf.fits"),
        "SHA-256 of the product": _sha256("product.fits"),
        "cards of the product": repr(header),
        "ids": {"image": header["INPSHA"], "PSF": header["PSFID"], "product": header["PRODID"]},
        "transit report": report,
    }


def _run(command: str) -> None:
    """Run a command of heliopsf in this process. Exits with the output of the command if the command fails."""
    done = CliRunner().invoke(heliopsf, [*command.split(), "--local"])
    if done.exit_code:
        sys.exit(f"heliopsf {command}: {done.output}")


def _sha256(path: str) -> str:
    return sha256(Path(path).read_bytes()).hexdigest()


def differences(before: Record, now: Record) -> list[str]:
    """The lines that differ between two records, as a unified diff for each part of the record."""
    lines: list[str] = []
    for part in sorted(before.keys() | now.keys()):
        texts = (_lines(before.get(part)), _lines(now.get(part)))
        changed = unified_diff(*texts, f"before: {part}", f"now: {part}", lineterm="", n=1)
        lines += islice(changed, DIFFERENCE_LINES)
        further = sum(1 for _ in changed)
        if further:
            lines.append(f"... and {further} further lines of {part}")
    return lines


def _lines(part: Any) -> list[str]:
    """A part of the record as lines of text. JSON shows line ends of a text as \\n; the lines of the text are shown."""
    return json.dumps(part, indent=1, sort_keys=True, ensure_ascii=False).replace("\\n", "\n").splitlines()


def main() -> None:
    """Run the study from the command line."""
    parser = argparse.ArgumentParser(description="Record or compare the public surface of the product.")
    action = parser.add_mutually_exclusive_group(required=True)
    action.add_argument("-o", "--output", type=Path, metavar="FILE", help="write the record to this file")
    action.add_argument("--compare", type=Path, metavar="FILE", help="compare with the record in this file")
    arguments = parser.parse_args()
    if arguments.output:
        arguments.output.write_text(json.dumps(record(), indent=1, sort_keys=True) + "\n", "utf-8")
        return
    before = json.loads(arguments.compare.read_text("utf-8"))
    changed = differences(before, json.loads(json.dumps(record())))
    print("\n".join(changed) or "no difference")
    sys.exit(bool(changed))


if __name__ == "__main__":
    main()
