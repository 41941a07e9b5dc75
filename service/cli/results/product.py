"""``heliopsf product``: list, download and delete deconvolved images of a service."""

from __future__ import annotations

from itertools import islice
from pathlib import Path

import click

from service.cli.connection import ID, SERVER, id_argument, remote, short, whole_id
from service.cli.options import OUTPUT, OUTPUT_PLACE, PLOT, Place, user_errors, writes_files
from service.cli.results.job import MOST, moment


@click.group(short_help="List, download and delete products.")
def product() -> None:
    """List, download and delete products: deconvolved images that a service keeps."""


@product.command("list", short_help="List your products.")
@click.option("--image", "image_id", type=ID, metavar="ID", help="Only products of this uploaded image")
@click.option("--psf", "psf_id", type=ID, metavar="ID", help="Only products made with this PSF")
@MOST
@SERVER
def list_products(image_id: str | None, psf_id: str | None, most: int, server: str | None) -> None:
    """List your products, newest first."""
    with user_errors(), remote(server) as service:
        given = {"image_id": ("images", image_id), "psf_id": ("psfs", psf_id)}
        filters = {
            name: whole_id(service, things, identity)
            for name, (things, identity) in given.items()
            if identity is not None
        }
        rows = list(islice(service.products(**filters), most))
    if not rows:
        click.echo("no such product" if filters else "no product yet; `heliopsf deconvolve` makes a product")
    for row in rows:
        click.echo(
            f"{short(row['id'])}  {moment(row['created_at'])}  image {short(row['image_id'])}  PSF {short(row['psf_id'])} "
            f"{row['psf_version']}  {row['details']['method']['name']}"
        )


@product.command("get", short_help="Download a product.")
@id_argument()
@click.option("-o", "--output", type=OUTPUT_PLACE, metavar="FILE|FOLDER/",
              help="Write the product (FITS) to this file, or into this folder")  # fmt: skip
@PLOT
@click.option(
    "--changes", type=OUTPUT, help="Write difference, ratio and histograms (PNG), if the job drew them"
)
@SERVER
@writes_files
def get(
    identity: str,
    output: Place | None,
    plot: Path | None,
    changes: Path | None,
    server: str | None,
    overwrite: bool,
) -> None:
    """Download a product and its pictures. Name at least one output."""
    if output is None and plot is None and changes is None:
        raise click.UsageError("expected an output: -o FILE, --plot FILE or --changes FILE; got none of them")
    with user_errors(), remote(server) as service:
        found = service.product(identity)
        file = None if output is None else output.file(found["details"]["filename"])
        parts = {"file": file, "preview": plot, "changes": changes}
        wanted = {part: path for part, path in parts.items() if path is not None}
        for part, path in wanted.items():
            service.download(f"/v1/products/{found['id']}/{part}", path, overwrite=overwrite)
    written = ", ".join(str(path) for path in wanted.values())
    click.echo(f"{written}: product {short(found['id'])}, PSF {found['psf_version']}")


@product.command("delete", short_help="Delete products.")
@id_argument("identities", several=True)
@SERVER
def delete(identities: tuple[str, ...], server: str | None) -> None:
    """Delete products from the service, so that they no longer count in your quota. The same request makes them again."""
    with user_errors(), remote(server) as service:
        for identity in identities:
            whole = whole_id(service, "products", identity)
            service.delete_product(whole)
            click.echo(f"product {short(whole)} is deleted")


COMMANDS = (product,)
