"""The database's revision: new, adopted, older and newer databases; data that stay; processes that start at once."""

from __future__ import annotations

import json
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import pytest
from alembic import command
from alembic.autogenerate import compare_metadata
from alembic.runtime.migration import MigrationContext
from sqlalchemy import insert, inspect, select, text
from sqlalchemy.exc import DatabaseError

from tests.tables import RUN_REVISIONS
from tests.whole.stack import Missing, postgres_database
from workers.bulk import intake
from workers.catalogue import schema
from workers.catalogue.bulk_tables import BulkRow
from workers.catalogue.catalogue import Catalogue
from workers.catalogue.migrations.versions.r0001_baseline import METADATA as BASELINE
from workers.catalogue.migrations.versions.r0003_psf_versions import BATCH
from workers.catalogue.owners import ROW_BYTES
from workers.catalogue.psfs import PsfFilter
from workers.catalogue.schema import Schema, SchemaError
from workers.catalogue.stage_times import Spent
from workers.catalogue.tables import (
    Base,
    DefaultContextRow,
    ImageRow,
    JobRow,
    OwnerRow,
    PartRow,
    ProductRow,
    PsfChangeRow,
    PsfContextRow,
    PsfRow,
    ReportRow,
)
from workers.contract.identities import canonical_hash
from workers.settings import Settings
from workers.versions.series import series_of

OLD_ROWS = {
    "images": {"bytes": 5, "filename": "a.fits", "summary": {"instrument": "hri_euv"}},
    "psfs": {
        "name": "hri", "version": "1.0.0+0", "instrument": "hri_euv", "status": "draft", "origin": "built",
        "file_sha256": "f" * 64, "bytes": 7, "details": {"shape": [4, 4], "components": ["AIRY"]},
    },
    "products": {
        "kind": "deconvolved-image", "image_id": "a" * 64, "psf_id": "b" * 64, "psf_version": "1.0.0+0",
        "file_sha256": "e" * 64, "bytes": 9, "preview_sha256": "d" * 64, "details": {"job_id": "1" * 32},
    },
}  # fmt: skip

# Without these, the tables are those of revision 0018, and then those of 0017.
UNDO_0019 = ("ALTER TABLE bulks DROP COLUMN listed_to",)
UNDO_0018 = (*UNDO_0019, "DROP TABLE series_changes", "ALTER TABLE psf_pins DROP COLUMN interpolated")


@pytest.fixture(params=["sqlite", "postgresql"])
def url(request: pytest.FixtureRequest, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[str]:
    monkeypatch.setattr(Schema, "upgrade", RUN_REVISIONS)
    if request.param == "sqlite":
        yield f"sqlite:///{tmp_path / 'c.sqlite'}"
        return
    with ExitStack() as resources:
        try:
            made = resources.enter_context(postgres_database())
        except Missing as missing:
            pytest.skip(str(missing))
        yield Settings(database_url=made).catalogue_url


@pytest.fixture
def catalogue(url: str) -> Iterator[Catalogue]:
    """On an empty database."""
    catalogue = Catalogue(url)
    yield catalogue
    catalogue.close()


def make_as_before_revisions(catalogue: Catalogue) -> None:
    """The tables of the versions before revisions, with a row each."""
    BASELINE.create_all(catalogue._engine)
    with catalogue._engine.begin() as connection:
        for number, (name, row) in enumerate(OLD_ROWS.items()):
            identity = "abc"[number] * 64
            connection.execute(
                insert(BASELINE.tables[name]),
                {"owner": "local", "id": identity, "created_at": float(number), **row},
            )


def differences(catalogue: Catalogue) -> list[object]:
    """Between the database and the tables that the code works with, as alembic sees them."""
    options = {"compare_type": True, "compare_server_default": True}
    with catalogue._engine.connect() as connection:
        found: list[object] = compare_metadata(
            MigrationContext.configure(connection, opts=options), Base.metadata
        )
        return found


def indexes(catalogue: Catalogue) -> set[str]:
    """The database's indexes in its own words, with the condition of those that have one."""
    statement = (
        "SELECT sql FROM sqlite_master WHERE type = 'index' AND sql IS NOT NULL"
        if catalogue._engine.dialect.name == "sqlite"
        else "SELECT indexdef FROM pg_indexes WHERE schemaname = 'public' AND tablename <> 'alembic_version'"
    )
    with catalogue._engine.connect() as connection:
        return set(connection.scalars(text(statement)))


def test_a_new_database_has_the_tables_that_the_code_works_with(url: str, catalogue: Catalogue) -> None:
    assert catalogue.schema.status().state == "empty"
    catalogue.upgrade()
    assert catalogue.schema.status().state == "current"
    assert differences(catalogue) == []
    upgraded = indexes(catalogue)
    with catalogue._engine.begin() as connection:
        Base.metadata.drop_all(connection)
        Base.metadata.create_all(connection)
    assert upgraded == indexes(catalogue)


def test_the_database_of_one_process_has_the_same_tables(catalogue: Catalogue) -> None:
    catalogue.schema.create()
    assert differences(catalogue) == []
    created = indexes(catalogue)
    with catalogue._engine.begin() as connection:
        Base.metadata.drop_all(connection)
    catalogue.upgrade()
    assert indexes(catalogue) == created


def test_a_database_from_before_revisions_is_adopted_with_its_data(catalogue: Catalogue) -> None:
    make_as_before_revisions(catalogue)
    with catalogue._engine.begin() as connection:  # as one of an even earlier version
        connection.execute(text("DROP TABLE workers"))
        connection.execute(text("DROP INDEX jobs_tallied"))
    assert catalogue.schema.status().state == "unversioned"
    catalogue.upgrade()
    assert catalogue.schema.status().state == "current"
    assert differences(catalogue) == []
    image, psf, product = (
        catalogue.get(table, letter * 64, "local")
        for table, letter in ((ImageRow, "a"), (PsfRow, "b"), (ProductRow, "c"))
    )
    assert image is not None and image.summary == {"instrument": "hri_euv"}
    assert psf is not None and psf.version == "1.0.0+0" and psf.details["shape"] == [4, 4]
    assert product is not None and product.psf_id == psf.id and product.created_at == 2.0
    assert catalogue.owners.recount() == [], "the rows count since revision 0012"


@pytest.mark.parametrize(
    ("row", "series"),
    [
        ({"origin": "built", "details": {"wavelength_angstrom": 171.07}}, ("hri_euv", "171", "total")),
        (
            {
                "origin": "built",
                "details": {
                    "wavelength_angstrom": 174.0,
                    "provenance": {"parameters": {"component": "diffraction"}},
                },
            },
            ("hri_euv", "174", "diffraction"),
        ),
        ({"origin": "fitted", "details": {"provenance": {"parameters": {}}}}, ("hri_euv", "174", "total")),
        (
            {"origin": "uploaded", "status": "uploaded", "instrument": None, "details": {}},
            (None, None, "uploaded"),
        ),
        (
            {"origin": "built", "status": "released", "instrument": "mine", "details": {}},
            ("mine", None, "total"),
        ),
    ],
)
def test_psfs_get_the_series_that_follows_from_their_rows(
    catalogue: Catalogue, row: dict[str, Any], series: tuple[str | None, ...]
) -> None:
    make_as_before_revisions(catalogue)
    with catalogue._engine.begin() as connection:
        connection.execute(
            insert(BASELINE.tables["psfs"]),
            {**OLD_ROWS["psfs"], "owner": "o", "id": "9" * 64, "created_at": 1.0, **row},
        )
    catalogue.upgrade()
    psf = catalogue.get(PsfRow, "9" * 64, "o")
    assert psf is not None and psf.status == "draft"
    assert (psf.instrument, psf.channel, psf.kind) == series
    assert psf.series == series_of(*series)


def test_more_psfs_than_are_filled_at_a_time_are_all_filled(catalogue: Catalogue) -> None:
    make_as_before_revisions(catalogue)
    rows = [
        {**OLD_ROWS["psfs"], "owner": "xyz"[n % 3], "id": f"{n:064x}", "created_at": 1.0}
        for n in range(BATCH + 100)
    ]
    with catalogue._engine.begin() as connection:
        connection.execute(insert(BASELINE.tables["psfs"]), rows)
    catalogue.upgrade()
    with catalogue._engine.connect() as connection:
        assert set(connection.scalars(select(PsfRow.series))) == {"hri_euv/174/total"}


def test_a_revision_between_is_upgraded(catalogue: Catalogue) -> None:
    make_as_before_revisions(catalogue)
    with catalogue._engine.begin() as connection:
        connection.execute(
            text("CREATE TABLE alembic_version (version_num VARCHAR(32) NOT NULL PRIMARY KEY)")
        )
        connection.execute(text("INSERT INTO alembic_version VALUES ('0001')"))
    assert catalogue.schema.status().state == "older"
    catalogue.upgrade()
    assert catalogue.schema.status().state == "current" and differences(catalogue) == []
    with catalogue._engine.connect() as connection:
        assert connection.scalar(select(PsfRow.bytes)) == 7


def test_rows_without_files_count_after_the_upgrade(catalogue: Catalogue) -> None:
    """Also those of an owner who had no count. Revision 0017 changes no table, so that 0016 has those of 0017."""
    catalogue.upgrade()
    rows: list[Base] = []
    for owner in ("counted", "new"):
        rows += [
            JobRow(id=f"{owner:x<32}", owner=owner, kind="psf-build", parameters={"a": owner}, request_key="k",
                   phase="QUEUED", created_at=1.0),
            BulkRow(id=f"{owner:x<32}", owner=owner, name="", phase="RUNNING", request={"b": owner}, request_key="k",
                    created_at=1.0, listed=True, total=3),
            PsfContextRow(owner=owner, id="c" * 64, name="c", created_at=1.0, created_by="x", reason="", pins=2),
            PsfChangeRow(owner=owner, psf_id="d" * 64, at=1.0, by="x", status_before="draft", status="certified",
                         version_before="0", version="1", reason=""),
            DefaultContextRow(owner=owner, at=1.0, by="x", reason=""),
            PartRow(owner=owner, request_key="k", number=0),
        ]  # fmt: skip
    with catalogue._database.writing.begin() as session:
        session.add_all(rows)
        session.add(OwnerRow(owner="counted", bytes=0))
        session.flush()
        for statement in (*UNDO_0018, "UPDATE alembic_version SET version_num = '0016'"):
            session.execute(text(statement))
    catalogue.upgrade()
    assert catalogue.schema.status().state == "current"
    # A job, a bulk run of three images, a context of two pins, a change of a PSF and of the default, and a part.
    expected = ROW_BYTES * (1 + 4 + 3 + 1 + 1 + 1)
    for owner in ("counted", "new"):
        json_bytes = len(f'{{"a": "{owner}"}}{{"b": "{owner}"}}')
        assert catalogue.owners.usage(owner, 0).used_bytes == expected + json_bytes
    assert catalogue.owners.recount() == []


def test_in_existing_contexts_no_series_is_interpolated(catalogue: Catalogue) -> None:
    catalogue.upgrade()
    pin = {
        "owner": "o", "context_id": "c" * 64, "series": "hri_euv/174/total", "valid_from": 0.0, "valid_to": 1.0,
        "psf_id": "d" * 64, "version": "1.0.0",
    }  # fmt: skip
    with catalogue._database.writing.begin() as session:
        for statement in (*UNDO_0018, "UPDATE alembic_version SET version_num = '0017'"):
            session.execute(text(statement))
        named = ", ".join(pin), ", ".join(f":{name}" for name in pin)
        session.execute(text(f"INSERT INTO psf_pins ({named[0]}) VALUES ({named[1]})"), pin)
    catalogue.upgrade()
    assert differences(catalogue) == []
    (row,) = catalogue.contexts.pins("c" * 64, "o")
    assert row.interpolated is False and row.version == "1.0.0"
    assert not catalogue.series.interpolated("hri_euv/174/total", "o")


def test_a_later_revision_is_refused_and_left_alone(catalogue: Catalogue) -> None:
    catalogue.upgrade()
    with catalogue._engine.begin() as connection:
        connection.execute(text("UPDATE alembic_version SET version_num = '9999'"))
    with pytest.raises(SchemaError, match=r"at revision 9999.*knows revisions up to 0"):
        catalogue.upgrade()
    assert catalogue.schema.status().revision == "9999"


def test_foreign_tables_are_refused_and_not_changed(catalogue: Catalogue) -> None:
    with catalogue._engine.begin() as connection:
        connection.execute(text("CREATE TABLE images (id VARCHAR(64) PRIMARY KEY, pixels TEXT)"))
    with pytest.raises(SchemaError, match=r"without a revision.*images\.owner.*images\.summary"):
        catalogue.upgrade()
    assert inspect(catalogue._engine).get_table_names() == ["images"]


def test_an_upgrade_that_fails_leaves_nothing_behind(catalogue: Catalogue) -> None:
    """Revisions are one transaction: tables that an earlier one made go where a later one fails."""
    with catalogue._engine.begin() as connection:
        connection.execute(text("CREATE TABLE keys (id INTEGER PRIMARY KEY)"))  # in the second one's way
    with pytest.raises(DatabaseError, match="exists"):
        catalogue.upgrade()
    assert inspect(catalogue._engine).get_table_names() == ["keys"]


STARTS = """
import sys, time
from workers.bulk import intake
from workers.catalogue import schema
from workers.catalogue.catalogue import Catalogue
catalogue = Catalogue(sys.argv[1])
time.sleep(max(0.0, float(sys.argv[2]) - time.time()))
catalogue.upgrade()
print(catalogue.schema.status().state, catalogue.schema.faults().tables)
"""


@pytest.mark.parametrize("adopted", [pytest.param(False, marks=pytest.mark.slow), True])
def test_processes_that_start_at_once_make_one_upgrade(url: str, catalogue: Catalogue, adopted: bool) -> None:
    if adopted:
        make_as_before_revisions(catalogue)
    at = str(time.time() + 4.0)
    started = [
        subprocess.Popen([sys.executable, "-c", STARTS, url, at], stdout=subprocess.PIPE, text=True)
        for _ in range(3)
    ]
    said = [process.communicate(timeout=60)[0].strip() for process in started]
    assert [process.returncode for process in started] == [0] * 3
    assert said == ["current ()"] * 3
    assert differences(catalogue) == []
    with catalogue._engine.connect() as connection:
        assert connection.scalar(text("SELECT count(*) FROM alembic_version")) == 1


# Revision 0010: new names -----------------------------------------------------------------------------

# Rows as version 0.1.0 (revision 0009) wrote them, shortened; the deconvolution is that of its `heliopsf demo`.
PARAMETERS = {
    "image_id": "f" * 64, "psf_id": "0" * 64, "psf_recipe": {"instrument": "hri_euv", "size": 2048},
    "method": {"stop": "fixed", "name": "richardson-lucy", "steps": 20}, "error_draws": 0, "effects_picture": False,
}  # fmt: skip
DETAILS = {
    "method": {"stop": "fixed", "edges": None, "margin_px": None, "name": "richardson-lucy", "steps": 20},
    "algorithm_version": 1, "parameters": PARAMETERS, "job_id": "1" * 32, "flux_change_pct": 0.01,
    "effects": {"structures": [], "artefacts": {"score": 0.4}}, "effects_picture_sha256": "9" * 64,
}  # fmt: skip
BULK_REQUEST = {
    "name": "a week", "psf_id": "0" * 64, "files": [], "output": None, "context": None,
    "parameters": {"method": PARAMETERS["method"], "error_draws": 0, "effects_picture": True},
}  # fmt: skip
ROWS_BEFORE_0010: dict[str, list[dict[str, Any]]] = {
    "psfs": [
        {
            "owner": "local", "id": "0" * 64, "created_at": 1.0, "name": "hri_euv", "version": "1.0.0",
            "instrument": "hri_euv", "channel": "174", "kind": "total", "line": "hri_euv/174/total",
            "status": "certified", "valid_from": 0.0, "valid_to": 9e9, "origin": "built", "file_sha256": "a" * 64,
            "bytes": 7, "details": '{"shape": [4, 4]}',
        },
    ],
    "psf_lines": [{"owner": "local", "line": "hri_euv/174/total"}],
    "psf_pins": [
        {
            "owner": "local", "context_id": "c" * 64, "line": "hri_euv/174/total", "valid_from": 0.0,
            "valid_to": 9e9, "psf_id": "0" * 64, "version": "1.0.0",
        },
    ],
    "products": [
        {
            "owner": "local", "id": letter * 64, "created_at": 2.0, "kind": "deconvolved-image", "image_id": "f" * 64,
            "psf_id": "0" * 64, "psf_version": "1.0.0", "file_sha256": "b" * 64, "bytes": 9,
            "preview_sha256": "d" * 64, "details": json.dumps(details),
        }
        for letter, details in (("1", DETAILS), ("2", {"job_id": "1" * 32}))
    ],
    "jobs": [
        {
            "id": letter * 32, "owner": "local", "kind": kind, "parameters": json.dumps(parameters),
            "request_key": letter * 64, "work_key": letter * 64, "phase": "COMPLETED", "queue": "interactive",
            "created_at": 3.0, "submissions": 1, "attempt": 1, "cancel_requested": False, "step": 1, "steps": 1,
            "stage": "saving",
        }
        for letter, kind, parameters in (
            ("1", "deconvolve", PARAMETERS),
            ("2", "evaluate", {"transit_id": "3" * 64, "seed": 0}),
            ("4", "rerun", {"of": "product", "id": "1" * 64, "kind": "deconvolve", "parameters": PARAMETERS}),
        )
    ],
    "reports": [
        {
            "owner": "local", "id": letter * 64, "created_at": 4.0, "kind": kind, "transit_id": "3" * 64,
            "file_sha256": "e" * 64, "bytes": 3, "details": '{"sentence": "A sentence."}',
        }
        for letter, kind in (("5", "evaluate"), ("6", "gap"))
    ],
    "stage_times": [{"kind": "evaluate", "stage": "reading", "seconds": 1.5, "steps": 3}],
    "bulks": [
        {
            "id": "b" * 32, "owner": "local", "name": "a week", "phase": "RUNNING", "request": json.dumps(BULK_REQUEST),
            "request_key": canonical_hash({**BULK_REQUEST, "name": None, "images": ["8" * 64, "7" * 64]}),
            "psf_id": "0" * 64, "created_at": 5.0, "listed": True, "total": 2, "done": 0, "reused": 0, "failed": 0,
        }
    ],
    "bulk_items": [
        {
            "bulk_id": "b" * 32, "position": number, "uploaded": True, "source": letter * 64, "state": "WAITING",
            "attempts": 0, "reused": False, "kept": False,
        }
        for number, letter in enumerate("87")
    ],
}  # fmt: skip


@pytest.fixture
def renamed(catalogue: Catalogue) -> Catalogue:
    """A database at revision 0009 with these rows, upgraded."""
    with catalogue._engine.begin() as connection:
        config = schema._config()
        config.attributes["connection"] = connection
        command.upgrade(config, "0009")
        for table, rows in ROWS_BEFORE_0010.items():
            columns = ", ".join(rows[0])
            values = ", ".join(f":{name}" for name in rows[0])
            connection.execute(text(f"INSERT INTO {table} ({columns}) VALUES ({values})"), rows)
    catalogue.upgrade()
    assert catalogue.schema.status().state == "current" and differences(catalogue) == []
    return catalogue


def test_a_line_of_psfs_is_a_series_after_the_upgrade(renamed: Catalogue) -> None:
    psf = renamed.get(PsfRow, "0" * 64, "local")
    assert psf is not None and psf.series == "hri_euv/174/total"
    assert renamed.psfs.any_certified("hri_euv/174/total", "local")
    assert renamed.contexts.any_pinned("c" * 64, "hri_euv/174/total", "local")
    (found,) = renamed.psfs.page(PsfFilter("hri_euv", "174", "total", valid_at=1e9), "local", limit=9)
    assert found.id == psf.id


def test_changes_and_their_picture_have_their_names_after_the_upgrade(renamed: Catalogue) -> None:
    product, other = (renamed.get(ProductRow, letter * 64, "local") for letter in "12")
    assert product is not None and other is not None and other.details == {"job_id": "1" * 32}
    assert product.details["changes"] == DETAILS["effects"]
    assert product.details["changes_picture_sha256"] == "9" * 64
    assert product.details["parameters"]["changes_picture"] is False
    assert "effects" not in json.dumps(product.details)
    for job_id, parameters in (("1", {}), ("4", {"of": "product", "id": "1" * 64, "kind": "deconvolve"})):
        job = renamed.jobs.get(job_id * 32)
        assert job is not None and "effects" not in json.dumps(job.parameters)
        whole = {name: value for name, value in PARAMETERS.items() if name != "effects_picture"}
        whole["changes_picture"] = False
        assert job.parameters == ({**parameters, "parameters": whole} if parameters else whole)


def test_the_kind_evaluate_is_report_after_the_upgrade(renamed: Catalogue) -> None:
    job = renamed.jobs.get("2" * 32)
    assert job is not None and job.kind == "report" and job.parameters == {"transit_id": "3" * 64, "seed": 0}
    kinds = {row.kind for row in renamed.page(ReportRow, owner="local", limit=9)}
    assert kinds == {"report", "gap"}
    assert renamed.stage_times.all() == {("report", "reading"): Spent(1.5, 3)}


def test_an_open_bulk_run_is_found_by_an_identical_request_after_the_upgrade(renamed: Catalogue) -> None:
    bulk = renamed.bulks.get("b" * 32)
    assert bulk is not None and bulk.request["parameters"]["changes_picture"] is True
    assert "effects" not in json.dumps(bulk.request)
    assert bulk.request_key == intake._key(bulk.request, ["8" * 64, "7" * 64])
