"""Files that nothing names: found by looking at every row, left alone while they are young, removed and nothing else."""

from __future__ import annotations

import os
import time
from collections.abc import Iterator
from pathlib import Path

import pytest
from click.testing import CliRunner

from psfcore.errors import DataError
from service.cli import main
from service.local import LocalService
from tests.s3 import opened_store
from workers.catalogue import Catalogue
from workers.collection import collect
from workers.settings import Settings
from workers.store import Store
from workers.tables import ImageRow, ReportRow

DAY_S = 86_400.0


@pytest.fixture(params=["folder", "s3"])
def store(request: pytest.FixtureRequest, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Store]:
    with opened_store(request.param, tmp_path, monkeypatch) as opened:
        yield opened


def kept(store: Store, content: bytes) -> str:
    with store.temporary() as path:
        path.write_bytes(content)
        return store.keep(path)


def image(digest: str) -> ImageRow:
    return ImageRow(owner="o", id=digest, created_at=1.0, bytes=1, summary={})


def test_what_no_row_names_goes_and_what_one_names_stays(store: Store, catalogue: Catalogue) -> None:
    named, deep, orphan = kept(store, b"a"), kept(store, b"b"), kept(store, b"cc")
    catalogue.add(image(named))
    report = ReportRow(
        owner="o", id="1" * 64, created_at=1.0, kind="k", file_sha256=named, bytes=1,
        details={"some": [{"page_sha256": deep}]},
    )  # fmt: skip
    catalogue.add(report)
    dry = collect(catalogue, store, -60.0, dry_run=True)
    assert (dry.files, dry.bytes, dry.removed_bytes) == (3, 4, 2)
    assert [blob.digest for blob in dry.removed] == [orphan]
    assert {blob.digest for blob in store.blobs()} == {named, deep, orphan}, "nothing was removed"
    assert collect(catalogue, store, -60.0) == dry
    assert {blob.digest for blob in store.blobs()} == {named, deep}
    assert collect(catalogue, store, -60.0).removed == ()


def test_what_is_young_is_left_alone(store: Store, catalogue: Catalogue) -> None:
    catalogue.add(image(kept(store, b"a")))
    orphan = kept(store, b"an upload whose row is not written yet")
    assert collect(catalogue, store, DAY_S).removed == ()
    assert store.path(orphan).exists()


def test_an_upload_in_progress_of_an_old_orphan_is_not_taken(
    tmp_path: Path, catalogue: Catalogue, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It is kept again after the rows were looked at: its own row comes later still."""
    store = Store(tmp_path / "data")
    catalogue.add(image(kept(store, b"a")))
    orphan = kept(store, b"sent long ago")
    long_ago = time.time() - 100 * DAY_S
    os.utime(store.path(orphan), (long_ago, long_ago))
    real = type(catalogue.named_files).all

    def sent_again(self: object) -> Iterator[str]:
        yield from real(self)  # type: ignore[arg-type]
        kept(store, b"sent long ago")

    with monkeypatch.context() as patched:
        patched.setattr(type(catalogue.named_files), "all", sent_again)
        assert collect(catalogue, store, DAY_S).removed == ()
    assert store.path(orphan).exists()


def test_a_database_that_names_nothing_is_not_believed(store: Store, catalogue: Catalogue) -> None:
    kept(store, b"a")
    with pytest.raises(DataError, match="is it the right one"):
        collect(catalogue, store, -60.0)
    assert len(list(store.blobs())) == 1


def test_a_service_at_work_loses_nothing(
    settings: Settings, tmp_path: Path, image_file: Path, psf_file: Path
) -> None:
    local = LocalService(settings)
    psf = local.upload_psf(psf_file)
    product = local.deconvolve(image_file, psf_id=psf["id"], steps=1, effects=tmp_path / "e.png")
    local.answer([psf["id"]], "curve", {})  # has tables and a picture made
    store, catalogue = Store(settings.data_dir), Catalogue(settings.catalogue_url)
    before = {blob.digest for blob in store.blobs()}
    assert len(before) >= 7 and collect(catalogue, store, -60.0).removed == ()
    for part in ("file", "preview", "effects"):
        local.download(product[part], tmp_path / part)
    local.close(), catalogue.close()


def test_the_command_line(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    settings = Settings(data_dir=tmp_path / "data")
    monkeypatch.setenv("HELIOPSF_DATA_DIR", str(settings.data_dir))
    store, catalogue = Store(settings.data_dir), Catalogue(settings.catalogue_url)
    catalogue.upgrade()
    catalogue.add(image(kept(store, b"a")))
    orphan = kept(store, b"x" * 2**20)
    long_ago = time.time() - 40 * DAY_S
    os.utime(store.path(orphan), (long_ago, long_ago))

    def said(*arguments: str, status: int = 0) -> str:
        answer = CliRunner().invoke(main, ["store", "collect", *arguments])
        assert answer.exit_code == status, answer.output
        return answer.output

    dry = said("--dry-run")
    assert orphan in dry and "1 of 2 files would be removed, 1.0 of 1.0 MiB" in dry
    assert "0 of 2 files would be removed" in said("--dry-run", "--older-than", "8w")
    assert "expected 2d or more" in said("--older-than", "1h", status=2)
    assert store.path(orphan).exists()
    assert "1 of 2 files were removed" in said()
    assert not store.path(orphan).exists()
    with catalogue._engine.begin() as connection:
        connection.exec_driver_sql("UPDATE alembic_version SET version_num = '9999'")
    assert "not at this version's revision" in said(status=1)
    catalogue.close()
