"""Progress as server-sent events: of one job or bulk run from a running server; and all jobs and bulk runs of an owner
in one stream, what each look tells, and the stream over HTTP."""

from __future__ import annotations

import asyncio
import json
import time
from collections.abc import Callable, Iterator
from functools import partial
from itertools import groupby
from typing import Any

import httpx
import pytest
from fastapi.testclient import TestClient
from sqlalchemy import Engine, event, update
from sqlalchemy.exc import OperationalError

from service.api import events
from service.api.bulk import BulkLine
from service.client.http import ServiceError
from service.http import lookout
from service.http.callers import Caller
from service.http.lookout import Follower, Lookout, OwnerFollower, StreamKind
from service.views import JobView
from tests.service.conftest import execute, refusal
from tests.service.keyed import bearer, keyed
from tests.service.serving import Following, Live, in_own_loop, running
from tests.whole.stack import wait_for
from workers.catalogue import changes
from workers.catalogue.bulks import new_id
from workers.catalogue.catalogue import Catalogue
from workers.catalogue.jobs import Lease
from workers.catalogue.tables import DEFAULT_OWNER, BulkRow, JobRow, KeyRow
from workers.contract.bulk import BulkPhase
from workers.settings import Settings

CALLER = Caller(DEFAULT_OWNER, frozenset(), "key", DEFAULT_OWNER)


@pytest.fixture
def live(settings: Settings, monkeypatch: pytest.MonkeyPatch) -> Iterator[Live]:
    monkeypatch.setattr(lookout, "LOOK_EVERY_S", 0.05)
    with running(settings.model_copy(update={"streams_per_caller": 2})) as server:
        yield server


def test_a_reconnected_client_gets_what_changed_meanwhile(live: Live) -> None:
    job_id, lease = live.job()
    first = Following(f"{live.url}/v1/jobs/{job_id}/events")
    first.await_lines("id:", 1)
    assert first.type.startswith("text/event-stream") and first.said("retry:") == ["2000"]
    knows = {"Last-Event-ID": first.said("id:")[0]}
    second = Following(f"{live.url}/v1/jobs/{job_id}/events", **knows)
    time.sleep(0.4)
    assert second.said("event:") == [], "it knows what there is to know"
    live.catalogue.jobs.complete(lease, "r" * 64)
    second.join(10), first.join(10)
    assert second.said("event:") == ["end"] and first.said("event:") == ["progress", "end"]
    again = httpx.get(f"{live.url}/v1/jobs/{job_id}/events", headers=knows)
    assert again.status_code == 200 and "event: end" in again.text
    ended = {"Last-Event-ID": second.said("id:")[0]}
    assert httpx.get(f"{live.url}/v1/jobs/{job_id}/events", headers=ended).status_code == 204


def test_an_idle_stream_sends_comments_and_a_closed_connection_frees_its_stream(
    live: Live, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(events, "ALIVE_EVERY_S", 0.1)
    (job_id, lease), (other_id, _) = live.job(), live.job()
    following = Following(f"{live.url}/v1/jobs/{job_id}/events")
    following.await_lines(": still here", 3)
    with httpx.stream("GET", f"{live.url}/v1/jobs/{other_id}/events") as answer:
        lines = answer.iter_lines()  # let go of, it would close the connection
        next(lines)
        assert live.streams() == 2
        for address in ("/v1/events", f"/v1/jobs/{job_id}/events"):
            with httpx.stream("GET", f"{live.url}{address}") as answer:
                assert answer.status_code == 429  # the body of an accepted stream would never end
                answer.read()
                refusal(answer, 429, "too-many-streams")
    wait_for(lambda: live.streams() == 1, "the place is free", timeout_s=10)
    live.catalogue.jobs.complete(lease, "r" * 64)
    following.join(10)
    assert following.said("event:") == ["progress", "end"]
    lookouts = live.app.state.heliopsf.lookouts
    wait_for(lambda: not lookouts, "nobody looks for an owner without streams", timeout_s=10)


def test_a_job_that_is_destroyed_and_a_server_that_stops_end_their_streams(live: Live) -> None:
    (job_id, _), (other_id, _) = live.job(), live.job()
    both = [Following(f"{live.url}/v1/jobs/{one}/events") for one in (job_id, other_id)]
    for one in both:
        one.await_lines("event:", 1)
    live.catalogue.uws.destroy(job_id)
    both[0].join(10)
    assert both[0].said("event:") == ["progress", "gone"]
    with pytest.raises(ServiceError, match="expected the id of one of your jobs"):
        list(live.client.follow(f"/v1/jobs/{job_id}"))
    live.app.state.stopping = True
    both[1].join(10)
    assert not both[1].is_alive() and both[1].said("event:") == ["progress"]


def test_a_stream_ends_with_its_key(settings: Settings, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(lookout, "LOOK_EVERY_S", 0.02)
    with keyed(settings, stream_s=10.0) as service:  # guards against a hang
        for how, change in (("revoked", {"revoked_at": 1.0}), ("expired", {"expires_at": 1.0})):
            key = service.key("ann")
            job, _ = service.catalogue.jobs.submit("psf-build", {}, how, "ann")
            end = update(KeyRow).where(KeyRow.id == key.split("_")[1]).values(**change)
            read, looks = service.catalogue.job_changes.among, []

            def look(*ids: Any, read: Any = read, looks: list[Any] = looks, end: Any = end) -> Any:
                looks.append(ids)
                if len(looks) == 5:  # the stream is open and has sent an event
                    execute(service.catalogue, end)
                return read(*ids)

            with monkeypatch.context() as patched:
                patched.setattr(service.catalogue.job_changes, "among", look)
                said = service.api.get(f"/v1/jobs/{job.id}/events", headers=bearer(key))
            assert said.status_code == 200 and len(looks) >= 5
            assert said.text.count("event: progress") == 1 and "event: end" not in said.text
            refused = service.api.get(f"/v1/jobs/{job.id}/events", headers=bearer(key))
            refusal(refused, 401, f"key-{how}")


# All jobs and bulk runs of an owner ------------------------------------------------------------------


@pytest.fixture
def catalogue(settings: Settings) -> Iterator[Catalogue]:
    settings.data_dir.mkdir(exist_ok=True)
    catalogue = Catalogue(settings.catalogue_url)
    catalogue.upgrade()
    yield catalogue
    catalogue.close()


def lookout_of(
    catalogue: Catalogue, kind: str = "job", let_in: Callable[[Any], bool] = lambda _: True
) -> Lookout:
    """For the jobs or the bulk runs of the owner."""
    jobs = StreamKind("job", catalogue.job_changes, JobView.of)
    bulks = StreamKind("bulk", catalogue.bulk_changes, BulkLine.model_validate)
    return Lookout(DEFAULT_OWNER, [jobs if kind == "job" else bulks], catalogue.clock, let_in)


def follower_of(*named: str, kind: str = "job", since: float | None = None) -> OwnerFollower:
    """A stream of all jobs or bulk runs of the owner."""
    after = None if since is None else [(since, "")]
    return OwnerFollower(CALLER, [(kind, one) for one in named], after)


class Looks:
    """The news of one look after the other, as (name of the event, data)."""

    def __init__(
        self, catalogue: Catalogue, *named: str, kind: str = "job", since: float | None = None
    ) -> None:
        self.lookout = lookout_of(catalogue, kind)
        self.follower = follower_of(*named, kind=kind, since=since)

    def told(self) -> list[tuple[str, dict[str, Any]]]:
        text, _ = self.lookout.look_for(self.follower)
        return [_parsed(block) for block in text.split("\n\n") if "event: " in block]

    def phases(self) -> list[tuple[str, str]]:
        return [(data["id"], data.get("phase", name)) for name, data in self.told()]


def _parsed(text: str) -> tuple[str, dict[str, Any]]:
    lines = dict(line.split(": ", 1) for line in text.splitlines() if line)
    return lines["event"], json.loads(lines["data"])


def submitted(catalogue: Catalogue, owner: str = DEFAULT_OWNER, kind: str = "psf-build") -> str:
    return catalogue.jobs.submit(kind, {"bulk_id": "b"}, new_id(), owner)[0].id


def claimed(catalogue: Catalogue, job_id: str) -> Lease:
    lease = catalogue.jobs.claim(job_id, "w")
    assert lease is not None
    return lease


def ended_long_ago(catalogue: Catalogue, job_id: str, ago_s: float = 3600.0) -> float:
    """Complete a job and let its end lie in the past; returns that time."""
    at = time.time() - ago_s
    catalogue.jobs.complete(claimed(catalogue, job_id), "r" * 64)
    execute(catalogue, update(JobRow).where(JobRow.id == job_id).values(ended_at=at, changed_at=at))
    return at


def bulk_run(catalogue: Catalogue, owner: str = DEFAULT_OWNER) -> str:
    row = BulkRow(
        id=new_id(), owner=owner, name="", phase=BulkPhase.RUNNING, request={}, request_key=new_id(),
        psf_id="p" * 64, created_at=time.time(), running_since=time.time(), listed=True,
    )  # fmt: skip
    return catalogue.bulks.create(row, ["a" * 64, "b" * 64])[0].id


def test_a_job_is_told_when_it_is_new_changes_and_ends(catalogue: Catalogue) -> None:
    looks = Looks(catalogue)
    assert looks.told() == []
    job_id = submitted(catalogue)
    assert looks.phases() == [(job_id, "QUEUED")] and looks.told() == []
    lease = claimed(catalogue, job_id)
    assert looks.phases() == [(job_id, "EXECUTING")]
    catalogue.jobs.progress(lease, "building", 1, 2)
    ((name, data),) = looks.told()
    row = catalogue.jobs.get(job_id)
    assert row is not None and name == "job" and data["progress"]["stage"] == "building"
    catalogue.jobs.heartbeat(lease)
    assert looks.told() == [], "a heartbeat is no news"
    catalogue.jobs.complete(lease, "r" * 64)
    assert looks.phases() == [(job_id, "COMPLETED")] and looks.told() == [] == looks.told()


def test_ends_that_no_look_saw_coming_are_told_once(catalogue: Catalogue) -> None:
    looks = Looks(catalogue)
    looks.told()
    quick = submitted(catalogue)
    catalogue.jobs.complete(claimed(catalogue, quick), "r" * 64)
    assert looks.phases() == [(quick, "COMPLETED")] and looks.told() == [], "between two looks"
    assert catalogue.jobs.reopen(quick)
    assert looks.phases() == [(quick, "QUEUED")], "it runs again"
    catalogue.jobs.complete(claimed(catalogue, quick), "r" * 64)
    assert looks.phases() == [(quick, "COMPLETED")]
    late = submitted(catalogue)
    assert looks.phases() == [(late, "QUEUED")]
    ended_long_ago(catalogue, late)
    assert looks.phases() == [(late, "COMPLETED")] and looks.told() == [], "clocks do not matter"
    deleted = submitted(catalogue)
    looks.told()
    catalogue.uws.destroy(deleted)
    assert looks.told() == [("gone", {"kind": "job", "id": deleted})] and looks.told() == []


def test_a_bulk_run_that_ended_some_time_ago_is_followed_until_it_is_deleted(
    catalogue: Catalogue, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(lookout, "OVERLAP_S", 0.0)
    monkeypatch.setattr(lookout, "MOST_KNOWN", 2)
    runs = [bulk_run(catalogue) for _ in range(3)]
    before = bulk_run(catalogue)
    catalogue.bulks.cancel(before)
    time.sleep(0.01)
    looks = Looks(catalogue, kind="bulk")
    looks.told()
    for run in runs:
        catalogue.bulks.cancel(run)
        time.sleep(0.01)
        assert looks.phases() == [(run, "CANCELLED")]
    assert looks.told() == []
    assert {one for _, one in looks.follower.known} == set(runs[1:]), "the two that ended last"
    for run in (before, *runs):
        assert catalogue.bulks.delete(run)
    assert sorted(looks.phases()) == sorted((run, "gone") for run in runs[1:])
    assert looks.told() == []
    assert Looks(catalogue, before, kind="bulk").phases() == [(before, "gone")], "as a name that nothing has"


def test_other_owners_and_turns_of_bulk_runs_are_not_told(catalogue: Catalogue) -> None:
    theirs, turn = submitted(catalogue, "bob"), submitted(catalogue, kind="bulk")
    looks = Looks(catalogue, theirs)
    assert looks.phases() == [(theirs, "gone")], "as if there were no such job"
    for job_id in (theirs, turn):
        catalogue.jobs.complete(claimed(catalogue, job_id), "r" * 64)
    assert looks.told() == []


def test_ends_since_a_time_come_in_pages_that_lose_none(
    catalogue: Catalogue, monkeypatch: pytest.MonkeyPatch
) -> None:
    for module in (changes, lookout):
        monkeypatch.setattr(module, "MOST", 3)
    ids = [submitted(catalogue) for _ in range(10)]
    at = time.time() - 3600.0
    for number, job_id in enumerate(ids):  # several ended at the same moment
        ended_long_ago(catalogue, job_id)
        ended = update(JobRow).where(JobRow.id == job_id).values(changed_at=at + number // 4)
        execute(catalogue, ended)
    looks = Looks(catalogue, since=at - 1)
    pages = [looks.phases() for _ in range(6)]
    assert [len(page) for page in pages] == [3, 3, 3, 1, 0, 0]
    assert sorted(job_id for page in pages for job_id, _ in page) == sorted(ids)


def test_of_very_many_waiting_jobs_the_newest_are_told_and_every_end(
    catalogue: Catalogue, monkeypatch: pytest.MonkeyPatch
) -> None:
    for module in (changes, lookout):
        monkeypatch.setattr(module, "MOST", 3)
    ids = [submitted(catalogue) for _ in range(5)]
    execute(catalogue, update(JobRow).values(changed_at=time.time() - 3600.0))
    looks = Looks(catalogue)
    assert sorted(job_id for job_id, _ in looks.phases()) == sorted(ids[2:])
    lease = claimed(catalogue, ids[0])
    assert looks.phases() == [(ids[0], "EXECUTING")]
    catalogue.jobs.complete(lease, "r" * 64)
    catalogue.jobs.complete(claimed(catalogue, ids[1]), "r" * 64)
    assert sorted(looks.phases()) == sorted([(ids[0], "COMPLETED"), (ids[1], "COMPLETED")])


def test_many_jobs_need_as_few_queries_as_one(catalogue: Catalogue) -> None:
    statements: list[str] = []

    def count(_connection: Any, _cursor: Any, statement: str, *_: Any) -> None:
        if statement.startswith("SELECT"):
            statements.append(statement)

    event.listen(Engine, "before_cursor_execute", count)
    looks = Looks(catalogue)
    counts = []
    for many in (1, 50):
        ids = [submitted(catalogue) for _ in range(many)]
        statements.clear()
        assert sorted(job_id for job_id, _ in looks.phases()) == sorted(ids)
        counts.append(len(statements))
    assert counts == [4, 3]  # clock, changes, at first the open ones, and rows
    statements.clear()
    assert looks.told() == [] and len(statements) == 2
    event.remove(Engine, "before_cursor_execute", count)


def test_all_streams_of_an_owner_need_as_few_queries_as_one(
    catalogue: Catalogue, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(lookout, "LOOK_EVERY_S", 0.5)  # all looks below fall into one
    ids = [submitted(catalogue) for _ in range(20)]
    statements: list[str] = []

    def count(_connection: Any, _cursor: Any, statement: str, *_: Any) -> None:
        if statement.startswith("SELECT"):
            statements.append(statement)

    async def queries(many: int) -> int:
        seen = lookout_of(catalogue, let_in=lambda caller: catalogue.keys.is_good(caller.name) or True)
        followers: list[Follower] = [follower_of() for _ in range(many)]
        followers += [Follower(CALLER, {("job", one): ""}) for one in ids[:many]]
        assert all([(await seen.next(one))[0] for one in followers])
        statements.clear()
        assert {await seen.next(one) for one in followers} == {("", False)}
        return len(statements)

    event.listen(Engine, "before_cursor_execute", count)
    try:
        counts = [in_own_loop(partial(queries, many)) for many in (1, 20)]
        assert counts == [3, 3]  # key, clock and changes
    finally:
        event.remove(Engine, "before_cursor_execute", count)


def test_a_stream_that_comes_later_knows_all_and_takes_nothing_from_the_others(
    catalogue: Catalogue, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(lookout, "LOOK_EVERY_S", 0.05)
    long_ago = submitted(catalogue)
    ended_long_ago(catalogue, long_ago)

    async def follow() -> None:
        seen, first = lookout_of(catalogue), follower_of()

        async def until(follower: Follower, *expected: str) -> list[tuple[str, str]]:
            """The events for jobs, up to one that contains these texts."""
            told = ""
            while not all(text in told for text in expected):
                told += (await seen.next(follower))[0]
            events = [_parsed(block) for block in told.split("\n\n") if "event: " in block]
            return [(data["id"], data.get("phase", name)) for name, data in events]

        await until(first, "id: ")
        fresh = submitted(catalogue)
        later = follower_of(long_ago)
        told = await until(later, "id: ")
        assert told == [(long_ago, "COMPLETED"), (fresh, "QUEUED")]
        assert await until(first, fresh) == [(fresh, "QUEUED")], "its end was not known to the first"
        catalogue.uws.destroy(long_ago)
        assert (long_ago, "gone") in await until(later, "gone")
        catalogue.jobs.complete(claimed(catalogue, fresh), "r" * 64)
        for one in (first, later):
            assert (fresh, "COMPLETED") in await until(one, "COMPLETED")
        for _ in range(lookout.MOST_UNREAD + 2):
            fresh = submitted(catalogue)
            await until(later, fresh)
        last = await seen.next(first)
        assert last == ("", True), "who does not read is ended and asks again from its last id"

    in_own_loop(lambda: asyncio.wait_for(follow(), 60))


def test_a_look_that_fails_loses_nothing(catalogue: Catalogue, monkeypatch: pytest.MonkeyPatch) -> None:
    looks = Looks(catalogue)
    job_id = submitted(catalogue)

    def away(*_: Any) -> None:
        raise OperationalError("SELECT", {}, Exception("the database is away"))

    with monkeypatch.context() as broken:
        broken.setattr(catalogue.job_changes, "rows", away)
        with pytest.raises(OperationalError):
            looks.told()
    assert looks.phases() == [(job_id, "QUEUED")]


def test_a_stream_follows_jobs_and_bulk_runs(live: Live) -> None:
    first_id, lease = live.job()
    following = Following(f"{live.url}/v1/events")
    following.await_lines("data:", 1)  # the job that is at work
    assert live.streams() == 1
    bulk_id = bulk_run(live.catalogue)
    following.await_lines("data:", 2)
    live.client.pause_bulk(bulk_id)
    following.await_lines("data:", 3)  # its pause
    assert live.client.wait_for_bulk(bulk_id)["phase"] == "PAUSED", "nobody waits for what does not go on"
    wait_for(lambda: live.streams() == 1, "that stream is closed", timeout_s=10)
    of_run = Following(f"{live.url}/v1/bulk/{bulk_id}/events")
    of_run.await_lines("data:", 1)
    live.client.cancel_bulk(bulk_id)
    live.catalogue.jobs.complete(lease, "r" * 64)
    following.await_lines("data:", 5)  # both ends
    of_run.join(10)
    assert of_run.said("event:") == ["progress", "end"]
    live.client.delete_bulk(bulk_id)
    wait_for(lambda: following.said("event:")[-1] == "gone", "the deletion", timeout_s=10)
    *told, gone = [json.loads(data) for data in following.said("data:")]
    assert gone == {"kind": "bulk", "id": bulk_id}
    # A look at the run between two of the changes that cancelling makes to its rows tells the phase CANCELLED twice.
    phases = [phase for phase, _ in groupby(one["phase"] for one in told if one["id"] == bulk_id)]
    assert phases == ["RUNNING", "PAUSED", "CANCELLED"]
    assert [one["phase"] for one in told if one["id"] == first_id] == ["EXECUTING", "COMPLETED"]
    assert following.said("event:")[:3] == ["job", "bulk", "bulk"]
    # An event does not look whether the result still exists; this job never had one.
    ended = [one for one in told if one["id"] == first_id][-1]
    assert {**ended, "result_deleted": True} == live.client.job(first_id)
    live.app.state.stopping = True
    following.join(5)
    assert not following.is_alive(), "a server that stops ends its streams"


def once(api: TestClient, **request: Any) -> tuple[list[tuple[str, dict[str, Any]]], str]:
    """What a short stream says at its first look, and the last id."""
    said = api.get("/v1/events", **request)
    assert said.status_code == 200, said.text
    blocks = [block for block in said.text.split("\n\n") if "event: " in block]
    return [_parsed(block) for block in blocks], said.text.split("id: ")[-1].splitlines()[0]


def test_a_reconnected_client_gets_the_ends_that_it_missed(settings: Settings) -> None:
    with keyed(settings, stream_s=0.05) as service:
        ann, catalogue = service.client("ann"), service.catalogue
        assert once(ann)[0] == [], "nothing is there, but the stream has an id"
        missed, before = submitted(catalogue, "ann"), submitted(catalogue, "ann")
        at = ended_long_ago(catalogue, missed, 1800.0)
        ended_long_ago(catalogue, before, 3600.0)
        theirs = submitted(catalogue, "bob")
        ended_long_ago(catalogue, theirs, 1700.0)
        assert once(ann)[0] == []
        told, last_id = once(ann, headers={"Last-Event-ID": f"{at - 60:.3f}"})
        assert [(name, data["id"]) for name, data in told] == [("job", missed)]
        assert at < float(last_id) < time.time() - 5, "the next reconnection asks from before this look"
        assert once(ann, headers={"Last-Event-ID": last_id})[0] == []


def test_named_ones_are_sent_first(settings: Settings) -> None:
    with keyed(settings, stream_s=0.05) as service:
        catalogue, ann = service.catalogue, service.client("ann")
        for _ in range(3):
            submitted(catalogue, "ann")
        old, run = submitted(catalogue, "ann"), bulk_run(catalogue, "ann")
        ended_long_ago(catalogue, old)
        catalogue.bulks.cancel(run)
        others, theirs = bulk_run(catalogue, "ann"), bulk_run(catalogue, "bob")
        query = [("job", old), ("bulk", run), ("bulk", theirs)]
        told, _ = once(ann, params=query)
        assert {data["id"] for _, data in told[:3]} == {old, run, theirs}
        assert [name for name, _ in told[3:]] == ["job", "job", "job", "bulk"]
        assert told[-1][1]["id"] == others
        refused = ann.get("/v1/events", params=[("job", new_id()) for _ in range(51)])
        assert refused.status_code == 422
        assert ann.get("/v1/events", params={"job": "x"}).status_code == 422
        assert ann.get("/v1/events", headers={"Last-Event-ID": "yesterday"}).status_code == 422
