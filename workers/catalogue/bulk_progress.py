"""The progress of bulk runs: numbers of images, images per hour, and results."""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from sqlalchemy import ColumnElement, SQLColumnExpression, exists, func, select, tuple_

from workers.catalogue.database import Queries, newest_first
from workers.catalogue.tables import BulkItemRow, BulkRow, ImageRow, ProductRow
from workers.contract.bulk import OPEN, ItemState

BATCH = 1000
MOST_EXPLAINED = 10_000  # failed images of a run that are read to count their reasons
# The pace is computed from the images of the last hour, but from 500 images at most.
PACE_S, PACE_IMAGES = 3600.0, 500


@dataclass(frozen=True)
class Pace:
    """The speed of a bulk run.

    Attributes
    ----------
    taken
        Number of images that workers process now.
    images_an_hour
        Number of images that ended per hour; None if not known.
    """

    taken: int
    images_an_hour: float | None


@dataclass(frozen=True)
class Reason:
    """The failed images of a run with the same error code.

    Attributes
    ----------
    images
        Number of these images.
    example
        The first of these images in the run.
    """

    code: str
    images: int
    example: BulkItemRow


class BulkProgress(Queries):
    """Queries of the tables of bulk runs."""

    def pace(self, bulk: BulkRow) -> Pace:
        """The speed of a run: the images that workers process now, and the images that ended per hour.

        The rate is computed from the last ``PACE_S`` seconds, or from the time since the run was last started or
        resumed if that is shorter; and from at most the last ``PACE_IMAGES`` images.
        """
        until = bulk.ended_at or time.time()
        since = max(bulk.running_since or bulk.created_at, until - PACE_S)
        ended = select(BulkItemRow.ended_at).where(
            BulkItemRow.bulk_id == bulk.id, BulkItemRow.ended_at >= since
        )
        last = ended.order_by(BulkItemRow.ended_at.desc()).limit(PACE_IMAGES).subquery()
        taken = select(func.count()).select_from(BulkItemRow)
        taken = taken.where(BulkItemRow.bulk_id == bulk.id, BulkItemRow.state == ItemState.TAKEN)
        with self._database.reading() as session:
            at_work = session.scalar(taken) or 0
            count, first = session.execute(select(func.count(), func.min(last.c.ended_at))).one()
        if not count:
            return Pace(at_work, None)
        # With 500 images, the interval begins when the first of them ended, so the first image does not count.
        start, images = (first, count - 1) if count == PACE_IMAGES else (since, count)
        lasted = until - start
        return Pace(at_work, images * 3600.0 / lasted if lasted > 0 else None)

    def to_look_at(self, bulk_id: str, score: float) -> int:
        """Number of done images with an artefact score of ``score`` or more."""
        return self._database.count(BulkItemRow, BulkItemRow.bulk_id == bulk_id, BulkItemRow.score >= score)

    def items(
        self, bulk_id: str, state: ItemState, *, after: int = -1, limit: int = BATCH
    ) -> Sequence[BulkItemRow]:
        """Images in a state, in the order of the run, after position ``after``."""
        query = select(BulkItemRow).where(
            BulkItemRow.bulk_id == bulk_id, BulkItemRow.state == state, BulkItemRow.position > after
        )
        return self._database.all(query.order_by(BulkItemRow.position).limit(limit))

    def sources(self, bulk_id: str) -> frozenset[str]:
        """The paths of all files of a run."""
        query = select(BulkItemRow.source).where(
            BulkItemRow.bulk_id == bulk_id, BulkItemRow.uploaded.is_(False)
        )
        with self._database.reading() as session:
            return frozenset(session.scalars(query.execution_options(yield_per=BATCH)))

    def reasons(self, bulk_id: str) -> list[Reason]:
        """The errors of the first ``MOST_EXPLAINED`` failed images, grouped by error code; the most frequent code
        first.
        """
        failed = (BulkItemRow.bulk_id == bulk_id, BulkItemRow.state == ItemState.FAILED)
        code = BulkItemRow.error["code"].as_string().label("code")
        # PostgreSQL groups by a column of a subquery, but not by an expression with a parameter.
        first = select(code, BulkItemRow.position).where(*failed).order_by(BulkItemRow.position)
        one = first.limit(MOST_EXPLAINED).subquery()
        counted = select(one.c.code, func.count(), func.min(one.c.position)).group_by(one.c.code)
        with self._database.reading() as session:
            found = session.execute(counted).all()
            query = select(BulkItemRow).where(
                *failed, BulkItemRow.position.in_([first for *_, first in found])
            )
            examples = {row.position: row for row in session.scalars(query)}
        # If the run was retried between the two queries, an example may no longer be a failed image.
        reasons = [Reason(code, count, examples[first]) for code, count, first in found if first in examples]
        return sorted(reasons, key=lambda reason: (-reason.images, reason.code))

    def worst(
        self, bulk_id: str, *, after: tuple[float, int] | None = None, limit: int = BATCH
    ) -> Sequence[BulkItemRow]:
        """Done images, highest artefact score first, after ``after`` = (score, position)."""
        key = tuple_(BulkItemRow.score, BulkItemRow.position)
        query = select(BulkItemRow).where(BulkItemRow.bulk_id == bulk_id, BulkItemRow.score.is_not(None))
        if after is not None:
            query = query.where(key < after)
        order = (BulkItemRow.score.desc(), BulkItemRow.position.desc())
        return self._database.all(query.order_by(*order).limit(limit))

    def without_product(self, owner: str, limit: int) -> Sequence[str]:
        """Ids of the owner's newest uploaded images that have no product."""
        made = exists().where(ProductRow.owner == ImageRow.owner, ProductRow.image_id == ImageRow.id)
        query = select(ImageRow.id).where(ImageRow.owner == owner, ~made)
        return self._database.all(newest_first(query, (ImageRow.created_at, ImageRow.id), limit))

    def names_of_uploads(self, ids: Sequence[str], owner: str) -> dict[str, str]:
        """The file names of these uploaded images, by id. Images without a file name are left out."""
        query = select(ImageRow.id, ImageRow.filename).where(ImageRow.owner == owner, ImageRow.id.in_(ids))
        return {one: name for one, name in self._database.lines(query) if name}

    def done_before(self, owner: str, product_id: str, output: str) -> BulkItemRow | None:
        """A done image, from any bulk run of the owner, whose product ``product_id`` is in the file ``output``.

        None if there is no such image.
        """
        query = select(BulkItemRow).join(BulkRow, BulkRow.id == BulkItemRow.bulk_id)
        query = query.where(
            BulkItemRow.product_id == product_id,
            BulkItemRow.state == ItemState.DONE,
            BulkItemRow.output == output,
            BulkRow.owner == owner,
        )
        return self._database.first(query)

    def open_images(self) -> dict[str, int]:
        """Numbers of images in all bulk runs that have not ended: images left, done and failed."""
        left = BulkRow.total - BulkRow.done - BulkRow.failed
        counts = {"left": left, "done": BulkRow.done, "failed": BulkRow.failed}
        return self._sums(counts, BulkRow.phase.in_(sorted(OPEN)))

    def ended_images(self) -> dict[str, int]:
        """Numbers of images in all bulk runs: deconvolved, reused (their products existed before), and failed."""
        deconvolved = BulkRow.done - BulkRow.reused
        return self._sums({"deconvolved": deconvolved, "reused": BulkRow.reused, "failed": BulkRow.failed})

    def _sums(
        self, counts: Mapping[str, SQLColumnExpression[int]], *conditions: ColumnElement[bool]
    ) -> dict[str, int]:
        """The sum of each count over the runs that meet the conditions."""
        query = select(*(func.coalesce(func.sum(one), 0) for one in counts.values())).where(*conditions)
        (sums,) = self._database.lines(query)
        return dict(zip(counts, map(int, sums), strict=True))

    def image_times(self, limit: int) -> list[tuple[float, float]]:
        """Estimated and measured time of the newest images that bulk runs deconvolved, s. Only the newest such run is
        read.
        """
        newest = select(BulkRow.id).where(BulkRow.done > BulkRow.reused).order_by(BulkRow.created_at.desc())
        query = select(BulkItemRow.statistics).where(
            BulkItemRow.bulk_id == newest.limit(1).scalar_subquery(),
            BulkItemRow.state == ItemState.DONE,
            BulkItemRow.reused.is_(False),
        )
        found = self._database.all(query.order_by(BulkItemRow.ended_at.desc()).limit(limit))
        return [(one["start_s"], one["seconds"]) for one in found if one and "start_s" in one]
