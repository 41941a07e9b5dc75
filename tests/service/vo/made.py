"""A product with its image, PSF and job, written straight into catalogue and store: no test here is about pixels."""

from __future__ import annotations

import time
from pathlib import Path
from typing import Any

import numpy as np
from astropy.io import fits
from fastapi.testclient import TestClient
from sqlalchemy import insert

from tests.conftest import write_image, write_psf
from tests.service.conftest import execute, upload
from workers.catalogue.tables import JobRow, ProductRow
from workers.contract.jobs import Phase

SHAPE = (96, 128)
# Helioprojective coordinates with different scales and a rotation, so that a swap of axes or signs is noticed.
WCS_CARDS: dict[str, Any] = {
    **{"CTYPE1": "HPLN-TAN", "CTYPE2": "HPLT-TAN", "CUNIT1": "arcsec", "CUNIT2": "arcsec"},
    **{"CDELT1": 0.5, "CDELT2": 0.5, "CRPIX1": 40.0, "CRPIX2": 60.0, "CRVAL1": 100.0, "CRVAL2": -50.0},
    **{"PC1_1": 0.8, "PC1_2": -0.6, "PC2_1": 0.6, "PC2_2": 0.8},
}
OBSERVED: dict[str, Any] = {
    **{"TELESCOP": "SOLO", "INSTRUME": "EUI", "DETECTOR": "HRI_EUV", "WAVELNTH": 174},
    "DATE-BEG": "2022-03-17T04:02:00.000",
}
STARTED_AT, ENDED_AT = 1_700_000_000.0, 1_700_000_060.5


def pixels() -> np.ndarray:
    """The pixels of the product: each has its own value, so that a cut-out shows from where it comes."""
    return np.arange(SHAPE[0] * SHAPE[1], dtype="f4").reshape(SHAPE)


def write_product(path: Path, *, wcs: bool = True) -> None:
    """Write a product with the planes QUALITY and ERROR."""
    cards = {**OBSERVED, **(WCS_CARDS if wcs else {}), "PXBEG1": 1, "PXEND1": SHAPE[1]}
    image = fits.PrimaryHDU(pixels(), fits.Header(cards))
    places = fits.Header({"PLANE": True, **(WCS_CARDS if wcs else {})})
    quality = fits.ImageHDU((pixels() % 7).astype("u1"), places, name="QUALITY")
    error = fits.ImageHDU(pixels() / 2, places, name="ERROR")
    fits.HDUList([image, quality, error]).writeto(path, checksum=True)


def add_product(
    api: TestClient, folder: Path, *, owner: str = "local", wcs: bool = True, number: int = 1, **details: Any
) -> dict[str, str]:
    """Add an image, a PSF, a completed job and its product; returns their ids: "image", "psf", "job", "product"."""
    state = api.app.state.heliopsf
    write_image(folder / f"image-{number}.fits", seed=number, **OBSERVED, **(WCS_CARDS if wcs else {}))
    image = upload(api, folder / f"image-{number}.fits")
    if not (folder / "psf.fits").exists():
        write_psf(folder / "psf.fits")
    psf = upload(api, folder / "psf.fits", "/v1/psfs")
    write_product(folder / f"product-{number}.fits", wcs=wcs)
    size = (folder / f"product-{number}.fits").stat().st_size
    digest = state.store.keep(folder / f"product-{number}.fits")
    (folder / "preview.png").write_bytes(b"\x89PNG\r\n\x1a\n")
    preview = state.store.keep(folder / "preview.png")
    product, job = f"{number:064x}", f"{number:032x}"
    parameters = {"image_id": image, "psf_id": psf, "method": {"name": "linear", "steps": 2}}
    known = {
        "filename": f"product-{number}.fits",
        "method": {"name": "linear"},
        "job_id": job,
        "algorithm_version": 1,
        "software_version": "0.1.0",
        "libraries": {"numpy": "2.4.6", "astropy": "8.0.2"},
        "parameters": parameters,
        "changes": {"artefacts": {"score": 0.25}},
        "thumbnail_sha256": preview,
    }
    files = {"file_sha256": digest, "preview_sha256": preview, "bytes": size}
    made = {"image_id": image, "psf_id": psf, "psf_version": "1.0.0", "kind": "deconvolved-image"}
    state.catalogue.add(
        ProductRow(
            owner=owner, id=product, created_at=time.time(), **made, **files, details={**known, **details}
        )
    )
    keys = {"request_key": product, "work_key": product, "queue": "interactive"}
    times = {"created_at": STARTED_AT - 1, "started_at": STARTED_AT, "ended_at": ENDED_AT}
    done = {"phase": Phase.COMPLETED, "result_id": product}
    row = {"id": job, "owner": owner, "kind": "deconvolve", "parameters": parameters, **keys, **times, **done}
    execute(state.catalogue, insert(JobRow).values(row))
    return {"image": image, "psf": psf, "job": job, "product": product}
