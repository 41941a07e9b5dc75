"""One owner's many jobs and another's single one, with a real broker and a real worker."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.whole.stack import Missing, served, wait_for
from workers.catalogue.catalogue import Catalogue
from workers.catalogue.tables import JobRow
from workers.contract.phases import Phase
from workers.settings import Settings


def test_the_single_job_of_one_owner_does_not_wait_for_the_forty_of_another(tmp_path: Path) -> None:
    try:
        with served(tmp_path, workers=0) as stack:
            catalogue = Catalogue(
                Settings(database_url=stack.environment["HELIOPSF_DATABASE_URL"]).catalogue_url
            )
            # Jobs that end at once: their PSF does not exist.
            for owner, count in (("many", 40), ("one", 1)):
                for number in range(count):
                    wanted = {"psf_id": f"{number:064x}"}
                    catalogue.jobs.submit("psf-tables", wanted, f"{owner} {number}", owner)
            wait_for(lambda: not catalogue.jobs.unsubmitted(3600.0), "the broker has all jobs")
            stack.start_worker()
            jobs = [
                *catalogue.page(JobRow, owner="many", limit=50),
                *catalogue.page(JobRow, owner="one", limit=50),
            ]

            def all_ended() -> bool:
                found = [catalogue.jobs.get(job.id) for job in jobs]
                return all(row is not None and Phase(row.phase).ended for row in found)

            wait_for(all_ended, "all jobs end")
            starts = sorted(
                (row.started_at or 0.0, row.owner)
                for owner in ("many", "one")
                for row in catalogue.page(JobRow, owner=owner, limit=50)
            )
            catalogue.close()
    except Missing as missing:
        pytest.skip(str(missing))
    assert len(starts) == 41
    assert "one" in [owner for _, owner in starts[:2]]
