"""What a day of AIA and its fifteen years cost, what breaks first, and how the queue bears faults: the tables of docs/scale.md.

    python -m studies.scale [--measure] [--write]

The time of an image comes from ``docs/growth/measured.json``. ``--measure`` counts the SQL statements of a small bulk run, and
measures the bytes of its rows and the time of queries on many rows, in PostgreSQL; it keeps them in ``docs/growth/scale.json``.
The run takes a minute and has images of 64 px, because these figures do not depend on the size of the images. ``--write``
simulates the queue, and writes the tables into the page. All numbers follow from these figures and from the code.
"""

from __future__ import annotations

import argparse
import heapq
import json
import math
import os
import tempfile
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from random import Random
from typing import Any

from sqlalchemy import Engine, event, func, insert, select, text

from benchmarks.figures import with_part
from benchmarks.timing import seconds
from workers.bulk.dry_run import product_bytes
from workers.bulk.listing import MOST_IMAGES
from workers.bulk.runs import KIND, MOST_TURNS, begin, keep_turns
from workers.bulk.task import TELL_EVERY_S
from workers.contract.bulk import AT_WORK, BulkRequest
from workers.contract.jobs import Queue
from workers.machine import cores
from workers.settings import Settings

DOCS = Path(__file__).parents[1] / "docs"
GROWTH, MEASURED, PAGE = DOCS / "growth" / "measured.json", DOCS / "growth" / "scale.json", DOCS / "scale.md"
PX, DAY_S, YEARS = 4096, 86_400.0, 15
DAY_IMAGES = 57_600  # eight every 12 s
MISSION_IMAGES = round(DAY_IMAGES * 365.25 * YEARS)
INPUT_BYTES = 2 * PX**2  # integers of 16 bits, not compressed
FOLDERS = 256  # folders of the store
SCRAPE_S = 10.0  # the default time limit of Prometheus for /metrics
SLOW_S, SLOW = 600.0, 0.1  # a slow store has a tenth of its bandwidth in the first ten minutes of each hour
FEW, MANY, COPIES = 4, 20, 50_000  # images of the two small runs, and copies of their rows
ROUNDS = 5  # a query is timed so often: other programs may use the machine


@dataclass(frozen=True)
class Costs:
    """What an image of 4096 px costs: time on one core (s); SQL statements; bytes in the database; the time for which a
    transaction locks the row of the run (s); seconds that /metrics and a quota take for each product."""

    core_s: float
    statements: float
    row_bytes: float
    finish_s: float
    metrics_s: float
    quota_s: float

    @classmethod
    def stored(cls) -> Costs:
        """The costs by the stored figures."""
        growth, found = json.loads(GROWTH.read_text("utf-8")), json.loads(MEASURED.read_text("utf-8"))
        (one,) = (point for point in growth["workers"]["points"] if point["n"] == 1)  # images of 1024 px
        core_s = one["seconds"] * (PX / 1024) ** growth["image"]["exponents"]["seconds"]
        # A running job reports its progress, looks for a short job that waits, and sends heartbeats.
        running = core_s * (2 / TELL_EVERY_S + 1 / Settings.model_fields["heartbeat_s"].default)
        names = ("row_bytes", "finish_s", "metrics_s", "quota_s")
        return cls(core_s, found["statements"] + running, **{name: found[name] for name in names})

    @property
    def product_bytes(self) -> int:
        """Bytes of a product's file."""
        return product_bytes((PX, PX), 0)

    @property
    def moved_bytes(self) -> int:
        """Bytes that an image moves from and to the store."""
        return INPUT_BYTES + self.product_bytes


@dataclass(frozen=True)
class Case:
    """A queue to simulate. arrivals: times of the images, s. kill_s: mean time until a worker is killed, s. bandwidth: of the
    store that all workers share, bytes/s. slow: whether the store is slow for a part of each hour. Times after which a lost
    image is taken again and a killed worker is back: again_s, back_s."""

    workers: int
    arrivals: Sequence[float]
    kill_s: float = math.inf
    bandwidth: float = 1e9
    slow: bool = False
    again_s: float = 15.0
    back_s: float = 60.0
    seed: int = 0


@dataclass
class Outcome:
    """The waiting time of each image from its arrival to its product, s; the end of the last one, s; the images that were lost
    and computed again."""

    waits_s: list[float] = field(default_factory=list)
    ended_s: float = 0.0
    lost: int = 0

    @property
    def p95_s(self) -> float:
        """The time within which 95 % of the images end, s."""
        return sorted(self.waits_s)[math.ceil(0.95 * len(self.waits_s)) - 1]


def simulated(case: Case, costs: Costs) -> Outcome:
    """Workers of one core that take images from a queue, read them ahead from a shared store, and compute them.

    An image whose worker is killed goes back into the queue. Each end locks the row of the run, one after the other; a run
    has at most ``MOST_TURNS`` workers.
    """
    chance, outcome = Random(case.seed), Outcome()

    def lives_s() -> float:
        return chance.expovariate(1 / case.kill_s) if math.isfinite(case.kill_s) else math.inf

    waiting = [(arrived, arrived) for arrived in case.arrivals]
    free = [(0.0, number, lives_s()) for number in range(case.workers)]  # free at, worker, killed at
    began = [0.0] * case.workers
    store_s, rows_s = 0.0, [0.0] * math.ceil(case.workers / MOST_TURNS)
    heapq.heapify(waiting)
    heapq.heapify(free)
    while waiting:
        ready, arrived = heapq.heappop(waiting)
        free_at, worker, killed = heapq.heappop(free)
        read_at = max(store_s, ready, began[worker])  # the worker asks when it begins the image before
        bandwidth = case.bandwidth * (SLOW if case.slow and read_at % 3600.0 < SLOW_S else 1.0)
        store_s = read_at + costs.moved_bytes / bandwidth
        start = began[worker] = max(ready, free_at, store_s)
        end = start + costs.core_s
        if killed < end:
            outcome.lost += killed > start
            back_at = max(killed, free_at) + case.back_s
            heapq.heappush(waiting, (max(killed, ready) + case.again_s, arrived))
            heapq.heappush(free, (back_at, worker, back_at + lives_s()))
            began[worker] = back_at
            continue
        run = worker // MOST_TURNS
        rows_s[run] = max(rows_s[run], end) + costs.finish_s
        outcome.waits_s.append(rows_s[run] - arrived)
        outcome.ended_s = max(outcome.ended_s, rows_s[run])
        heapq.heappush(free, (rows_s[run], worker, killed))
    return outcome


def measure() -> dict[str, Any]:
    """Statements of an image, bytes of its rows and times of queries, measured in PostgreSQL. Raises Missing."""
    from tests.conftest import write_image, write_psf
    from tests.in_process import InProcess
    from tests.whole.stack import postgres_database
    from tests.workers.databases import database
    from tests.workers.jobs import bulk_row
    from workers.catalogue.tables import DEFAULT_OWNER, BulkItemRow, BulkRow, ProductRow
    from workers.run.runner import Runner

    counted = {"statements": 0}

    @event.listens_for(Engine, "before_cursor_execute")
    def count(*_: Any) -> None:
        counted["statements"] += 1

    with tempfile.TemporaryDirectory() as temporary, postgres_database() as url:
        folder = Path(temporary)
        settings = Settings(
            data_dir=folder / "data", database_url=url, bulk_roots=str(folder), worker_threads=1
        )
        service = InProcess(settings)
        catalogue = service.catalogue
        write_psf(folder / "psf.fits")
        psf_id, spent = service.upload_psf(folder / "psf.fits")["id"], {}
        for name, images in (("first", 1), ("few", FEW), ("many", MANY)):  # the first one compiles kernels
            (folder / name).mkdir()
            for number in range(images):
                write_image(folder / name / f"{number}.fits", shape=(64, 64), seed=100 * images + number)
            request = {"files": [{"glob": f"{folder}/{name}/*.fits"}], "psf_id": psf_id}
            bulk, _ = begin(BulkRequest.model_validate(request), catalogue, DEFAULT_OWNER, settings)
            keep_turns(catalogue, settings)
            counted["statements"] = 0
            (turn,) = (job for job in catalogue.jobs.of_kind(KIND) if job.parameters["bulk_id"] == bulk.id)
            run: BulkRow | None = bulk
            while run is not None and run.phase in AT_WORK:  # a long turn is handed back
                Runner(settings, catalogue, service.store).run_next(turn.id, Queue(turn.queue))
                run = catalogue.bulks.get(bulk.id)
            spent[name] = counted["statements"]
            assert run is not None and run.done == images, (run.done, run.failed, run.error)
        engine, row_bytes = database(catalogue).engine, 0.0
        with engine.begin() as connection:
            for row, key in ((ProductRow, "id"), (BulkItemRow, "position")):
                table = row.__table__
                one = dict(connection.execute(select(table).limit(1)).one()._mapping)
                copies = [one | {key: f"{n:064x}" if key == "id" else 1000 + n} for n in range(COPIES)]
                connection.execute(insert(table), copies)
                size = select(func.pg_total_relation_size(text(f"'{table.name}'")))
                row_bytes += connection.execute(size).scalar_one() / COPIES
        with engine.connect().execution_options(isolation_level="AUTOCOMMIT") as connection:
            connection.execute(text("VACUUM ANALYZE"))
        catalogue.owners.set_quota(DEFAULT_OWNER, 2**30)
        metrics_s = seconds(catalogue.census.tally_files, ROUNDS) / COPIES
        quota_s = seconds(lambda: catalogue.owners.limited(DEFAULT_OWNER, 0), ROUNDS) / COPIES
        catalogue.bulks.create(bulk_row("timed"), [])
        loop = (
            "FOR n IN 1..200 LOOP UPDATE bulks SET done = done + 1 WHERE phase = 'RUNNING'; COMMIT; END LOOP"
        )
        with engine.connect().execution_options(isolation_level="AUTOCOMMIT") as connection:
            finish_s = seconds(lambda: connection.execute(text(f"DO $$ BEGIN {loop}; END $$")), ROUNDS) / 200
        service.close()
    return {
        "statements": (spent["many"] - spent["few"]) / (MANY - FEW),
        "row_bytes": row_bytes,
        "finish_s": finish_s,
        "metrics_s": metrics_s,
        "quota_s": quota_s,
        "machine": f"{cores()} cores, {time.strftime('%Y-%m-%d')}, load {os.getloadavg()[2]:.0f} in the last 15 minutes",
    }


def breaking(costs: Costs, bandwidth: float) -> list[tuple[float, str]]:
    """What breaks, by the number of products or the number of workers, smallest first: the number with its unit, what happens."""
    products = [
        (MOST_IMAGES, "a bulk run takes no more images: split the archive into several runs"),
        (
            costs.core_s / costs.quota_s,
            "with a quota, its check takes as long as a deconvolution: give archives none",
        ),
        (
            SCRAPE_S / costs.metrics_s,
            "`/metrics` takes longer than Prometheus waits: scrape less often, wait longer",
        ),
        (
            1e6 * FOLDERS / 2,
            "a folder of the store has a million files: keep files in S3, or use `--output` with `--only`",
        ),
        (
            2.0**51 / costs.product_bytes,
            "a quota cannot be larger (2^31 MiB): give archives none, or an owner for each year",
        ),
        (1e12 / costs.row_bytes, "the tables have a terabyte: use `--only`, and delete runs that are done"),
    ]
    workers = [
        (
            bandwidth / costs.moved_bytes * costs.core_s,
            f"the store moves {bandwidth / 1e9:g} GB/s, and all wait for it: a faster store",
        ),
        (MOST_TURNS, "a run has no more turns: split the archive into several runs"),
        (
            costs.core_s / costs.finish_s,
            "the row of a run is always locked: not reached, because a run has fewer workers",
        ),
    ]
    return [
        (number, f"{unit} | {what}")
        for unit, rows in (("products", products), ("workers of one core", workers))
        for number, what in sorted(rows)
    ]  # fmt: skip


def tables(costs: Costs) -> Iterator[str]:
    """The lines of the tables of the page."""
    bandwidth = Case(1, ()).bandwidth
    yield "| | a day | fifteen years |"
    yield "|---|---|---|"
    for name, of_one, form in (
        ("images", 1.0, "{:,.0f}"),
        ("core hours", costs.core_s / 3600, "{:,.0f}"),
        ("read (TB)", INPUT_BYTES / 1e12, "{:,.1f}"),
        ("products (TB)", costs.product_bytes / 1e12, "{:,.1f}"),
        ("rows", 2.0, "{:,.0f}"),
        ("tables of PostgreSQL (GB)", costs.row_bytes / 1e9, "{:,.2f}"),
        ("SQL statements", costs.statements, "{:,.0f}"),
        ("HTTP requests if every image is uploaded, submitted, waited for and downloaded", 4.0, "{:,.0f}"),
    ):
        yield f"| {name} | {form.format(DAY_IMAGES * of_one)} | {form.format(MISSION_IMAGES * of_one)} |"
    keep_up, year = DAY_IMAGES / DAY_S * costs.core_s, MISSION_IMAGES / (365.25 * DAY_S) * costs.core_s
    yield f"| cores to keep up with the Sun; to do it in a year | {keep_up:,.0f} | {year:,.0f} |"
    yield f"| SQL statements per second meanwhile | {keep_up * costs.statements / costs.core_s:,.0f} | {year * costs.statements / costs.core_s:,.0f} |"
    yield ""
    yield "| at | of | this breaks: what to do |"
    yield "|---|---|---|"
    for number, what in breaking(costs, bandwidth):
        yield f"| {number:,.0f} | {what} |"
    yield ""
    yield "| a day of AIA | workers | 95 % of the products after | computed again |"
    yield "|---|---|---|---|"
    steady = [n * DAY_S / DAY_IMAGES for n in range(DAY_IMAGES)]
    four = [math.ceil(at / (DAY_S / 4)) * DAY_S / 4 for at in steady]
    many = math.ceil(1.25 * keep_up)
    for name, workers, arrivals, kill_s, slow in (
        ("images arrive evenly", math.ceil(1.05 * keep_up), steady, math.inf, False),
        ("evenly", many, steady, math.inf, False),
        ("evenly, each worker is killed every hour", many, steady, 3600.0, False),
        ("evenly, slow store", many, steady, math.inf, True),
        ("four times a day", many, four, math.inf, False),
        ("four times a day, kills, slow store", many, four, 3600.0, True),
        ("four times a day, kills, slow store", 4 * many, four, 3600.0, True),
    ):
        found = simulated(Case(workers, arrivals, kill_s, bandwidth, slow), costs)
        yield f"| {name} | {workers} | {found.p95_s / 60:,.1f} min | {100 * found.lost / DAY_IMAGES:.1f} % |"
    yield ""
    yield "| fifteen years, workers | images per hour | of what as many single workers do |"
    yield "|---|---|---|"
    for workers in (10, 100, 300, 1000, 3000):
        images = 20 * workers
        rate = images / simulated(Case(workers, [0.0] * images, 86_400.0, bandwidth), costs).ended_s
        yield f"| {workers:,} | {3600 * rate:,.0f} | {100 * rate * costs.core_s / workers:.0f} % |"


def written(page: str, costs: Costs) -> str:
    """The page with new tables."""
    return with_part(page, "studies.scale", "\n".join(tables(costs)))


def main() -> None:
    """The command line."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--measure", action="store_true", help="measure again, in PostgreSQL")
    parser.add_argument("--write", action="store_true", help="write the tables into docs/scale.md")
    asked = parser.parse_args()
    if asked.measure:
        MEASURED.write_text(json.dumps(measure(), indent=1) + "\n", "utf-8")
    costs = Costs.stored()
    if asked.write:
        PAGE.write_text(written(PAGE.read_text("utf-8"), costs), "utf-8")
    else:
        print("\n".join(tables(costs)))


if __name__ == "__main__":
    main()
