"""The table of job kinds: each row is complete, and everything else follows from it."""

from __future__ import annotations

from typing import Any

from pydantic import TypeAdapter

from workers.contract.kinds import KINDS, REQUESTS, JobRequest, kind_of_origin, load, queue_of
from workers.contract.queues import Queue


def test_every_row_names_a_task_and_a_resolver_that_exist() -> None:
    for name, kind in KINDS.items():
        assert callable(kind.load_task()) and callable(load(kind.resolver)), name
        assert (kind.load_assistant() is None) == (kind.assistant is None), name


def test_every_kind_but_bulk_can_be_requested() -> None:
    assert set(REQUESTS) == set(KINDS) - {"bulk"}
    tables: Any = TypeAdapter(JobRequest).validate_python(
        {"kind": "psf-tables", "queue": "bulk", "parameters": {"psf_id": "a" * 64}}
    )
    assert isinstance(tables, KINDS["psf-tables"].request) and tables.queue == "bulk"
    for name, model in REQUESTS.items():
        assert KINDS[name].parameters is model.model_fields["parameters"].annotation
        assert KINDS[name].resolved is not None


def test_a_schema_names_each_request_by_its_kind() -> None:
    schema = TypeAdapter(JobRequest).json_schema()
    assert schema["discriminator"]["mapping"]["psf-build"] == "#/$defs/PsfBuildRequest"
    assert set(schema["discriminator"]["mapping"]) == set(REQUESTS)


def test_what_takes_long_does_not_wait_among_the_quick_jobs() -> None:
    assert queue_of("cross-validate") == Queue.CROSSVAL and queue_of("bulk") == Queue.BULK
    assert {queue_of(name) for name in set(KINDS) - {"cross-validate", "bulk"}} == {Queue.INTERACTIVE}


def test_a_rerun_finds_the_kind_that_made_a_thing() -> None:
    origins = {kind.origin: kind.name for kind in KINDS.values() if kind.origin is not None}
    assert origins == {
        "deconvolved": "deconvolve",
        "built": "psf-build",
        "fitted": "psf-fit",
        "corrected": "gap-diagnose",
        "interpolated": "psf-interpolate",
    }
    assert all(kind_of_origin(origin).name == name for origin, name in origins.items())
