"""Rules of the house: which way imports run, what the web process carries, and what is kept in step."""

from __future__ import annotations

import ast
import importlib
import re
import subprocess
import sys
import tomllib
from collections import defaultdict
from collections.abc import Iterator
from importlib.metadata import distributions
from pathlib import Path

import pytest
import yaml
from packaging.requirements import Requirement
from packaging.specifiers import SpecifierSet
from packaging.utils import canonicalize_name

from service.openapi import description
from studies.planted import FAULTS
from tests.conftest import pytest_collection_modifyitems

HERE = Path(__file__).parents[2]
# What --local and the demo need is imported by the command line alone.
COMMAND_LINE = {HERE / "service" / "local.py", *(HERE / "service" / "cli").rglob("*.py")}


def imports(path: Path) -> Iterator[str]:
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0 and node.module, f"{path}: expected absolute imports"
            yield node.module
            yield from (f"{node.module}.{alias.name}" for alias in node.names)


def sources(package: str) -> list[Path]:
    found = sorted((HERE / package).rglob("*.py"))
    assert found
    return found


def test_imports_run_one_way(subtests: pytest.Subtests) -> None:
    for package, forbidden in (
        (
            "psfcore",
            (
                "heliopsf",
                "workers",
                "service",
                "fastapi",
                "starlette",
                "celery",
                "sqlalchemy",
                "redis",
                "httpx",
            ),
        ),
        ("workers", ("heliopsf", "service", "fastapi", "starlette", "httpx")),
        ("service", ("heliopsf",)),
    ):
        with subtests.test(str((package, forbidden))):
            wrong = [
                (str(path.relative_to(HERE)), name)
                for path in sources(package)
                for name in imports(path)
                if name.split(".")[0] in forbidden
            ]
            assert wrong == []


def test_what_people_import_stands_on_the_core_the_client_and_the_machine_alone() -> None:
    libraries = {"astropy", "heliopsf", "matplotlib", "numpy", "psfcore"}
    wrong = [
        (path.name, name)
        for path in sources("heliopsf")
        for name in imports(path)
        if name.split(".")[0] not in libraries | sys.stdlib_module_names
        and not name.startswith(("service.client", "workers.machine"))
    ]
    assert wrong == []


# Where the libraries that take files of strangers apart may be imported, and why. Everything in "child" runs in a
# limited process.
UNPACKING = {
    "psfcore/fits/gzipped.py": "child",
    "psfcore/fits/hdus.py": "child; zlib.error is one of the errors that it tells",
    "psfcore/transit/members.py": "child; and the starts of files in a folder of the user's own",
    "psfcore/files.py": "writes gzip",
    "psfcore/transit/archive.py": "writes .tar",
    "psfcore/drawing/thumbnail.py": "writes PNG",
    "psfcore/scatter/solution_file.py": "names the errors of numpy.load for files that it wrote",
}
# Where astropy opens a whole file, with its tables and tiles.
OPENING = {
    "psfcore/fits/hdus.py": "child",
    "psfcore/fits/psfs.py": "child",
    "psfcore/fits/viewing/regions.py": "child",
    "psfcore/fits/images.py": "reads planes of products that this service wrote",
}


def test_files_of_strangers_are_taken_apart_in_the_limited_process_alone() -> None:
    unpacking, opening = set(), set()
    for path in (one for package in ("psfcore", "workers", "service") for one in sources(package)):
        if {"bz2", "gzip", "lzma", "tarfile", "zipfile", "zlib"} & set(imports(path)):
            unpacking.add(str(path.relative_to(HERE)))
        calls = (node.func for node in ast.walk(ast.parse(path.read_text())) if isinstance(node, ast.Call))
        if {"fits.open", "fits.getdata"} & set(map(ast.unparse, calls)):
            opening.add(str(path.relative_to(HERE)))
    assert (unpacking, opening) == (set(UNPACKING), set(OPENING))


# Of psfcore the service reads what shows without a pixel: FITS headers, and a transit's archive and manifest, whose
# table of contents is checked at upload as headers are. None of these loads numerics.
LIGHT = (
    "psfcore.deconvolve.summary",
    "psfcore.drawing.thumbnail",  # loaded by the first request for a picture
    "psfcore.fits.blocks",
    "psfcore.fits.cards",
    "psfcore.fits.frame",
    "psfcore.fits.header",
    "psfcore.fits.stored_psf",
    "psfcore.fits.viewing",  # its modules of pixels are loaded by the first request for pixels
    "psfcore.instruments.files",
    "psfcore.instruments.psf_statements",
    "psfcore.limited",
    "psfcore.tables.lookup",
    "psfcore.errors",
    "psfcore.noise",
    "psfcore.transit.archive",
    "psfcore.transit.manifest",
    "psfcore.files",
)


def test_the_service_imports_of_psfcore_what_reads_headers_and_tables_of_contents_alone() -> None:
    wrong = [
        (path.name, name)
        for path in sources("service")
        if path not in COMMAND_LINE
        for name in imports(path)
        if name.startswith("psfcore")
        and not any(name.startswith(light) or light.startswith(name + ".") for light in LIGHT)
    ]
    assert wrong == []


def test_the_web_process_carries_no_numerics_and_no_task() -> None:
    code = "import sys, service.app, service.server; print('\\n'.join(sys.modules))"
    loaded = set(
        subprocess.run(
            [sys.executable, "-c", code], check=True, capture_output=True, text=True
        ).stdout.split()
    )
    assert "service.app" in loaded
    heavy = {
        "astropy",  # loaded when the first FITS file arrives
        "celery",  # loaded when the application starts, not when it is imported
        "kombu",
        "numpy",
        "scipy",
        "numba",
        "matplotlib",
        "workers.run.runner",
        "psfcore.convolution.convolver",
        "psfcore.fits.hdus",
        "psfcore.drawing.thumbnail",
        "psfcore.fits.viewing.windows",  # loaded by the first request for pixels
        "psfcore.fits.images",
        "psfcore.fits.psfs",
        "service.client.http",
        "httpx",
    }
    assert loaded & heavy == set()
    assert {name for name in loaded if name.startswith("workers.tasks.")} == set()


def test_servers_and_workers_fetch_nothing_and_take_no_objects_from_outside() -> None:
    """No address that a request brings can be asked for from here, and nothing is read that could be code."""
    fetching = {
        "httpx",
        "requests",
        "urllib.request",
        "urllib3",
        "aiohttp",
        "http.client",
        "ftplib",
        "smtplib",
    }
    unpacking = {"pickle", "marshal", "shelve", "dill", "cloudpickle", "joblib"}
    wrong = [
        (path.name, name)
        for path in (*sources("service"), *sources("workers"), *sources("psfcore"))
        # A store's address is the operator's, those of published PSFs are in the code, and a client is no server.
        if HERE / "service" / "client" not in path.parents
        and path.name not in ("s3_store.py", "published_psfs.py")
        for name in imports(path)
        if name in fetching | unpacking
    ]
    assert wrong == []


def test_a_transit_s_archive_is_looked_into_without_numerics() -> None:
    code = "import sys, psfcore.transit.archive; print('\\n'.join(sys.modules))"
    loaded = subprocess.run([sys.executable, "-c", code], check=True, capture_output=True, text=True).stdout
    assert "psfcore.transit.manifest" in loaded.split()
    assert {"numpy", "astropy"} & set(loaded.split()) == set()


def test_fits_and_fourier_have_one_home_each() -> None:
    for path in sources("psfcore"):
        names = set(imports(path))
        if path.parent != HERE / "psfcore" / "fits":
            # A Header may be carried about; reading and writing files has its home.
            assert not {n for n in names if n.startswith("astropy.io.fits")} - {
                "astropy.io.fits",
                "astropy.io.fits.Header",
            }, path
        if path.name != "convolver.py":
            assert not {n for n in names if "fft" in n.split(".")}, path


def test_commands_print_by_one_function() -> None:
    """It makes texts of services and files harmless for a terminal."""
    printing = [path.name for path in sources("service/cli") if "click.echo(" in path.read_text()]
    assert printing == ["progress.py"]


def test_the_interface_and_the_settings_are_described_as_the_code_has_them() -> None:
    kept = (HERE / "openapi" / "openapi.json").read_text()
    assert kept == description(), "`make openapi` writes it anew"
    from workers.settings_table import settings_table

    kept = (HERE / "docs" / "settings.md").read_text("utf-8")
    assert kept == settings_table(), "`make settings` writes it anew"


def test_the_readme_tells_the_commands_that_ci_runs() -> None:
    readme, ci = (HERE / "README.md").read_text(), (HERE / ".ci" / "run").read_text()
    targets = re.findall(r"^make (.+)$", ci, flags=re.M)
    assert targets == ["lint test"]
    told = set(re.findall(r"make ([a-z-]+)", readme))
    assert {"demo", "test", "lint"} <= told
    made = set(re.findall(r"^([a-z-]+):", (HERE / "Makefile").read_text(), flags=re.M))
    assert told <= made, "the README tells of a target that the Makefile lacks"


def test_no_file_names_a_registry() -> None:
    hosts = re.compile(
        "|".join(["py" + "pi", "python" + "hosted", "index" + "-url", "npm" + "js", "docker" + r"\.io"])
    )
    listed = subprocess.run(["git", "ls-files"], cwd=HERE, capture_output=True, text=True)
    if listed.returncode:
        pytest.skip("not a git checkout")
    named = [
        name
        for name in listed.stdout.split()
        if (HERE / name).is_file() and hosts.search((HERE / name).read_text(errors="replace"))
    ]
    assert named == []


OURS = ("api", "worker", "worker-interactive")  # the services of the Compose file that run heliopsf


def test_the_compose_file_fits_the_settings_and_the_commands() -> None:
    """As far as can be checked without an engine: every variable is a setting, every command exists."""
    from click.testing import CliRunner

    from service.cli.main import main
    from workers.settings import Settings

    compose = yaml.safe_load((HERE / "docker-compose.yml").read_text())
    services = compose["services"]
    assert set(services) == {"proxy", *OURS, "redis", "postgres"}
    known = {f"HELIOPSF_{name.upper()}" for name in Settings.model_fields}
    for name, service in services.items():
        assert service["healthcheck"]["test"], name
        mounts = {f"{v}:{p}" for v in compose["volumes"] for p in ("/data", "/var/lib/postgresql/data")}
        assert set(service.get("volumes", [])) <= mounts | {"./deploy/nginx.conf:/etc/nginx/nginx.conf:ro"}
        if name in OURS:
            assert set(service["environment"]) <= known
            assert set(service["depends_on"]) == {"redis", "postgres"}
            command = service["command"].split()
            assert command[0] == "heliopsf"
            assert CliRunner().invoke(main, [*command[1:], "--help"]).exit_code == 0
    assert services["proxy"]["ports"][0].startswith("127.0.0.1:"), "reachable from this machine alone"


def test_the_containers_have_no_more_rights_and_memory_than_they_need() -> None:
    services = yaml.safe_load((HERE / "docker-compose.yml").read_text())["services"]
    for name, service in services.items():
        assert service["read_only"] is True, name
        assert service["cap_drop"] == ["ALL"], name
        assert service["security_opt"] == ["no-new-privileges:true"], name
        assert service["mem_limit"] and service["pids_limit"], name
        assert "privileged" not in service, name
    # PostgreSQL's start as root has to give its folder to another user; the others need nothing.
    assert {name for name, service in services.items() if "cap_add" in service} == {"postgres"}
    password = "${REDIS_PASSWORD:?set REDIS_PASSWORD in .env}"
    assert services["redis"]["command"].endswith(f"--requirepass {password}")
    assert services["redis"]["environment"]["REDISCLI_AUTH"] == password
    for name in OURS:
        assert f"redis://:{password}@redis:" in services[name]["environment"]["HELIOPSF_BROKER_URL"], name
        assert "/tmp" in services[name]["tmpfs"], name
        assert "JOB_MEMORY_MIB" in services[name]["environment"]["HELIOPSF_MAX_JOB_MEMORY_MIB"], name


def test_the_dockerfile_copies_what_there_is() -> None:
    for line in (HERE / "Dockerfile").read_text().splitlines():
        if line.startswith("COPY ") and "--from" not in line:
            for source in line.split()[1:-1]:
                assert (HERE / source).exists(), source
                assert f"!{source}" in (HERE / ".dockerignore").read_text(), source


def test_the_image_is_installed_from_pins_with_hashes() -> None:
    text = (HERE / "pins" / "service.txt").read_text()
    blocks = re.split(r"\n(?=[A-Za-z0-9])", text.strip())
    pins = {}
    for block in blocks:
        name, version = re.match(r"([A-Za-z0-9._-]+)(?:\[[^\]]*\])?==([^ ;\\]+)", block).groups()  # type: ignore[union-attr]
        assert re.search(r"--hash=sha256:[0-9a-f]{64}", block), name
        pins[canonicalize_name(name)] = version
    tested = dict(
        line.split(";")[0].strip().split("==")
        for line in (HERE / "constraints.txt").read_text().splitlines()
        if "==" in line
    )
    tested = {canonicalize_name(name): version for name, version in tested.items()}
    differ = {name for name, version in pins.items() if tested.get(name, version) != version}
    assert differ == set(), "`make pins` writes the file anew"
    project = tomllib.loads((HERE / "pyproject.toml").read_text())
    build = project["build-system"]["requires"]
    assert (HERE / "pins" / "build.in").read_text().split() == build
    extras = project["project"]["optional-dependencies"]
    of_service = [one for extra in ("service", "plot", "s3") for one in extras[extra]]
    needed = [*project["project"]["dependencies"], *of_service, *build]
    missing = {canonicalize_name(Requirement(one).name) for one in needed} - set(pins) - {"heliopsf"}
    assert missing == set(), "`make pins` writes the file anew"
    installs = re.findall(r"pip install (.+)", (HERE / "Dockerfile").read_text())
    assert len(installs) == 2 and "--require-hashes" in installs[0]
    assert "--no-deps" in installs[1] and "--no-build-isolation" in installs[1]


def test_every_installed_pin_runs_on_the_oldest_python() -> None:
    """Debian 12 has Python 3.11.2. If one pin needs a newer one, pip searches for a solution for a very long time."""
    (oldest,) = SpecifierSet(
        tomllib.loads((HERE / "pyproject.toml").read_text())["project"]["requires-python"]
    )
    refused = {
        found.name: found.metadata["Requires-Python"]
        for found in distributions()
        if not SpecifierSet(found.metadata.get("Requires-Python", "")).contains(f"{oldest.version}.0")
    }
    assert refused == {}, "pin an older version in constraints.txt"


@pytest.mark.parametrize("folder", ["benchmarks", "studies"])
def test_scripts_that_no_test_runs_can_be_imported(folder: str) -> None:
    """`benchmarks/race` runs in environments of other packages."""
    for path in sorted((HERE / folder).rglob("*.py")):
        name = ".".join(path.relative_to(HERE).with_suffix("").parts)
        if path.stem != "__main__" and ".race" not in name:
            importlib.import_module(name.removesuffix(".__init__"))


def test_the_blind_set_and_the_gap_library_share_no_code(subtests: pytest.Subtests) -> None:
    for room, other in (("blind", "gap"), ("gap", "blind")):
        with subtests.test(str((room, other))):
            files = sorted((HERE / "psfcore" / room).rglob("*.py"))
            assert files
            wrong = [
                (str(path.relative_to(HERE)), name)
                for path in files
                for name in imports(path)
                if name == f"psfcore.{other}" or name.startswith(f"psfcore.{other}.")
            ]
            assert wrong == []


# --- no circular imports between rooms ---


PACKAGES = ("heliopsf", "psfcore", "workers", "service", "benchmarks", "studies")


def _files() -> list[Path]:
    found = [
        path.relative_to(HERE) for package in PACKAGES for path in sorted((HERE / package).rglob("*.py"))
    ]
    assert len(found) > 100
    return found


def _module(path: Path) -> str:
    parts = path.with_suffix("").parts
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


def _graphs() -> dict[str, dict[str, set[str]]]:
    """For every folder: which of its members (files and folders) import which of its other members."""
    files = _files()
    modules = {_module(path): path for path in files if path.name != "__init__.py"}
    graphs: dict[str, dict[str, set[str]]] = defaultdict(lambda: defaultdict(set))
    for path in files:
        for name in imports(HERE / path):
            target = modules.get(name)
            if target is None or target == path:
                continue
            here, there = path.parts, target.parts
            level = next(i for i, (a, b) in enumerate(zip(here, there, strict=False)) if a != b)
            graphs["/".join(here[:level]) or "."][here[level]].add(there[level])
    return graphs


def _circle(graph: dict[str, set[str]]) -> list[str]:
    """Members that are left once everything without imports inside the folder is taken away, again and again."""
    left = {name: set(targets) for name, targets in graph.items()}
    while True:
        ends = {target for targets in left.values() for target in targets} - set(left)
        free = {name for name, targets in left.items() if targets <= ends}
        if not free:
            return sorted(left)
        left = {name: targets - free for name, targets in left.items() if name not in free}


def test_a_circle_is_found() -> None:
    assert _circle({"a": {"b"}, "b": {"c"}, "d": {"a"}}) == []
    assert _circle({"a": {"b"}, "b": {"c", "a"}, "c": set()}) == ["a", "b"]


def test_no_circular_imports_at_any_level() -> None:
    circles = {level: circle for level, graph in _graphs().items() if (circle := _circle(graph))}
    assert circles == {}


def test_tests_of_one_id_are_refused(request: pytest.FixtureRequest) -> None:
    pytest_collection_modifyitems(request.config, [request.node])
    with pytest.raises(pytest.UsageError, match="test_tests_of_one_id_are_refused"):
        pytest_collection_modifyitems(request.config, [request.node, request.node])


def test_every_planted_fault_fits_the_code() -> None:
    assert [(fault.name, said) for fault in FAULTS if (said := fault.problem(HERE))] == []
