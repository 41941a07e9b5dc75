"""The ``heliopsf`` command: which commands there are, and in which file each is."""

from __future__ import annotations

import click

from service.cli.lazy import Lazy, LazyGroup

SECTIONS = {
    "Images": {
        "deconvolve": Lazy("service.cli.deconvolve", "deconvolve", "Deconvolve one image."),
        "changes": Lazy("service.cli.changes", "changes", "Deconvolve several images and show what changed."),
    },
    "PSFs": {
        "psf": Lazy("service.cli.psf.group", "psf", "Build, fit, inspect, certify and list PSFs."),
        "context": Lazy("service.cli.context", "context", "Pin sets of PSFs that never change."),
    },
    "Transits": {
        "report": Lazy("service.cli.report", "report", "Fit a PSF to a transit, or test one on it."),
        "gap": Lazy("service.cli.gap.diagnose", "gap", "Find out why a fitted PSF and a transit differ."),
        "simulate": Lazy("service.cli.simulate", "simulate", "Simulate transits whose PSF is known."),
    },
    "Archives": {
        "bulk": Lazy("service.cli.bulk", "bulk", "Deconvolve many images on a service."),
    },
    "Service and operation": {
        "serve": Lazy("service.cli.serve", "serve", "Start a service."),
        "worker": Lazy("service.cli.serve", "worker", "Start a worker for a service with a broker."),
        "demo": Lazy("service.cli.demo", "demo", "Try everything once, with a service of its own."),
        "doctor": Lazy("service.cli.operator.doctor", "doctor", "Check settings, database, broker and disk."),
        "database": Lazy("service.cli.operator.database", "database", "Show or upgrade the database's tables."),
        "store": Lazy("service.cli.operator.store", "store", "Clean up stored files; set quotas."),
        "key": Lazy("service.cli.operator.key", "key", "Create, list and revoke access keys."),
    },
    "Studies": {
        "arms": Lazy("service.cli.diffraction", "arms", "Measure the diffraction arms around a flare."),
        "flare": Lazy("service.cli.flare", "flare", "Test a PSF on the stray light of a flare."),
        "fresnel": Lazy("service.cli.diffraction", "fresnel", "Compare the diffraction with Fresnel propagation."),
        "design": Lazy("service.cli.diffraction", "design", "Tabulate diffraction by mesh pitch and wire width."),
    },
}  # fmt: skip
RENAMED = {
    "evaluate": "report",
    "effects": "changes",
    "--preview": "--plot",
    "--effects": "--changes",
    "--html": "--output",
}


@click.group(
    cls=LazyGroup,
    sections=SECTIONS,
    renamed=RENAMED,
    context_settings={"help_option_names": ["-h", "--help"]},
)
@click.version_option(package_name="heliopsf", prog_name="heliopsf")
def main() -> None:
    """Determine the point-spread functions (PSFs) of solar EUV telescopes, and deconvolve images.

    Most commands send a request to a service (--server; start one with `heliopsf serve`).
    With --local they run in this process and need no service. Help on one: heliopsf COMMAND -h
    """
