"""The command ``convolve``, which shows what a telescope would record of a model image."""

from __future__ import annotations

from pathlib import Path
from typing import get_args

import click

from psfcore.deconvolve.declaration import KnownScene
from service.cli.connection import PSF, named_psf
from service.cli.options import DRAWN, FILE, OUTPUT, OVERWRITE, options_of
from service.cli.progress import echo, progress_bar
from service.client.outputs import check_outputs, written
from workers.contract.requests import Deconvolve


@click.command()
@click.argument("image", type=FILE)
@click.option("-o", "--output", required=True, type=OUTPUT, help="File of the convolved image (FITS)")
@PSF
@click.option(
    "--edges",
    type=click.Choice(get_args(KnownScene)),
    default="zero",
    help="The scene beyond the image: dark, or the mirror image",
)
@options_of(Deconvolve, "hdu", "plate_scale_arcsec", "other_channel")
@click.option("--plot", type=DRAWN, help="Write the image before and after (PNG)")
@OVERWRITE
def convolve(
    image: Path,
    output: Path,
    psf: str | None,
    edges: KnownScene,
    plot: Path | None,
    overwrite: bool,
    **parameters: object,
) -> None:
    """Convolve IMAGE (FITS), a model of the Sun, with a PSF: what the telescope would record.

    The PSF is brought onto the pixels of the image. The command runs in this process.
    """
    from psfcore.deconvolve.forward import lines, write
    from service.cli.local import local

    psf_files = [Path(psf)] if psf and Path(psf).is_file() else []
    check_outputs((output, plot), inputs=[image, *psf_files], overwrite=overwrite)
    with local() as here, progress_bar() as report:
        parameters |= {"psf_id": named_psf(here, psf, image=image)}
        found, used = here.convolve(str(here.upload_image(image)["id"]), edges, report, **parameters)
        with written(output, overwrite=overwrite) as file:
            write(found, file, used)
        if plot is not None:
            from psfcore.drawing.plots import preview_png
            from psfcore.fits.units import unit_label

            title, unit = found.title(used), unit_label(found.image)
            with written(plot, overwrite=overwrite) as file:
                preview_png(found.image.pixels, found.pixels, file, title=title, unit=unit)
    for message in found.warnings.values():
        echo(f"warning: {message}", err=True)
    first, *others = lines(found, used)
    echo("\n".join([f"{output}: {first}", *others]))
