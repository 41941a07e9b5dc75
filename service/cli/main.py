"""The ``heliopsf`` command: lists all commands, and the file of each command."""

from __future__ import annotations

import click

from service.cli.lazy import Lazy, LazyGroup

SECTIONS = {
    "Images": {
        "deconvolve": Lazy("service.cli.deconvolve", "deconvolve", "Deconvolve images."),
        "changes": Lazy("service.cli.changes", "changes", "Deconvolve images and show what changed."),
        "product": Lazy("service.cli.results.product", "product", "List, download and delete products."),
    },
    "PSFs": {
        "psf": Lazy("service.cli.psf.group", "psf", "Build, fit, inspect, certify and list PSFs."),
        "context": Lazy("service.cli.context", "context", "Pin sets of PSFs that never change."),
    },
    "Transits": {
        "report": Lazy("service.cli.report", "report", "Fit a PSF to a transit, or test a PSF on it."),
        "gap": Lazy("service.cli.gap.diagnose", "gap", "Find why a fitted PSF and a transit differ."),
        "simulate": Lazy("service.cli.simulate", "simulate", "Simulate transits whose PSF is known."),
    },
    "Archives": {
        "bulk": Lazy("service.cli.bulk", "bulk", "Deconvolve many images on a service."),
    },
    "Jobs": {
        "job": Lazy("service.cli.results.job", "job", "List, show, wait for and cancel jobs."),
    },
    "Service and operation": {
        "serve": Lazy("service.cli.serve", "serve", "Start a service."),
        "worker": Lazy("service.cli.serve", "worker", "Start a worker for a service with a broker."),
        "demo": Lazy("service.cli.demo", "demo", "Process one image with a temporary service."),
        "doctor": Lazy("service.cli.operator.doctor", "doctor", "Check settings, database, broker and disk."),
        "database": Lazy("service.cli.operator.database", "database", "Show or upgrade the database's tables."),
        "store": Lazy("service.cli.operator.store", "store", "Check and clean up stored files; set quotas."),
        "cache": Lazy("service.cli.operator.cache", "cache", "List and remove built PSFs that are kept."),
        "key": Lazy("service.cli.operator.key", "key", "Create, list and revoke access keys."),
    },
    "Studies": {
        "arms": Lazy("service.cli.diffraction", "arms", "Measure the diffraction arms around a flare."),
        "flare": Lazy("service.cli.flare", "flare", "Test a PSF on the stray light of a flare."),
        "fresnel": Lazy("service.cli.diffraction", "fresnel", "Test the diffraction by Fresnel propagation."),
        "design": Lazy("service.cli.diffraction", "design", "Tabulate diffraction for mesh designs."),
    },
}  # fmt: skip


@click.group(cls=LazyGroup, sections=SECTIONS, context_settings={"help_option_names": ["-h", "--help"]})
@click.version_option(None, "-V", "--version", package_name="heliopsf", prog_name="heliopsf")
def main() -> None:
    """Determine the point-spread functions (PSFs) of solar EUV telescopes, and deconvolve images.

    Most commands send a request to a service (option --server). `heliopsf serve` starts a service.
    With --local these commands run in this process and need no service. The help of a command says whether it needs a
    service: heliopsf COMMAND -h
    """
