"""``heliopsf doctor``: checks in one command everything that an operator would check first.

The command changes nothing, unless it is asked to compile the kernels. It also works if no server and no worker run: a
missing part is a finding.
"""

from __future__ import annotations

import json
import os
import shutil
import sys
import textwrap
import time
from collections import Counter
from collections.abc import Iterator
from contextlib import closing
from dataclasses import asdict, dataclass, replace
from importlib.metadata import PackageNotFoundError, requires, version
from pathlib import Path
from typing import Literal, get_args

import click
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name
from sqlalchemy.engine import URL, make_url
from sqlalchemy.exc import ArgumentError, SQLAlchemyError

from psfcore import limited
from psfcore.files import CACHE_VARIABLE
from psfcore.kernel_files import FOLDER_VARIABLE, folder_of_kernels, private_folder
from service.cli.operator import sentence
from service.cli.options import DATA, read_settings
from service.cli.progress import duration, echo
from workers import checks
from workers.catalogue.catalogue import Catalogue
from workers.files.store import open_store
from workers.machine import cores
from workers.settings import Settings, software_version

State = Literal["ok", "warning", "broken"]
PINS = Path(__file__).parents[2] / "constraints.txt"
CPU_QUOTA = Path("/sys/fs/cgroup/cpu.max")
THREAD_VARIABLES = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "NUMBA_NUM_THREADS")
EXTRAS = ("service", "published", "plot")  # the commands need all packages of these extras
HIDDEN = "the URL that is set"  # in place of a URL that may contain a password in any part
LITTLE_ROOM_BYTES = 5 * 2**30
# The first patch of each Python that reads long cookies (CVE-2024-7592) and headers of tar files (CVE-2024-6232) in
# linear time.
LINEAR_PYTHONS = {(3, 11): 10, (3, 12): 6}
# The finding and the advice for a database at another revision; "": the advice is that of the schema.
OTHER_REVISIONS: dict[str, tuple[State, str]] = {
    "empty": ("warning", "the first `heliopsf serve` makes them"),
    "older": (
        "warning",
        "copy the database, then run `heliopsf database upgrade` (or start `heliopsf serve`, which also upgrades it)",
    ),
    "newer": ("broken", "run the version of heliopsf that upgraded it"),
    "unversioned": ("broken", ""),
    "obsolete": ("broken", ""),
}


@dataclass(frozen=True)
class Finding:
    """The result of a check.

    Attributes
    ----------
    found
        The observation.
    advice
        What the user should do; empty if there is nothing to do.
    """

    state: State
    found: str
    advice: str = ""


@click.command()
@DATA
@click.option("--json", "as_json", is_flag=True, help="Print as JSON")
@click.option(
    "--compile", "compiles", is_flag=True, help="Compile all kernels, for all users; check nothing else"
)
def doctor(data: Path | None, as_json: bool, compiles: bool) -> None:
    """Check versions, settings, kernels, disk, database, broker and workers, and say what to do. If something is
    broken, the exit status is 1.
    """
    findings = {"kernels": compiled_kernels()} if compiles else examine(read_settings(data))
    broken = any(finding.state == "broken" for finding in findings.values())
    if as_json:
        rows = [{"what": what, **asdict(finding)} for what, finding in findings.items()]
        echo(json.dumps({"ok": not broken, "findings": rows}, indent=1))
    else:
        echo("\n".join(table(findings, shutil.get_terminal_size((110, 24)).columns)))
    sys.exit(1 if broken else 0)


def examine(settings: Settings) -> dict[str, Finding]:
    """The finding about each subject, in the order in which problems should be corrected."""
    findings = {
        "versions": versions(),
        "python": python(),
        "threads": threads(settings),
        "kernels": kernels(),
        "wall": wall(),
        "storage": storage(settings),
    }
    if settings.store_url:
        findings["object store"] = object_store(settings)
    findings["broker"] = broker(settings)
    findings["database"] = database(settings)
    if findings["database"].state != "ok":
        return findings
    with closing(Catalogue(settings.catalogue_url)) as catalogue:
        for check in (schema, changes, clock, workers, stuck_jobs):
            name = check.__name__.replace("_", " ")
            try:
                findings[name] = check(settings, catalogue)
            except SQLAlchemyError as error:
                fault = checks.database_said(error)
                findings[name] = Finding("broken", f"the database: {fault}")
    return findings


def table(findings: dict[str, Finding], width: int) -> Iterator[str]:
    """The findings as lines: subject, state and what was found. The next line gives the advice."""
    names = max(map(len, findings))
    indent = " " * (names + 11)
    for what, finding in findings.items():
        texts = [finding.found, *([f"-> {finding.advice}"] if finding.advice else [])]
        lines = [line for text in texts for line in textwrap.wrap(text, max(40, width - len(indent)))]
        yield f"{what:<{names}}  {finding.state:<7}  {lines[0]}"
        yield from (indent + line for line in lines[1:])
    count = Counter(finding.state for finding in findings.values())
    yield ", ".join(f"{count[state]} {state}" for state in get_args(State) if count[state])


# The checks ----------------------------------------------------------------------------------


def versions(pins: Path = PINS) -> Finding:
    """Do the installed libraries have the required versions, and (if constraints.txt is here) the tested versions?"""
    wrong, other, tested = [], [], _pinned(pins)
    libraries = [one for one in map(Requirement, requires("heliopsf") or []) if _is_needed(one)]
    for requirement in libraries:
        try:
            found = version(requirement.name)
        except PackageNotFoundError:
            wrong.append(f"{requirement.name} is missing")
            continue
        pin = tested.get(canonicalize_name(requirement.name), found)
        if not requirement.specifier.contains(found, prereleases=True):
            wrong.append(f"{requirement.name} {found}, but {requirement.specifier} is needed")
        elif pin != found:
            other.append(f"{requirement.name} {found}, tested with {pin}")
    about = f"heliopsf {software_version()}, Python {sys.version.split()[0]}"
    if wrong:
        return Finding("broken", f"{about}; {'; '.join(wrong)}", "install heliopsf again")
    if other:
        advice = "install with `-c constraints.txt` to get the tested versions"
        return Finding("warning", f"{about}; {'; '.join(other)}", advice)
    kind = "tested" if tested else "required"
    note = "" if tested else " (there is no constraints.txt with tested versions here)"
    return Finding("ok", f"{about}; {len(libraries)} libraries with {kind} versions{note}")


def python(release: tuple[int, int, int] = sys.version_info[:3]) -> Finding:
    """Does this Python have the corrections against requests and archives that take very long to read?"""
    *minor, patch = release
    first = LINEAR_PYTHONS.get((minor[0], minor[1]), 0)
    here, needed = (".".join(map(str, (*minor, one))) for one in (patch, first))
    if patch >= first:
        return Finding("ok", f"Python {here} reads cookies and tar files in linear time")
    return Finding(
        "warning",
        f"Python {here} needs very long for some cookies (CVE-2024-7592) and tar files (CVE-2024-6232)",
        f"install Python {needed} or later, and heliopsf in it",
    )


def threads(settings: Settings, cpu_quota: Path = CPU_QUOTA) -> Finding:
    """Do workers and libraries together start more threads than there are cores?"""
    here = cores()
    may_use = min(here, _quota(cpu_quota) or here)
    processes = settings.worker_processes
    share = max(1, int(may_use // processes))
    found = f"{here} cores, {processes} worker process{'es' if processes > 1 else ''} of {settings.threads} threads"
    if may_use < here:
        found += f"; the container may use {may_use:g} of the cores"
    values = {name: os.environ[name] for name in THREAD_VARIABLES if name in os.environ}
    found += "".join(f"; {name}={value}" for name, value in values.items())
    values.pop("NUMBA_NUM_THREADS", None)  # a worker sets this variable by itself
    advice = []
    for name, value in values.items():
        first = value.split(",")[0].strip()
        if not first.isdecimal() or int(first) < 1:
            advice.append(f"set {name} to a number of threads")
        elif int(first) * processes > may_use:
            advice.append(f"set {name} to {share} or less")
    if processes * settings.threads > may_use:
        advice.append(
            f"more threads than cores slow each other down: set HELIOPSF_WORKER_THREADS={share}, or start fewer "
            "processes"
        )
    return Finding("warning" if advice else "ok", found, "; ".join(advice))


def kernels() -> Finding:
    """Can compiled kernels be kept, so that not every process compiles them?"""
    folder, keeps = folder_of_kernels()
    if keeps:
        return Finding("ok", f"compiled kernels are kept in {folder}")
    advice = f"set {FOLDER_VARIABLE} or {CACHE_VARIABLE} to a folder to which this user alone can write"
    return Finding(
        "warning", f"each process compiles its kernels again: they cannot be kept in {folder}", advice
    )


def compiled_kernels() -> Finding:
    """Compile the kernels that are not kept yet, with all cores. Can all users read them?"""
    from psfcore.all_kernels import compile_all

    folder, keeps = folder_of_kernels()
    if not keeps:
        return replace(kernels(), state="broken")
    started = time.perf_counter()
    new, kept = compile_all(cores())
    took_s = time.perf_counter() - started
    found = f"{new} kernels compiled in {took_s:.0f} s; {kept} are kept in {folder}"
    if folder != private_folder():
        return Finding("ok", found)
    advice = f"run this command as the user who installed heliopsf, or set {FOLDER_VARIABLE} to a folder for all users"
    return Finding("warning", f"{found}, which only this user uses", advice)


def wall() -> Finding:
    """Which parts of the wall stand around the process that reads files of strangers?"""
    parts = {
        "files": "opens its file alone (Landlock)",
        "calls": "opens no socket and starts no program (seccomp)",
    }
    acting = limited.acting(Path(__file__))
    found = "the process that reads files of strangers " + (
        " and ".join(text for part, text in parts.items() if acting[part])
        or "has no wall: it reads what this user reads"
    )
    if not acting["user"]:
        found += "; it is root, because this machine lets root become no other user"
    if all(acting.values()):
        return Finding("ok", found)
    return Finding(
        "warning",
        found,
        "use Linux 5.13 or later with Landlock, on x86_64 or aarch64, or start the service as a user of its own",
    )


def storage(settings: Settings) -> Finding:
    """Can files be written to the data folder, and is there room for them?"""
    folder = settings.data_dir.resolve()
    there = next(path for path in (folder, *folder.parents) if path.exists())
    if not there.is_dir() or (there != folder and not os.access(there, os.W_OK | os.X_OK)):
        found = f"{folder} does not exist and cannot be made"
        return Finding("broken", found, "set HELIOPSF_DATA_DIR to a folder that this user can write to")
    if there == folder:
        try:
            checks.storage(folder, settings.min_free_mib)
        except checks.Unusable as fault:
            found = f"{folder}: {fault}"
            return Finding("broken", found, "give this user write access, or free disk space")
    free = checks.free_bytes(there)
    found = f"{folder}{'' if there == folder else ' (not made yet)'}, {_gib(free)} free"
    largest = max(settings.max_upload_bytes, settings.max_psf_bytes, settings.max_transit_bytes)
    if free < settings.max_upload_bytes:
        return Finding("broken", f"{found}: no room for one upload", "free disk space")
    if free < max(LITTLE_ROOM_BYTES, largest):
        advice = f"free disk space: one transit may take {_gib(settings.max_transit_bytes)}"
        return Finding("warning", found, advice)
    return Finding("ok", found)


def object_store(settings: Settings) -> Finding:
    """Does the object store accept files?"""
    try:
        checks.object_store(open_store(settings))
    except checks.Unusable as fault:
        advice = "check HELIOPSF_STORE_URL and the AWS_* variables (endpoint, region, credentials)"
        return Finding("broken", f"{settings.store_url}: {fault}", advice)
    except ImportError:
        advice = "install heliopsf with the extra s3: pip install 'heliopsf[s3]'"
        return Finding("broken", "the library for S3 is not installed", advice)
    return Finding("ok", str(settings.store_url))


def broker(settings: Settings) -> Finding:
    """Does the broker answer and accept messages?"""
    if settings.embedded:
        return Finding("ok", "embedded: a folder inside the data folder")
    where = address(settings.broker_url)
    try:
        checks.broker(settings)
    except checks.Unusable as fault:
        advice = "start it, make it accept messages, or correct HELIOPSF_BROKER_URL; jobs wait until then"
        return Finding("broken", f"{where}: {fault}", advice)
    return Finding("ok", f"{where} answers")


def database(settings: Settings) -> Finding:
    """Does the database answer, and is the file of an SQLite database whole?"""
    where = address(settings.catalogue_url)
    own = settings.catalogue_url.startswith("sqlite") and where != HIDDEN
    if own and not Path(where).exists():  # opening the database would create the file
        return Finding("warning", f"{where} does not exist yet", "`heliopsf serve` makes it")
    try:
        catalogue = Catalogue(settings.catalogue_url)
    except (ArgumentError, ImportError, ValueError) as error:
        advice = "set HELIOPSF_DATABASE_URL to postgresql://..., or unset it"
        return Finding("broken", f"{where} cannot be used ({type(error).__name__})", advice)
    started = time.perf_counter()
    try:
        with closing(catalogue):
            catalogue.clock()
            took_ms = 1e3 * (time.perf_counter() - started)
            catalogue.check_pages()
    except SQLAlchemyError as error:
        advice = (
            "correct the permissions of the file" if own else "start it, or correct HELIOPSF_DATABASE_URL"
        )
        if checks.damaged(error):
            advice = "stop the service, and restore a copy of the database"
        return Finding("broken", f"{where}: {checks.database_said(error)}", advice)
    return Finding("ok", f"{where} answers in {took_ms:.0f} ms")


def schema(_settings: Settings, catalogue: Catalogue) -> Finding:
    """Is the database at the revision that this version needs, and complete?"""
    status = catalogue.schema.status()
    revision = sentence(status)
    if status.state != "current":
        state, advice = OTHER_REVISIONS[status.state]
        return Finding(state, revision, advice or status.refusal or "")
    faults = catalogue.schema.faults()
    if faults.columns:
        found = f"{revision}, but columns are missing: {', '.join(faults.columns)}"
        return Finding("broken", found, "the tables were changed by hand: restore a copy of the database")
    if faults.tables or faults.indexes:
        found = f"{revision}, but these are missing: {', '.join((*faults.tables, *faults.indexes))}"
        return Finding("warning", found, "run `heliopsf database upgrade` to restore them")
    return Finding("ok", f"{revision}: tables, columns and indexes are complete")


def changes(_settings: Settings, catalogue: Catalogue) -> Finding:
    """Does the database accept changes?"""
    if catalogue.schema.faults().tables:
        return Finding("ok", "nothing to change yet")
    catalogue.check_writable()
    return Finding("ok", "the database accepts changes")


def clock(_settings: Settings, catalogue: Catalogue) -> Finding:
    """Do the clocks of this machine and of the database agree? Leases use the clock of the database."""
    before = time.time()
    theirs = catalogue.clock()
    after = time.time()
    apart = theirs - (before + after) / 2
    found = f"the database's clock is {abs(apart):.2f} s {'ahead' if apart > 0 else 'behind'}"
    if abs(apart) > 1.0 + (after - before):
        advice = "set both clocks by NTP: creation times and the expiry of keys use the clock of this machine"
        return Finding("warning", found, advice)
    return Finding("ok", f"within {max(0.01, abs(apart)):.2f} s of the database's clock")


def workers(settings: Settings, catalogue: Catalogue) -> Finding:
    """Are there workers, and do they run this version?"""
    if "workers" in catalogue.schema.faults().tables:
        return Finding("warning", "no worker was ever started", _start(settings))
    there = catalogue.census.workers(settings.lease_s)
    waiting = catalogue.census.oldest_queued_at()
    if not there:
        found = f"no worker has reported for {settings.lease_s:g} s"
        if waiting is not None:
            found += f"; a job has waited for {duration(time.time() - waiting)}"
        state: State = "broken" if waiting is not None and not settings.embedded else "warning"
        return Finding(state, found, _start(settings))
    others = sorted({row.version for row in there} - {software_version()})
    names = ", ".join(row.name for row in there[:5]) + (", ..." if len(there) > 5 else "")
    found = f"{len(there)} process{'es' if len(there) > 1 else ''}: {names}"
    if others:
        advice = f"restart them with version {software_version()}"
        return Finding("warning", f"{found}; some run version {', '.join(others)}", advice)
    return Finding("ok", found)


def stuck_jobs(settings: Settings, catalogue: Catalogue) -> Finding:
    """Are there jobs that a running service would have handled by now?"""
    if "jobs" in catalogue.schema.faults().tables:
        return Finding("ok", "no jobs yet")
    try:
        checks.jobs(catalogue, settings)
    except checks.Unusable as fault:
        advice = (
            "restart the workers with the broker of the server, for all queues (HELIOPSF_WORKER_QUEUES), and "
            "read their logs"
        )
        return Finding("broken", str(fault), advice)
    silent = catalogue.census.count_silent(settings.lease_s + 5 * settings.reconcile_s)
    left = catalogue.census.count_unsubmitted(max(30.0, 5 * settings.reconcile_s))
    if not silent and not left:
        return Finding("ok", "none")
    found = (
        f"{silent} in progress whose worker does not report, {left} queued but not submitted to the broker"
    )
    advice = "start `heliopsf serve`, which queues them again; if it is running, read its log"
    return Finding("warning" if settings.embedded else "broken", found, advice)


# Texts -------------------------------------------------------------------------------------


def address(url: str) -> str:
    """The file of a URL of SQLite; of another URL scheme, host, port and path, without user, password and options."""
    try:
        parts = make_url(url)
    except (ArgumentError, ValueError):
        return HIDDEN
    if parts.get_backend_name() == "sqlite" and parts.database:
        return parts.database
    # A password that is not encoded may reach into the parts behind it.
    if parts.host is None or "@" in f"{parts.host}{parts.database}":
        return HIDDEN
    public = URL.create(parts.drivername, host=parts.host, port=parts.port, database=parts.database)
    return public.render_as_string()


def _start(settings: Settings) -> str:
    return "`heliopsf serve` starts one" if settings.embedded else "start `heliopsf worker`"


def _is_needed(requirement: Requirement) -> bool:
    """Whether the commands and the service need a library: it is required always, or by one of their extras."""
    return requirement.name != "heliopsf" and (
        requirement.marker is None
        or any(requirement.marker.evaluate({"extra": extra}) for extra in ("", *EXTRAS))
    )


def _pinned(file: Path) -> dict[str, str]:
    """The versions in a file of pinned versions, by library name; empty if there is no such file."""
    if not file.is_file():
        return {}
    pairs = (line.split("==", 1) for line in file.read_text().splitlines() if "==" in line and line[0] != "#")
    return {canonicalize_name(name.strip()): pin.split(";")[0].strip() for name, pin in pairs}


def _quota(file: Path) -> float | None:
    """Number of cores that the container may use, from the cgroup; None: no limit."""
    try:
        quota, period = file.read_text().split()
        return int(quota) / int(period)
    except (OSError, ValueError):
        return None


def _gib(size: int) -> str:
    return f"{size / 2**30:.1f} GiB"
