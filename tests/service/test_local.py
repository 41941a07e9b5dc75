"""The service in this process: it reads the user's files where they are, and copies none."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from psfcore.transit.archive import pack
from service.client.errors import ServiceError
from service.local import LocalStore, local_service
from tests.conftest import write_image, write_psf
from tests.transit_files import write_transit
from workers.files.store import sha256_of
from workers.settings import Settings


def test_files_are_served_where_they_are(tmp_path: Path) -> None:
    write_image(tmp_path / "image.fits")
    store = LocalStore(tmp_path / "data")
    digest = store.add_file(tmp_path / "image.fits")
    assert digest == sha256_of(tmp_path / "image.fits")
    assert store.path(digest) == (tmp_path / "image.fits").resolve()
    assert list(store.blobs()) == []


def test_a_file_that_changed_is_not_read(tmp_path: Path) -> None:
    write_image(tmp_path / "image.fits")
    store = LocalStore(tmp_path / "data")
    digest = store.add_file(tmp_path / "image.fits")
    os.utime(tmp_path / "image.fits", ns=(1, 1))
    with pytest.raises(OSError, match=r"image\.fits changed while it was read"):
        store.path(digest)


def test_a_folder_is_read_in_place_and_an_archive_is_unpacked(tmp_path: Path) -> None:
    write_transit(tmp_path / "transit")
    limits = Settings().archive_limits
    with local_service() as service:
        store = service._store
        uploaded = service.upload_transit(tmp_path / "transit")
        with store.unpacked(uploaded["id"], limits) as folder:
            assert folder == (tmp_path / "transit").resolve()
        assert list(store.blobs()) == [] and (tmp_path / "transit" / "transit.json").is_file()
        (tmp_path / "transit" / "transit.json").touch()
        with pytest.raises(OSError, match="changed"), store.unpacked(uploaded["id"], limits):
            pass
    with local_service() as service:
        pack(tmp_path / "transit", tmp_path / "transit.tar")
        archive = service.upload_transit(tmp_path / "transit.tar")
        assert archive["id"] == uploaded["id"]
        with service._store.unpacked(archive["id"], limits) as folder:
            assert folder != (tmp_path / "transit").resolve()
            assert (folder / "transit.json").is_file()
        assert not folder.exists()


def test_a_folder_without_a_transit_is_refused(tmp_path: Path) -> None:
    with local_service() as service, pytest.raises(ServiceError) as caught:
        service.upload_transit(tmp_path)
    assert caught.value.code == "no-manifest"


def test_a_product_does_not_replace_the_image_that_it_was_made_from(tmp_path: Path) -> None:
    write_image(tmp_path / "image.fits")
    write_psf(tmp_path / "psf.fits")
    before = sha256_of(tmp_path / "image.fits")
    with local_service() as service:
        psf = service.upload_psf(tmp_path / "psf.fits")
        for overwrite in (False, True):
            with pytest.raises(ServiceError) as caught:
                service.deconvolve(
                    tmp_path / "image.fits",
                    tmp_path / "image.fits",
                    psf_id=psf["id"],
                    steps=2,
                    overwrite=overwrite,
                )
            assert caught.value.code == "output-is-input"
            assert sha256_of(tmp_path / "image.fits") == before
