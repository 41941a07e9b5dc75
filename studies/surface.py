"""Record the public surface of the product, and compare it with a stored record.

    python -m studies.surface -o RECORD.json
    python -m studies.surface --compare RECORD.json

The record contains the OpenAPI document, the HTTP status of every error code, the help of every command, the page of
the settings, and small results that are made in this process: the bytes of a PSF and of a product, their ids, a report
on a transit, and a gap report of schema gap/3. Values that differ between two runs of one version (job ids) or between
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
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import click
from astropy.io import fits
from click.testing import CliRunner

from psfcore.files import sha256_of
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

Record = dict[str, Any]


def record() -> Record:
    """The surface: its parts by name. A part is a text, or a value of JSON."""
    return {
        "openapi": json.loads(description()),
        "status of error codes": STATUS_OF,
        "settings": settings_table(),
        "help": dict(help_of(heliopsf, "heliopsf", None)),
        **results(),
        "gap report": gap_report(found()),
    }


def help_of(command: click.Command, name: str, parent: click.Context | None) -> Iterator[tuple[str, str]]:
    """The help of a command and of all its subcommands, by the words of the command."""
    context = click.Context(command, parent, name, terminal_width=HELP_COLUMNS)
    yield context.command_path, command.get_help(context)
    if isinstance(command, click.Group):
        for word in command.list_commands(context):
            subcommand = command.get_command(context, word)
            assert subcommand is not None
            yield from help_of(subcommand, word, context)


def results() -> Record:
    """The results of three commands in an empty folder: `psf build`, `deconvolve` and `report`."""
    with TemporaryDirectory() as folder, chdir(folder):
        os.environ["HELIOPSF_CACHE_DIR"] = folder  # PSFs of the user's cache are not read
        Path("small.toml").write_text(SMALL_INSTRUMENT, "utf-8")
        write_image(
            Path("image.fits"), CDELT1=2.0, CDELT2=2.0, CUNIT1="arcsec", CUNIT2="arcsec", WAVELNTH=171
        )
        run("psf build --instrument small.toml --size 128 -o psf.fits")
        run("deconvolve image.fits --psf psf.fits -o product.fits --errors 2 --noise 6 2")
        write_simulated(Path("transit"))
        kernel = crop_or_pad(total_kernel(TRUTH, diffraction(), REACH_GRID_PX), TRANSIT_PSF_PX)
        fits.PrimaryHDU(kernel.astype("f4")).writeto("transit_psf.fits")
        run("report transit --psf transit_psf.fits --json report.json")
        report = json.loads(Path("report.json").read_text("utf-8"))
        for key in VARYING:
            del report["provenance"][key]
        header = fits.getheader("product.fits")
        return {
            "SHA-256 of the PSF": sha256_of(Path("psf.fits")),
            "SHA-256 of the product": sha256_of(Path("product.fits")),
            "cards of the product": repr(header),
            "ids": {"image": header["INPSHA"], "PSF": header["PSFID"], "product": header["PRODID"]},
            "transit report": report,
        }


def run(command: str) -> None:
    """Run a command of heliopsf in this process. Exits with the output of the command if the command fails."""
    done = CliRunner().invoke(heliopsf, [*command.split(), "--local"])
    if done.exit_code:
        sys.exit(f"heliopsf {command}: {done.output}")


def lines_of(record: Record) -> list[str]:
    """The record as lines of text. JSON shows line ends of a text as \\n; the lines of the text are shown."""
    text = json.dumps(record, indent=1, sort_keys=True, ensure_ascii=False)
    return text.replace("\\n", "\n").splitlines()


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    action = parser.add_mutually_exclusive_group(required=True)
    action.add_argument("-o", "--output", type=Path, metavar="FILE", help="write the record to this file")
    action.add_argument("--compare", type=Path, metavar="FILE", help="compare with the record in this file")
    chosen = parser.parse_args()
    if chosen.output:
        chosen.output.write_text(json.dumps(record(), indent=1, sort_keys=True) + "\n", "utf-8")
        return
    texts = (lines_of(json.loads(chosen.compare.read_text("utf-8"))), lines_of(record()))
    changed = list(unified_diff(*texts, "before", "now", lineterm="", n=1))
    print("\n".join(changed) or "no difference")
    sys.exit(bool(changed))


if __name__ == "__main__":
    main()
