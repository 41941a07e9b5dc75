"""The commands ``heliopsf`` and ``heliopsf psf``: they list all commands, and the file of each command."""

from __future__ import annotations

import click

from service.cli.lazy import Lazy, LazyGroup

SECTIONS = {
    "Images": {
        "deconvolve": Lazy("service.cli.deconvolve", "deconvolve", "Deconvolve images."),
        "changes": Lazy("service.cli.changes", "changes", "Deconvolve images and show what changed."),
        "product": Lazy("service.cli.jobs", "product", "List, download and delete products."),
    },
    "PSFs": {
        "psf": Lazy("service.cli.main", "psf", "Build, fit, inspect, certify and list PSFs."),
        "context": Lazy("service.cli.psf.versions", "context", "Pin sets of PSFs that never change."),
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
        "arms": Lazy("service.cli.diffraction", "arms", "Measure the diffraction arms around a flare."),
        "flare": Lazy("service.cli.flare", "flare", "Test a PSF on the stray light of a flare."),
        "fresnel": Lazy("service.cli.diffraction", "fresnel", "Test the diffraction by Fresnel propagation."),
        "design": Lazy("service.cli.diffraction", "design", "Tabulate diffraction for mesh designs."),
    },
}  # fmt: skip
PSF_SECTIONS = {
    "Make": {
        "build": Lazy("service.cli.psf.make", "build", "Compute the PSF of an instrument."),
        "fit": Lazy("service.cli.psf.make", "fit", "Fit the scattered light of a transit."),
        "crossval": Lazy("service.cli.psf.make", "crossval", "Estimate the uncertainty of a fit."),
        "instruments": Lazy("service.cli.psf.versions", "instruments", "List instruments that can be built."),
    },
    "Read": {
        "published": Lazy("service.cli.psf.published", "list_published", "List PSFs that others published."),
        "get": Lazy("service.cli.psf.published", "get_psfs", "Bring published PSFs to this machine."),
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
    context_settings={"help_option_names": ["-h", "--help"], "show_default": True},
)
@click.version_option(None, "-V", "--version", package_name="heliopsf", prog_name="heliopsf")
def main() -> None:
    """Determine the point-spread functions (PSFs) of solar EUV telescopes, and deconvolve images.

    Most commands need a service (option --server), which `heliopsf serve` starts, or run here with --local:
    heliopsf COMMAND -h
    """


@click.group(cls=LazyGroup, sections=PSF_SECTIONS)
def psf() -> None:
    """Build, fit, inspect, certify and list PSFs."""
