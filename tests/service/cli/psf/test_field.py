"""``heliopsf psf field``, and what other commands and a service do with a PSF that changes over the field."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from astropy.io import fits
from click.testing import CliRunner

from psfcore.fits.psfs import write_psf
from psfcore.psf_field import Place
from service.cli.main import main
from service.client import http
from service.client.errors import ServiceError
from tests.conftest import write_image
from tests.psfcore.conftest import make_psf
from tests.psfcore.test_psf_field import changing

DETECTOR = (48, 40)


def run(*words: object, code: int = 0) -> str:
    done = CliRunner().invoke(main, [str(word) for word in words])
    assert done.exit_code == code, done.output
    return done.output


def files_at_places(folder: Path) -> list[str]:
    truth, place = changing(*DETECTOR), Place.of_detector(*DETECTOR)
    arguments = []
    for n, (x, y) in enumerate([(0, 0), (47, 0), (0, 39), (47, 39), (20, 30)]):
        (u,), (v,) = place.from_pixel(x, y).coordinates((1, 1))
        write_psf(folder / f"{n}.fits", make_psf(truth.at(u, v)))
        arguments.append(f"{folder / f'{n}.fits'}@{x},{y}")
    return arguments


def test_from_places_to_a_product(tmp_path: Path) -> None:
    given, psf = files_at_places(tmp_path), tmp_path / "field.fits"
    told = run("psf", "field", *given, "--detector", *DETECTOR, "-o", psf)
    assert "x^1 y^0, x^0 y^1" in told and "PSFs at 5 places" in told and "residual" in told
    shown = run("psf", "show", psf, "--plot", tmp_path / "nine.png")
    assert "48 x 40 px" in shown and (tmp_path / "nine.png").is_file()
    assert "give --detector" in run("psf", "field", *given, "-o", tmp_path / "o.fits", code=1)
    image, part = tmp_path / "i.fits", tmp_path / "part.fits"
    write_image(image, shape=(40, 48))
    write_image(part, shape=(30, 48))
    product = tmp_path / "product.fits"
    run("deconvolve", image, "--psf", psf, "--local", "--steps", 3, "-o", product)
    one = tmp_path / "one.fits"
    run("deconvolve", image, "--psf", tmp_path / "4.fits", "--local", "--steps", 3, "-o", one)
    assert not np.allclose(fits.getdata(product), fits.getdata(one), rtol=1e-4)
    refused = run("deconvolve", part, "--psf", psf, "--local", "-o", tmp_path / "p.fits", code=1)
    assert "PXBEG2" in refused


def test_a_service_certifies_it_lists_it_and_deconvolves_as_a_command_does(
    command: Callable[..., str], client: http.Client, tmp_path: Path
) -> None:
    psf, image = tmp_path / "field.fits", tmp_path / "i.fits"
    write_psf(psf, changing(*DETECTOR))
    write_image(image, shape=(40, 48))
    row = client.upload_psf(psf)
    cards = ("--instrument", "test", "--channel", "171", "--kind", "total")
    command("psf", "certify", row["id"], "--version", "1.0.0", *cards)
    assert row["id"][:12] in command("psf", "list")
    command("deconvolve", image, "--psf", row["id"], "--steps", 3, "-o", tmp_path / "here.fits")
    run("deconvolve", image, "--psf", psf, "--local", "--steps", 3, "-o", tmp_path / "local.fits")
    np.testing.assert_array_equal(fits.getdata(tmp_path / "here.fits"), fits.getdata(tmp_path / "local.fits"))
    with fits.open(psf, mode="update") as hdus:
        hdus["FIELD", 1].data[0, 0] = -0.5
    with pytest.raises(ServiceError, match="x, y = 0, 39 px"):
        client.upload_psf(psf)
