"""The group ``heliopsf psf``: lists its commands, and the file of each command."""

from __future__ import annotations

import click

from service.cli.lazy import Lazy, LazyGroup

SECTIONS = {
    "Make": {
        "build": Lazy("service.cli.psf.make", "build", "Compute the PSF of an instrument."),
        "fit": Lazy("service.cli.psf.make", "fit", "Fit the scattered light of a transit."),
        "crossval": Lazy("service.cli.psf.make", "crossval", "Estimate the uncertainty of a fit."),
        "instruments": Lazy("service.cli.psf.files", "instruments", "List instruments that can be built."),
    },
    "Read": {
        "show": Lazy("service.cli.psf.make", "show", "Show what a PSF file contains."),
        "query": Lazy("service.cli.psf.query", "query", "Show the light beyond given radii."),
        "cutout": Lazy("service.cli.psf.query", "cutout", "Write the central part of a PSF."),
        "rebin": Lazy("service.cli.psf.query", "rebin", "Write the PSF for binned images."),
    },
    "Versions on a service": {
        "list": Lazy("service.cli.psf.versions", "list_psfs", "List PSFs."),
        "download": Lazy("service.cli.psf.files", "download", "Download a PSF."),
        "upload": Lazy("service.cli.psf.versions", "upload_psf", "Upload a PSF."),
        "certify": Lazy("service.cli.psf.versions", "certify", "Certify a PSF for a range of times."),
        "series": Lazy(
            "service.cli.psf.interpolation", "series", "List series, and allow interpolation in time."
        ),
        "interpolate": Lazy(
            "service.cli.psf.interpolation", "interpolate", "Interpolate between two PSFs in time."
        ),
        "deprecate": Lazy("service.cli.psf.versions", "deprecate", "Deprecate a certified PSF."),
        "delete": Lazy("service.cli.psf.versions", "delete_psf", "Delete a draft that nothing uses."),
        "best": Lazy("service.cli.psf.versions", "best", "Find the PSF for an image."),
        "lineage": Lazy("service.cli.psf.versions", "lineage", "Show what a PSF or product was made from."),
        "rerun": Lazy("service.cli.psf.versions", "rerun", "Make a PSF or product again and compare."),
    },
}


@click.group(cls=LazyGroup, sections=SECTIONS)
def psf() -> None:
    """Build, fit, inspect, certify and list PSFs."""
