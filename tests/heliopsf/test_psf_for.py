"""The PSF for an image is found by the header, as on a service; it is built once and kept."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import sunpy.map
from astropy.io import fits

import heliopsf
from psfcore.instruments import files
from service.cli.local import local
from tests.conftest import SMALL_INSTRUMENT, write_image
from tests.heliopsf.test_forms import cards
from workers.contract.identities import psf_identity
from workers.contract.requests import PsfBuild
from workers.machine import psf_cache

MATCH = '\n[match]\nDETECTOR = "SMALL"\n'


@pytest.fixture(scope="module")
def cache(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The cache of these tests, so that a PSF is built once."""
    return tmp_path_factory.mktemp("cache")


@pytest.fixture
def small(tmp_path: Path, cache: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """The small instrument as one of the shipped ones: its PSF is built in a second."""
    folder = tmp_path / "instruments"
    folder.mkdir()
    (folder / "small.toml").write_text(SMALL_INSTRUMENT + MATCH)
    monkeypatch.setattr(files, "_FOLDER", folder)
    monkeypatch.setenv("HELIOPSF_CACHE_DIR", str(cache))
    files.match_table.cache_clear()
    yield folder
    files.match_table.cache_clear()


def image_file(path: Path, **cards: Any) -> Path:
    write_image(path, DETECTOR="SMALL", WAVELNTH=171, **{"CDELT1": 2.0, "CDELT2": 2.0, **cards})
    return path


def test_the_psf_is_that_of_the_service(small: Path, tmp_path: Path) -> None:
    image = image_file(tmp_path / "image.fits")
    psf = heliopsf.psf_for(image)
    assert psf.provenance["psf_id"] == psf_identity(PsfBuild(instrument="small"))
    mine = heliopsf.deconvolve(image, full=True)
    header = fits.getheader(image)
    for known in (header, dict(header), mine.image):
        np.testing.assert_array_equal(heliopsf.psf_for(known).kernel, psf.kernel)
    with local() as service:
        product = service.deconvolve(image, tmp_path / "product.fits")
    assert product["psf_id"] == psf.provenance["psf_id"] and product["psf_version"] == psf.version
    with fits.open(tmp_path / "product.fits") as hdus:
        np.testing.assert_array_equal(hdus[0].data, mine.pixels.astype("f4"))
        np.testing.assert_array_equal(hdus["QUALITY"].data, mine.quality)
        own = {card.keyword for card in hdus[0].header.cards} - {"PRODID", "INPSHA", "DCNVALGV"}
    result = heliopsf.deconvolve(sunpy.map.Map(fits.getdata(image), cards(detector="SMALL")))
    assert {key for key in own if key.startswith(("PSF", "DCNV"))} == {
        key.upper() for key in result.meta if key.startswith(("psf", "dcnv"))
    }
    assert result.meta["psfid"] == product["psf_id"]


def test_a_deconvolution_builds_the_total_psf_alone(
    small: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Its components are computed when they are asked for; the result of a deconvolution does not depend on this."""
    monkeypatch.setenv("HELIOPSF_CACHE_DIR", str(tmp_path / "empty"))
    image = image_file(tmp_path / "image.fits")
    first = heliopsf.deconvolve(image, full=True)
    assert first.psf.components == {}
    psf = heliopsf.psf_for(image)
    assert "DIFFRACTION" in psf.components
    np.testing.assert_array_equal(psf.kernel, first.psf.kernel)
    assert psf.provenance["psf_id"] == first.psf.provenance["psf_id"]
    again = heliopsf.deconvolve(image, full=True)  # reads the file with components
    np.testing.assert_array_equal(again.pixels, first.pixels)
    assert again.psf.components == {} and len(psf_cache().psfs()) == 1


def test_the_psf_of_a_binned_image_is_rebinned(small: Path, tmp_path: Path) -> None:
    binned = image_file(tmp_path / "binned.fits", CDELT1=4.0, CDELT2=4.0)
    psf = heliopsf.psf_for(binned)
    assert isinstance(psf, heliopsf.Psf) and psf.plate_scale_arcsec == 4.0 and psf.version.endswith("+bin2")
    result = heliopsf.deconvolve(binned)
    assert result.psf.version == psf.version
    header = fits.getheader(image_file(tmp_path / "odd.fits", CDELT1=3.0, CDELT2=3.0))
    with pytest.raises(heliopsf.DataError, match="plate-scale-mismatch"):
        heliopsf.psf_for(header)


def test_an_unknown_telescope_is_refused_with_the_ways_on(small: Path) -> None:
    pixels = np.ones((40, 40)) + np.eye(40)
    for ask in (heliopsf.psf_for, heliopsf.deconvolve):
        with pytest.raises(heliopsf.DataError, match=r"no-psf-for-instrument: .*OTHER'.*psf in") as caught:
            ask(sunpy.map.Map(pixels, cards(detector="OTHER")))
        assert [one["name"] for one in caught.value.fields["instruments"]] == ["small"]
    with pytest.raises(heliopsf.DataError, match=r"unnamed instrument.* TELESCOP"):
        heliopsf.deconvolve(pixels)


def test_telescopes_in_a_list_get_each_its_own_psf(small: Path, tmp_path: Path) -> None:
    text = (SMALL_INSTRUMENT + MATCH).replace('"small"', '"wide"').replace('"SMALL"', '"WIDE"')
    (small / "wide.toml").write_text(text.replace("diameter_mm = 4.0", "diameter_mm = 3.0"))
    files.match_table.cache_clear()
    maps = [sunpy.map.Map(np.ones((40, 40)) + np.eye(40), cards(detector=name)) for name in ("SMALL", "WIDE")]
    results = heliopsf.deconvolve(maps)
    assert [result.meta["psfname"] for result in results] == ["small", "wide"]


def test_a_built_psf_is_kept_and_the_same_afterwards(small_toml: Path) -> None:
    told: list[int] = []
    progress: Any = lambda step, steps: told.append(steps)  # noqa: E731
    first = heliopsf.build_psf(small_toml, size=64, progress=progress)
    assert len(told) > 1
    (kept,) = psf_cache().psfs()
    assert kept.identity == first.provenance["psf_id"]
    told.clear()
    again = heliopsf.build_psf(small_toml, size=64, progress=progress)
    assert told == [], "nothing was built"
    np.testing.assert_array_equal(again.kernel, first.kernel)
    assert again.provenance == first.provenance and again.version == first.version
    assert set(again.components) == set(first.components)
    other = heliopsf.build_psf(small_toml, size=128)
    assert other.kernel.shape == (128, 128) and 0.9 < other.total <= 1.0


def test_a_cache_that_cannot_be_used_is_a_warning(
    psf: heliopsf.Psf, small_toml: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "file").write_text("not a folder")
    monkeypatch.setenv("HELIOPSF_CACHE_DIR", str(tmp_path / "file"))
    with pytest.warns(UserWarning, match="is not kept"):
        built = heliopsf.build_psf(small_toml, size=64)
    np.testing.assert_array_equal(built.kernel, psf.kernel)
    assert built.provenance == psf.provenance
