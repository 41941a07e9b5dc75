"""A catalogue with as many rows as an archive has after years, and everything that is asked of it."""

from __future__ import annotations

import random
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from typing import Any

from sqlalchemy import Engine, create_engine, event, text

from workers.catalogue.affected import PageEnd
from workers.catalogue.catalogue import Catalogue
from workers.catalogue.psfs import PsfFilter
from workers.catalogue.tables import (
    ImageRow,
    JobRow,
    ProductRow,
    PsfContextRow,
    PsfRow,
    ReportRow,
    TransitRow,
)
from workers.intake import psf_choice
from workers.lineage import lineage

OWNER = "local"
LINES = 200  # 20 instruments, 5 channels, 2 kinds
A_SERIES_YEARS = 50  # certified PSFs that follow one another in a series, at most
YEAR_S = 31_557_600.0
ONE_IN = {"certified": 10, "deprecated": 5}  # of PSFs
MUCH_USED_PCT = 10  # of products made with the first deprecated PSF


@dataclass(frozen=True)
class Size:
    """How many rows."""

    psfs: int
    products: int


@dataclass(frozen=True)
class Archive:
    """A catalogue that was filled, and what is in it."""

    catalogue: Catalogue
    engine: Engine  # of the same database
    size: Size

    def psf_id(self, n: int) -> str:
        """The id of the PSF of this number; they come in no order."""
        return f"{(n % self.size.psfs) * 2654435761 % 4294967296:064x}"

    def product_id(self, n: int) -> str:
        """The id of the product of this number."""
        return f"{(n % self.size.products) * 2654435761 % 4294967296:064x}"


def fill(catalogue: Catalogue, url: str, size: Size) -> Archive:
    """Rows in series, with statuses and ranges, products by the handful a PSF and a great many of one; by
    statements."""
    archive = Archive(catalogue, create_engine(url), size)
    sqlite = archive.engine.dialect.name == "sqlite"
    hexed = "printf('%064x', {})" if sqlite else "lpad(to_hex(cast({} as bigint)), 64, '0')"
    numbers = (
        "WITH RECURSIVE n(n) AS (SELECT 0 UNION ALL SELECT n + 1 FROM n WHERE n < {} - 1)"
        if sqlite
        else "WITH n AS (SELECT generate_series(0, {} - 1)::bigint AS n)"
    )

    def key(n: str) -> str:
        return hexed.format(f"(({n}) * 2654435761 % 4294967296)")

    line = f"n % {LINES}"
    place = f"(n / {LINES})"  # of a PSF in its series
    certified = (
        f"({place}) % {ONE_IN['certified']} = 0 AND ({place}) / {ONE_IN['certified']} < {A_SERIES_YEARS}"
    )
    deprecated = f"({place}) % {ONE_IN['deprecated']} = 3"
    instrument = f"'instrument_' || (({line}) / 10)"
    channel = f"cast(100 + ({line}) / 2 % 5 as text)"
    kind = f"CASE ({line}) % 2 WHEN 0 THEN 'total' ELSE 'diffraction' END"
    year = f"({place}) / {ONE_IN['certified']}"
    of_psf = f"CASE WHEN n % 100 < {MUCH_USED_PCT} THEN 3 * {LINES} ELSE n END % {size.psfs}"
    statements = [
        f"""{numbers.format(size.psfs)}
        INSERT INTO psfs (owner, id, created_at, name, version, instrument, channel, kind, series, status, valid_from,
            valid_to, successor_id, origin, file_sha256, bytes, preview_sha256, details)
        SELECT '{OWNER}', {key("n")}, 1e9 + n, 'psf ' || (n % 1000),
            CASE WHEN {certified} OR {deprecated} THEN '1.' || {place} || '.0' ELSE '0.1.0+' || n END,
            {instrument}, {channel}, {kind}, {instrument} || '/' || {channel} || '/' || {kind},
            CASE WHEN {certified} THEN 'certified' WHEN {deprecated} THEN 'deprecated' ELSE 'draft' END,
            CASE WHEN {certified} THEN ({year}) * {YEAR_S} WHEN {deprecated} THEN 0.0 END,
            CASE WHEN {certified} THEN ({year} + 1) * {YEAR_S} WHEN {deprecated} THEN 1.0 END,
            CASE WHEN {deprecated} AND n % 2 = 0 THEN {key(line)} END,
            'built', {key("n")}, n, NULL, '{{"shape": [2048, 2048], "provenance": {{}}}}'
        FROM n""",
        """INSERT INTO psf_series (owner, series) SELECT DISTINCT owner, series FROM psfs WHERE status = 'certified'""",
        f"""{numbers.format(size.products)}
        INSERT INTO products (owner, id, created_at, kind, image_id, psf_id, psf_version, file_sha256, bytes,
            preview_sha256, details)
        SELECT '{OWNER}', {key("n")}, 1e9 + n, 'deconvolved-image', {key("n / 4")}, {key(of_psf)}, '1.0.0',
            {key("n")}, n, {key("n")}, '{{"job_id": "0", "parameters": {{"steps": 20}}}}'
        FROM n""",
        f"""{numbers.format(size.psfs)}
        INSERT INTO psf_changes (owner, psf_id, at, by, status_before, status, version_before, version, reason)
        SELECT '{OWNER}', {key("n")}, 1e9 + n, 'x', 'draft', 'certified', '0.1.0', '1.0.0', '' FROM n""",
    ]
    with archive.engine.begin() as connection:
        for statement in statements:
            connection.execute(text(statement))
    for name in catalogue.series.all(OWNER):
        if name.endswith("/total"):
            catalogue.series.set_interpolated(name, OWNER, True, "x")
    catalogue.contexts.create("all", OWNER, "x")
    if not sqlite:  # as its autovacuum does by itself, in time
        with archive.engine.connect().execution_options(isolation_level="AUTOCOMMIT") as connection:
            connection.execute(text("VACUUM ANALYZE"))
    return archive


Question = Callable[[Archive, random.Random], Any]


def _rows(table: Any, **equal: str) -> Question:
    return lambda archive, rng: archive.catalogue.page(table, owner=OWNER, limit=51, **equal)


def _products(archive: Archive, rng: random.Random, *, deep: bool = False, **equal: str) -> Any:
    """A page of products; deep: from a place in the middle."""
    n = rng.randrange(archive.size.products)
    after = (1e9 + n, archive.product_id(n)) if deep else None
    return archive.catalogue.page(ProductRow, owner=OWNER, limit=51, after=after, **equal)


def _products_of_psf(archive: Archive, rng: random.Random) -> Any:
    return _products(archive, rng, psf_id=archive.psf_id(rng.randrange(archive.size.psfs)))


def _products_of_image(archive: Archive, rng: random.Random) -> Any:
    return _products(archive, rng, image_id=archive.product_id(rng.randrange(archive.size.products) // 4))


def _line(rng: random.Random) -> dict[str, str]:
    n = rng.randrange(LINES)
    kind = "diffraction" if n % 2 else "total"
    return {"instrument": f"instrument_{n // 10}", "channel": str(100 + n // 2 % 5), "kind": kind}


def _instrument(rng: random.Random) -> dict[str, str]:
    return {"instrument": f"instrument_{rng.randrange(20)}"}


def _psfs(*, deep: bool = False, pick: Callable[[random.Random], dict[str, Any]]) -> Question:
    def ask(archive: Archive, rng: random.Random) -> Any:
        n = rng.randrange(archive.size.psfs)
        after = (1e9 + n, archive.psf_id(n)) if deep else None
        return archive.catalogue.psfs.page(PsfFilter(**pick(rng)), OWNER, limit=51, after=after)

    return ask


def _in_context(archive: Archive, rng: random.Random) -> Any:
    context = archive.catalogue.contexts.named("all", OWNER)
    return archive.catalogue.psfs.page(PsfFilter(**_line(rng), context_id=context.id), OWNER, limit=51)


def _at(rng: random.Random) -> float:
    return rng.random() * 3 * YEAR_S


def _best(context: str) -> Question:
    return lambda archive, rng: psf_choice.look(
        archive.catalogue, PsfFilter(**_line(rng), valid_at=_at(rng)), OWNER, context
    )


def _interpolated(context: str | None) -> Question:
    """The variants of a channel, and the PSFs between which a time lies."""

    def ask(archive: Archive, rng: random.Random) -> Any:
        n = 2 * rng.randrange(LINES // 2)  # a series of total PSFs
        instrument, channel = f"instrument_{n // 10}", str(100 + n // 2 % 5)
        contexts, series = archive.catalogue.contexts, archive.catalogue.series
        context_id = None if context is None else contexts.named(context, OWNER).id
        variants = series.variants(instrument, channel, "total", OWNER, context_id)
        return variants, series.ends(f"{instrument}/{channel}/total", _at(rng), OWNER, context_id)

    return ask


def _none_fits(archive: Archive, rng: random.Random) -> Any:
    wanted = PsfFilter(**_line(rng), version="99.0.0")
    return psf_choice.look(archive.catalogue, wanted, OWNER, "now").emptied_by


def _affected(*, superseded: bool) -> Question:
    def ask(archive: Archive, rng: random.Random) -> Any:
        n = rng.randrange(archive.size.products)
        after = PageEnd(archive.psf_id(rng.randrange(archive.size.psfs)), 1e9 + n, archive.product_id(n))
        return archive.catalogue.affected.page(OWNER, superseded=superseded, limit=51, after=after)

    return ask


def _affected_by_much_used_psf(archive: Archive, rng: random.Random) -> Any:
    psf = archive.catalogue.get(PsfRow, archive.psf_id(3 * LINES), OWNER)
    assert psf is not None
    n = rng.randrange(archive.size.products)
    return archive.catalogue.affected.of_psf(psf, limit=51, after=(1e9 + n, archive.product_id(n)))


def _lineage(archive: Archive, rng: random.Random) -> Any:
    n = rng.randrange(archive.size.products)
    row = archive.catalogue.get(ProductRow, archive.product_id(n), OWNER)
    assert row is not None
    return lineage(archive.catalogue, row)


def _status(archive: Archive, rng: random.Random) -> Any:
    psfs = archive.catalogue.psfs
    row = archive.catalogue.get(PsfRow, archive.psf_id(rng.randrange(archive.size.psfs)), OWNER)
    assert row is not None and row.series is not None
    return psfs.changes(row.id, OWNER), psfs.released(row.series, OWNER)


# Every list and every look-up that the service answers from the catalogue, by name.
QUESTIONS: dict[str, Question] = {
    "products": _rows(ProductRow),
    "products, anywhere": partial(_products, deep=True),
    "products of a PSF": _products_of_psf,
    "products of a PSF that has very many": lambda archive, rng: _products(
        archive, rng, deep=True, psf_id=archive.psf_id(3 * LINES)
    ),
    "products of an image": _products_of_image,
    "products of no image": _rows(ProductRow, image_id="f" * 64),
    "a product's lineage": _lineage,
    "affected, all": _affected(superseded=False),
    "affected, superseded": _affected(superseded=True),
    "affected by a PSF that has very many": _affected_by_much_used_psf,
    "PSFs": _psfs(pick=lambda rng: {}),
    "PSFs, anywhere": _psfs(deep=True, pick=lambda rng: {}),
    "PSFs of an instrument": _psfs(deep=True, pick=_instrument),
    "PSFs of no instrument": _psfs(pick=lambda rng: {"instrument": "none"}),
    "PSFs of a channel": _psfs(pick=lambda rng: {"channel": str(100 + rng.randrange(5))}),
    "PSFs of a kind": _psfs(pick=lambda rng: {"kind": "diffraction"}),
    "PSFs of no kind": _psfs(pick=lambda rng: {"kind": "none"}),
    "PSFs of a name": _psfs(pick=lambda rng: {"name": f"psf {rng.randrange(1000)}"}),
    "PSFs of a version": _psfs(pick=lambda rng: {"version": f"1.{rng.randrange(50)}.0"}),
    "PSFs of no version": _psfs(pick=lambda rng: {"version": "99.0.0"}),
    "PSFs of a status": _psfs(deep=True, pick=lambda rng: {"status": "deprecated"}),
    "PSFs of a series": _psfs(pick=_line),
    "PSFs of a series, certified": _psfs(pick=lambda rng: {**_line(rng), "status": "certified"}),
    "PSFs of a series and a version": _psfs(pick=lambda rng: {**_line(rng), "version": "1.0.0"}),
    "PSFs of an instrument and no version": _psfs(pick=lambda rng: {**_instrument(rng), "version": "99.0.0"}),
    "PSFs valid at a time": _psfs(pick=lambda rng: {"valid_at": _at(rng)}),
    "PSFs of an instrument valid at a time": _psfs(
        pick=lambda rng: {**_instrument(rng), "valid_at": _at(rng)}
    ),
    "PSFs of a series in a context": _in_context,
    "the best PSF": _best("now"),
    "the best PSF in a context": _best("all"),
    "the ends of an interpolation": _interpolated(None),
    "the ends of an interpolation in a context": _interpolated("all"),
    "all series": lambda archive, rng: archive.catalogue.series.all(OWNER),
    "why none fits": _none_fits,
    "a PSF's status": _status,
    "contexts": _rows(PsfContextRow),
    "images": _rows(ImageRow),
    "transits": _rows(TransitRow),
    "reports": _rows(ReportRow),
    "reports of a transit": _rows(ReportRow, transit_id="1" * 64),
    "reports on reruns": _rows(ReportRow, about_id="1" * 64),
    "jobs": _rows(JobRow),
    "jobs of a phase": _rows(JobRow, phase="QUEUED"),
    "the default context": lambda archive, rng: archive.catalogue.contexts.default(OWNER),
    "moves of the default": lambda archive, rng: archive.catalogue.contexts.default_changes(OWNER),
    "UWS jobs": lambda archive, rng: archive.catalogue.uws.lines(last=50, owner=OWNER),
}


@contextmanager
def statements() -> Iterator[list[tuple[str, Any]]]:
    """What is sent to databases while the block runs."""
    sent: list[tuple[str, Any]] = []

    def note(_connection: Any, _cursor: Any, statement: str, parameters: Any, *_: Any) -> None:
        sent.append((statement, parameters))

    event.listen(Engine, "before_cursor_execute", note)
    try:
        yield sent
    finally:
        event.remove(Engine, "before_cursor_execute", note)


def plan(archive: Archive, statement: str, parameters: Any, *, forced: bool) -> list[str]:
    """The steps of a statement; forced: as if few rows were many."""
    with archive.engine.connect() as connection:
        if connection.dialect.name == "sqlite":
            rows = connection.exec_driver_sql(f"EXPLAIN QUERY PLAN {statement}", parameters).all()
            return [row[3] for row in rows]
        if forced:
            connection.exec_driver_sql("SET LOCAL enable_seqscan = off")
            # With few rows, a sort costs as much as an index that gives the order; without one, PostgreSQL still sorts.
            connection.exec_driver_sql("SET LOCAL enable_sort = off")
        return [row[0] for row in connection.exec_driver_sql(f"EXPLAIN {statement}", parameters)]
