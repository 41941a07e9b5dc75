"""``heliopsf doctor``: with nothing there, with what is broken, and with what a service left behind.
``heliopsf database``, and a service that is started on a database of another version."""

from __future__ import annotations

import json
import time
from pathlib import Path
from typing import Any

import pytest
from click.testing import CliRunner, Result
from sqlalchemy import create_engine, text

from service.cli import doctor as cli_doctor
from service.cli.main import main
from tests.tables import RUN_REVISIONS
from tests.whole.stack import free_port
from workers import checks
from workers.catalogue.catalogue import Catalogue
from workers.catalogue.schema import Schema
from workers.catalogue.tables import DEFAULT_OWNER
from workers.settings import Settings, software_version


@pytest.fixture(autouse=True)
def plain(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    for name in ("DATABASE_URL", "BROKER_URL", "WORKER_THREADS", "WORKER_PROCESSES"):
        monkeypatch.delenv(f"HELIOPSF_{name}", raising=False)
    for name in ("OMP", "OPENBLAS", "MKL", "NUMBA"):
        monkeypatch.delenv(f"{name}_NUM_THREADS", raising=False)
    monkeypatch.setenv("HELIOPSF_DATA_DIR", str(tmp_path / "data"))


@pytest.fixture
def catalogue(tmp_path: Path) -> Catalogue:
    (tmp_path / "data").mkdir()
    catalogue = Catalogue(Settings().catalogue_url)
    catalogue.upgrade()
    return catalogue


def execute(statement: str) -> None:
    """Change the database behind the back of the service."""
    engine = create_engine(Settings().catalogue_url)
    with engine.begin() as connection:
        connection.execute(text(statement))
    engine.dispose()


def ask(*options: str) -> Result:
    return CliRunner().invoke(main, ["doctor", *options])


def findings() -> dict[str, dict[str, str]]:
    answer = json.loads(ask("--json").output)
    assert answer["ok"] == all(one["state"] != "broken" for one in answer["findings"])
    return {one["what"]: one for one in answer["findings"]}


def states() -> dict[str, str]:
    return {what: one["state"] for what, one in findings().items()}


def test_with_nothing_there_it_says_so_and_makes_nothing(tmp_path: Path) -> None:
    answer = ask()
    assert answer.exit_code == 0, answer.output
    said = " ".join(answer.output.split())
    assert "\x1b" not in said and "x1b" not in said, "the health check logs it"
    assert "does not exist yet -> `heliopsf serve` makes it" in said
    assert list(tmp_path.iterdir()) == []


def test_all_is_well_where_a_worker_is_there(catalogue: Catalogue, monkeypatch: pytest.MonkeyPatch) -> None:
    catalogue.census.announce("host:1", time.time(), software_version())
    assert set(states()) == {
        "versions",
        "python",
        "threads",
        "kernels",
        "wall",
        "storage",
        "broker",
        "database",
        "schema",
        "changes",
        "clock",
        "workers",
        "stuck jobs",
    }
    found = findings()
    for what in found.keys() - {"versions", "python", "threads", "wall"}:
        assert found[what]["state"] == "ok", found[what]
    assert "host:1" in found["workers"]["found"]
    for acting, state, word in (
        ({"files": True, "calls": True, "user": True}, "ok", "its file alone"),
        ({"files": False, "calls": True, "user": True}, "warning", "no socket"),
        ({"files": False, "calls": False, "user": True}, "warning", "no wall"),
        ({"files": True, "calls": True, "user": False}, "warning", "it is root"),
    ):
        monkeypatch.setattr(cli_doctor.limited, "acting", lambda path, acting=acting: acting)
        assert findings()["wall"]["state"] == state and word in findings()["wall"]["found"]
    monkeypatch.setattr(cli_doctor, "folder_of_kernels", lambda: (Path("/nowhere"), False))
    told = findings()["kernels"]
    assert told["state"] == "warning" and "/nowhere" in told["found"] and "NUMBA_CACHE_DIR" in told["advice"]


@pytest.mark.parametrize(
    ("shared", "cache", "state", "folder"),
    [
        ("shared", "cache", "ok", "shared"),
        (None, "cache", "warning", "cache"),  # only this user reads a private folder
        (None, None, "broken", None),
    ],
)
def test_it_compiles_the_kernels_and_says_where_they_are(
    shared: str | None,
    cache: str | None,
    state: str,
    folder: str | None,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    for name, place in (("NUMBA_CACHE_DIR", shared), ("HELIOPSF_CACHE_DIR", cache)):
        monkeypatch.setenv(name, str(tmp_path / place if place else Path("/proc/nowhere")))
    monkeypatch.setattr("psfcore.all_kernels.compile_all", lambda processes: (50, 55))
    answer = ask("--compile", "--json")
    (found,) = json.loads(answer.output)["findings"]
    assert (found["what"], found["state"]) == ("kernels", state)
    assert answer.exit_code == int(state == "broken") and ("NUMBA_CACHE_DIR" in found["advice"]) == (
        state != "ok"
    )
    if folder is not None:
        assert str(tmp_path / folder) in found["found"] and "50" in found["found"] and "55" in found["found"]


@pytest.mark.parametrize(
    ("release", "advice"),
    [((3, 11, 9), "3.11.10"), ((3, 11, 10), ""), ((3, 12, 5), "3.12.6"), ((3, 12, 6), ""), ((3, 13, 0), "")],
)
def test_an_old_python_is_named(release: tuple[int, int, int], advice: str) -> None:
    told = cli_doctor.python(release)
    assert told.state == ("warning" if advice else "ok") and advice in told.advice
    assert ".".join(map(str, release)) in told.found


def test_a_broken_url_is_a_plain_sentence_without_its_password(monkeypatch: pytest.MonkeyPatch) -> None:
    for variable, url, what, says in (
        ("DATABASE_URL", "postgresql://u:s3cret@127.0.0.1:PORT/x", "database", "refused"),
        ("DATABASE_URL", "postgresql://u@127.0.0.1:PORT/x?password=s3cret", "database", "refused"),
        ("DATABASE_URL", "nonsense:s3cret", "database", "cannot be used"),
        ("DATABASE_URL", "mysql://u:s3cret@127.0.0.1/x", "database", "cannot be used"),
        ("BROKER_URL", "redis://:s3cret@127.0.0.1:PORT/0", "broker", "does not answer (ConnectionError)"),
        ("BROKER_URL", "redis://:s3/s3cret@127.0.0.1:PORT/0", "broker", "broker"),
        ("BROKER_URL", "nope://u:s3cret@127.0.0.1", "broker", "cannot be used"),
        ("BROKER_URL", "s3cret", "broker", "cannot be used"),
        ("BROKER_URL", "amqp://u:s3cret@127.0.0.1:PORT//", "broker", "does not answer"),
    ):
        with monkeypatch.context() as patched:
            patched.setenv(f"HELIOPSF_{variable}", url.replace("PORT", str(free_port())))
            answers = [ask(), ask("--json")]
            for answer in answers:
                assert answer.exit_code == 1 and isinstance(answer.exception, SystemExit), answer.output
                assert "s3cret" not in answer.output and "Traceback" not in answer.output
            found = {one["what"]: one for one in json.loads(answers[1].output)["findings"]}[what]
            assert found["state"] == "broken" and says in found["found"] and found["advice"]


def test_what_is_broken_in_the_data_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for free, state in ((2**20, "broken"), (2**30, "warning"), (2**40, "ok")):
        with monkeypatch.context() as patched:
            patched.setattr(checks, "free_bytes", lambda _folder, free=free: free)
            assert states()["storage"] == state
    (tmp_path / "data").mkdir()
    (tmp_path / "data" / "catalogue.sqlite").write_bytes(b"Dear editor," * 1000)
    assert "not an SQLite database" in findings()["database"]["found"]
    (tmp_path / "file").write_text("in the way")
    monkeypatch.setenv("HELIOPSF_DATA_DIR", str(tmp_path / "file" / "data"))
    assert states()["storage"] == "broken"


def test_a_database_of_another_version(catalogue: Catalogue) -> None:
    revision = "UPDATE alembic_version SET version_num = "
    for statement, state, says in (
        ("DROP INDEX jobs_tallied", "warning", "jobs_tallied"),
        ("DROP TABLE workers", "warning", "workers"),
        ("ALTER TABLE jobs DROP COLUMN worker", "broken", "jobs.worker"),
        (f"{revision} '0001'", "broken", "at revision 0001"),
        (f"{revision} '9999'", "broken", "of a later version"),
        ("DROP TABLE alembic_version", "broken", "without a revision"),
    ):
        execute(statement)
        found = findings()["schema"]
        assert found["state"] == state and says in found["found"] and found["advice"], statement


def test_clocks_and_versions_of_workers(catalogue: Catalogue, monkeypatch: pytest.MonkeyPatch) -> None:
    catalogue.census.announce("host:1", time.time(), "0.0.1")
    assert findings()["workers"]["state"] == "warning" and "0.0.1" in findings()["workers"]["found"]
    real = Catalogue.clock
    for apart, state in ((0.2, "ok"), (-3.0, "warning"), (60.0, "warning")):
        monkeypatch.setattr(Catalogue, "clock", lambda self, apart=apart: real(self) + apart)
        assert states()["clock"] == state, apart


def test_jobs_that_nobody_takes(catalogue: Catalogue, monkeypatch: pytest.MonkeyPatch) -> None:
    catalogue.jobs.submit("psf-build", {}, "k", DEFAULT_OWNER)
    assert states()["workers"] == "warning" and states()["stuck jobs"] == "ok"
    execute("UPDATE jobs SET created_at = created_at - 7200")
    found = findings()
    assert "1 queued" in found["stuck jobs"]["found"] and found["stuck jobs"]["state"] == "warning"
    assert "waited for 2 h" in found["workers"]["found"]
    monkeypatch.setenv("HELIOPSF_BROKER_URL", f"redis://127.0.0.1:{free_port()}")
    assert states()["workers"] == states()["stuck jobs"] == "broken"


def test_a_job_that_waits_for_workers_that_do_nothing(catalogue: Catalogue) -> None:
    catalogue.census.announce("host:1", time.time() - 7200, software_version())
    job, _ = catalogue.jobs.submit("psf-build", {}, "k", DEFAULT_OWNER)
    catalogue.jobs.mark_submitted(job.id)
    execute("UPDATE jobs SET created_at = created_at - 7200")
    assert states()["stuck jobs"] == "ok", "it was sent once"
    catalogue.jobs.mark_submitted(job.id)
    found = findings()["stuck jobs"]
    assert found["state"] == "broken" and "jobs wait (1)" in found["found"] and found["advice"]


def test_a_job_whose_worker_is_gone(catalogue: Catalogue) -> None:
    job, _ = catalogue.jobs.submit("psf-build", {}, "k", DEFAULT_OWNER)
    catalogue.jobs.claim(job.id, "host:1")
    assert states()["stuck jobs"] == "ok"
    execute("UPDATE jobs SET heartbeat_at = heartbeat_at - 7200")
    assert "1 in progress" in findings()["stuck jobs"]["found"]


def test_threads(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    for environment, says in (
        ({"OMP_NUM_THREADS": "4096"}, "OMP_NUM_THREADS"),
        ({"OMP_NUM_THREADS": "many"}, "set OMP_NUM_THREADS to a number"),
        ({"HELIOPSF_WORKER_THREADS": "4096"}, "HELIOPSF_WORKER_THREADS=2"),
        ({"HELIOPSF_WORKER_PROCESSES": "4096"}, "fewer processes"),
        ({}, ""),
    ):
        with monkeypatch.context() as patched:
            for name, value in environment.items():
                patched.setenv(name, value)
            patched.setattr(cli_doctor, "cores", lambda: 2)
            patched.setattr("workers.settings.cores", lambda: 2)
            found = cli_doctor.threads(Settings(), tmp_path / "no-limit")
            assert found.state == ("warning" if environment else "ok") and says in found.advice
    monkeypatch.setattr(cli_doctor, "cores", lambda: 8)
    monkeypatch.setattr("workers.settings.cores", lambda: 8)
    (tmp_path / "cpu.max").write_text("200000 100000\n")  # a container that may use fewer cores
    found = cli_doctor.threads(Settings(), tmp_path / "cpu.max")
    assert found.state == "warning" and "HELIOPSF_WORKER_THREADS=2" in found.advice
    (tmp_path / "cpu.max").write_text("max 100000\n")
    assert cli_doctor.threads(Settings(), tmp_path / "cpu.max").state == "ok"


def test_versions_are_compared_with_what_was_tested_and_what_is_needed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    pins = tmp_path / "constraints.txt"
    pins.write_text("# tested\nNumPy==0.0.1\n")
    found = cli_doctor.versions(pins)
    assert found.state == "warning" and "tested with 0.0.1" in found.found
    assert "no constraints.txt" in cli_doctor.versions(tmp_path / "none").found

    def needs(*_: Any) -> list[str]:
        return ["numpy>=9999", "no-such-library>=1", "pytest>=9999; extra == 'dev'"]

    monkeypatch.setattr(cli_doctor, "requires", needs)
    found = cli_doctor.versions(pins)
    assert found.state == "broken" and "no-such-library is missing" in found.found
    assert "pytest" not in found.found


def test_a_setting_that_is_none_is_one_line(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("HELIOPSF_LEASE_S", "-1")
    answer = ask()
    assert answer.exit_code == 1 and "HELIOPSF_LEASE_S" in answer.output and "Traceback" not in answer.output


# --- heliopsf database -----------------------------------------------------------------------------------


@pytest.fixture
def revisions(monkeypatch: pytest.MonkeyPatch) -> None:
    """The revisions of the database run."""
    monkeypatch.setattr(Schema, "upgrade", RUN_REVISIONS)


def command(*words: str) -> Result:
    return CliRunner().invoke(main, list(words))


@pytest.mark.usefixtures("revisions")
def test_status_upgrade_status() -> None:
    before = command("database", "status")
    assert before.exit_code == 1 and "the database is empty" in before.output
    done = command("database", "upgrade")
    assert done.exit_code == 0 and "upgraded from no revision to" in done.output
    after = command("database", "status")
    assert after.exit_code == 0 and "which this version needs" in after.output
    assert "upgraded" not in command("database", "upgrade").output


@pytest.mark.usefixtures("revisions")
def test_a_later_database_is_one_sentence_for_status_upgrade_and_serve() -> None:
    command("database", "upgrade")
    execute("UPDATE alembic_version SET version_num = '9999'")
    status = command("database", "status")
    assert status.exit_code == 1 and "9999" in status.output and "later version" in status.output
    for words in (("database", "upgrade"), ("serve", "--port", str(free_port()))):
        answer = command(*words)
        assert answer.exit_code == 1 and isinstance(answer.exception, SystemExit), answer.output
        assert "at revision 9999, which this version does not know" in answer.output


def test_a_database_that_is_away_is_one_sentence_without_its_password(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setenv("HELIOPSF_DATABASE_URL", f"postgresql://u:s3cret@127.0.0.1:{free_port()}/x")
    for words in (("database", "status"), ("database", "upgrade"), ("serve", "--port", str(free_port()))):
        answer = command(*words)
        assert answer.exit_code == 1 and isinstance(answer.exception, SystemExit), answer.output
        assert "the connection is refused" in answer.output and "s3cret" not in answer.output
    monkeypatch.setenv("HELIOPSF_DATABASE_URL", "nonsense:s3cret")
    answer = command("database", "status")
    assert answer.exit_code == 1 and "HELIOPSF_DATABASE_URL cannot be used" in answer.output
    assert "s3cret" not in answer.output
