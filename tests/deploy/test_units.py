"""systemd units and Kubernetes manifests fit the commands and settings; the checkers of both accept them."""

from __future__ import annotations

import configparser
import re
import shutil
import subprocess
from pathlib import Path
from typing import Any

import pytest
import yaml
from click.testing import CliRunner

from service.cli.main import main
from workers.settings import Settings

DEPLOY = Path(__file__).parents[2] / "deploy"


def resources(folder: Path) -> list[dict[str, Any]]:
    """The manifests that the kustomization in a folder names, and those of the folders that it names, without its patches."""
    named = yaml.safe_load((folder / "kustomization.yaml").read_text("utf-8"))["resources"]
    found: list[dict[str, Any]] = []
    for path in (folder / name for name in named):
        found += resources(path) if path.is_dir() else yaml.safe_load_all(path.read_text("utf-8"))
    return found


UNITS = sorted((DEPLOY / "systemd").glob("*.service"))
MANIFESTS = [one for name in ("base", "migration") for one in resources(DEPLOY / "kubernetes" / name)]
WORKLOADS = [one for one in MANIFESTS if one["kind"] in ("Deployment", "StatefulSet", "Job")]
LASTING = [one for one in WORKLOADS if one["kind"] != "Job"]
COMPOSE = yaml.safe_load((DEPLOY.parent / "docker-compose.yml").read_text("utf-8"))["services"]
KNOWN = {f"HELIOPSF_{name.upper()}" for name in Settings.model_fields}
KUBERNETES = "1.30"  # the oldest version whose schema the manifests are checked against


def command_exists(words: list[str]) -> None:
    """The command, with its options, is one of heliopsf."""
    assert Path(words[0]).name == "heliopsf"
    done = CliRunner().invoke(main, [*words[1:], "--help"])
    assert done.exit_code == 0, done.output


def assignments(unit: Path, key: str) -> list[str]:
    """All values of a key of a unit, in order."""
    return re.findall(rf"^{key}=(.*)$", unit.read_text("utf-8"), flags=re.M)


def test_a_unit_runs_a_command_that_exists_with_settings_that_exist() -> None:
    for unit in UNITS:
        (command,) = assignments(unit, "ExecStart")
        command_exists(command.split())
        words = " ".join(assignments(unit, "Environment")).split()
        assert {word.split("=")[0] for word in words if word.startswith("HELIOPSF_")} <= KNOWN, unit
    lines = (DEPLOY / "systemd" / "example.env").read_text("utf-8").splitlines()
    names = {line.split("=")[0] for line in lines if line and not line.startswith("#")}
    assert names and names <= KNOWN


def test_the_units_differ_only_in_what_they_run() -> None:
    """Whoever hardens one unit must harden the other."""
    own = {"Description", "ExecStart", "Environment", "TimeoutStopSec", "UMask", "MemoryMax"}
    kept = []
    for unit in UNITS:
        parser = configparser.RawConfigParser(strict=False)
        parser.optionxform = str  # type: ignore[assignment,method-assign]
        parser.read(unit)
        kept.append({name: dict(parser[name]) for name in parser.sections()})
        for section in kept[-1].values():
            for key in own & set(section):
                del section[key]
    assert len(kept) == 2 and kept[0] == kept[1]


def test_systemd_accepts_the_units_and_finds_them_guarded(tmp_path: Path) -> None:
    binary = shutil.which("systemd-analyze")
    if binary is None:
        pytest.skip("systemd-analyze is not installed (Debian: the package systemd contains it)")
    for unit in UNITS:  # the command of the unit is not installed here; another takes its place
        text = re.sub(r"^ExecStart=\S+", "ExecStart=/bin/true", unit.read_text("utf-8"), flags=re.M)
        (tmp_path / unit.name).write_text(text)
    units = [str(tmp_path / unit.name) for unit in UNITS]
    done = subprocess.run([binary, "verify", "--man=no", *units], capture_output=True, text=True, timeout=120)
    assert (done.returncode, done.stdout + done.stderr) == (0, "")
    offline = ["security", "--offline=true", "--threshold=20", "--no-pager"]  # 20: exposure 2.0 of 10
    done = subprocess.run([binary, *offline, *units], capture_output=True, text=True, timeout=120)
    if "unrecognized option" in done.stderr or "Unknown" in done.stderr:
        pytest.skip("this systemd-analyze cannot judge units offline; version 250 can")
    assert done.returncode == 0, done.stdout[-2000:] + done.stderr


def containers(workload: dict[str, Any]) -> list[dict[str, Any]]:
    found: list[dict[str, Any]] = workload["spec"]["template"]["spec"]["containers"]
    return found


def test_kubernetes_accepts_the_manifests() -> None:
    validate = pytest.importorskip("kubernetes_validate", reason="kubernetes-validate is not installed")
    for manifest in MANIFESTS:
        for version in (KUBERNETES, validate.latest_version()):
            validate.validate(manifest, version, strict=True)


def test_the_manifests_have_the_parts_and_the_images_of_compose() -> None:
    images = {
        one["metadata"]["name"].removeprefix("heliopsf-"): containers(one)[0]["image"] for one in LASTING
    }
    # In a cluster, the Ingress takes the place of the proxy.
    assert images == {name: service["image"] for name, service in COMPOSE.items() if name != "proxy"}


def test_the_manifests_run_commands_and_name_settings_that_exist() -> None:
    (config,) = (one for one in MANIFESTS if one["kind"] == "ConfigMap")
    assert set(config["data"]) <= KNOWN
    for workload in WORKLOADS:
        for container in containers(workload):
            names = {one["name"] for one in container.get("env", [])}
            assert {name for name in names if name.startswith("HELIOPSF_")} <= KNOWN
            for variable in container.get("env", []):  # $(NAME) refers to a variable further up
                assert set(re.findall(r"\$\((\w+)\)", variable.get("value", ""))) <= names
            if container["image"].startswith("heliopsf"):
                command_exists(container["command"])


def test_every_service_leads_to_a_port_of_a_workload() -> None:
    ports = {
        (one["spec"]["template"]["metadata"]["labels"]["app"], port["name"]): port["containerPort"]
        for one in LASTING
        for container in containers(one)
        for port in container.get("ports", [])
    }
    for service in (one for one in MANIFESTS if one["kind"] == "Service"):
        for port in service["spec"]["ports"]:
            assert (service["spec"]["selector"]["app"], port["targetPort"]) in ports
    for workload in LASTING:
        labels = workload["spec"]["template"]["metadata"]["labels"]
        assert workload["spec"]["selector"]["matchLabels"].items() <= labels.items()


def test_pods_have_no_more_rights_and_memory_than_they_need() -> None:
    for workload in WORKLOADS:
        pod, name = workload["spec"]["template"]["spec"], workload["metadata"]["name"]
        assert pod["securityContext"]["runAsNonRoot"] is True, name
        assert pod["automountServiceAccountToken"] is False, name
        for container in pod["containers"]:
            guarded = container["securityContext"]
            assert guarded["allowPrivilegeEscalation"] is False, name
            assert guarded["readOnlyRootFilesystem"] is True, name
            assert guarded["capabilities"] == {"drop": ["ALL"]}, name
            assert container["resources"]["limits"]["memory"], name
            mounted = {mount["name"] for mount in container["volumeMounts"]}
            claimed = {one["metadata"]["name"] for one in workload["spec"].get("volumeClaimTemplates", [])}
            assert mounted == {volume["name"] for volume in pod["volumes"]} | claimed, name


def test_a_worker_gets_the_memory_of_its_jobs() -> None:
    """A worker needs 2 GiB more than the largest job, as in the Compose file."""
    (config,) = (one for one in MANIFESTS if one["kind"] == "ConfigMap")
    (worker,) = (one for one in WORKLOADS if one["metadata"]["name"] == "heliopsf-worker")
    limit_gib = int(containers(worker)[0]["resources"]["limits"]["memory"].removesuffix("Gi"))
    assert limit_gib * 1024 >= int(config["data"]["HELIOPSF_MAX_JOB_MEMORY_MIB"]) + 2048
    (unit,) = (unit for unit in UNITS if unit.stem == "heliopsf-worker")
    (limit,) = assignments(unit, "MemoryMax")
    environment = (DEPLOY / "systemd" / "example.env").read_text("utf-8")
    job_mib = int(re.findall(r"HELIOPSF_MAX_JOB_MEMORY_MIB=(\d+)", environment)[0])
    assert int(limit.removesuffix("G")) * 1024 >= job_mib + 2048
