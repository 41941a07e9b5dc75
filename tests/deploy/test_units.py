"""systemd units and Kubernetes manifests fit the commands and settings; the checkers of both accept them.
The scripts for Slurm, run as Slurm runs them, with a command `heliopsf` that only says how it was called.
The Kubernetes manifests: names that match, time to stop, and as many workers as there is work."""

from __future__ import annotations

import configparser
import os
import re
import shutil
import subprocess
import time
from contextlib import ExitStack
from math import ceil
from pathlib import Path
from typing import Any

import pytest
import yaml
from click.testing import CliRunner
from sqlalchemy import text

from service.cli.main import main
from tests.whole.stack import Missing, postgres_database
from tests.workers.databases import add, change, rows
from tests.workers.jobs import bulk_row
from workers.catalogue.catalogue import Catalogue
from workers.catalogue.tables import JobRow
from workers.contract.bulk import BulkPhase
from workers.contract.jobs import Phase, Queue
from workers.settings import Settings

DEPLOY = Path(__file__).parents[2] / "deploy"


def resources(folder: Path) -> list[dict[str, Any]]:
    """The manifests that the kustomization in a folder names, and those of the folders that it names, without its
    patches."""
    kustomization = yaml.safe_load((folder / "kustomization.yaml").read_text("utf-8"))
    found: list[dict[str, Any]] = []
    for path in (folder / name for name in kustomization["resources"]):
        found += resources(path) if path.is_dir() else yaml.safe_load_all(path.read_text("utf-8"))
    for one in found:
        one["metadata"]["name"] += kustomization.get("nameSuffix", "")
    return found


UNITS = sorted((DEPLOY / "systemd").glob("*.service"))
MANIFESTS = [one for name in ("base", "migration") for one in resources(DEPLOY / "kubernetes" / name)]
WORKLOADS = [one for one in MANIFESTS if one["kind"] in ("Deployment", "StatefulSet", "Job")]
LASTING = [one for one in WORKLOADS if one["kind"] != "Job"]
COMPOSE = yaml.safe_load((DEPLOY.parent / "docker-compose.yml").read_text("utf-8"))["services"]
KNOWN = {f"HELIOPSF_{name.upper()}" for name in Settings.model_fields}
OLDEST_KUBERNETES = "1.30"  # the oldest version whose schema the manifests are checked against


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
    """Whoever hardens one unit must harden the others."""
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
    assert len(kept) == 3 and kept[0] == kept[1] == kept[2]


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
        for version in (OLDEST_KUBERNETES, validate.latest_version()):
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


# --- Slurm -----------------------------------------------------------------------------------------------


SLURM = Path(__file__).parents[2] / "deploy" / "slurm"


def called(script: str, folder: Path, *arguments: str, **variables: str) -> list[str]:
    """The words of the command `heliopsf` that the script calls, and the number of its threads."""
    stand_in = folder / "heliopsf"
    stand_in.write_text('#!/bin/bash\nprintf "%s\\n" heliopsf "$@" "$HELIOPSF_WORKER_THREADS"\n')
    stand_in.chmod(0o755)
    environment = {"PATH": f"{folder}:{os.environ['PATH']}", "HOME": str(folder), "SLURM_CPUS_PER_TASK": "8"}
    done = subprocess.run(
        ["bash", str(SLURM / script), *arguments], env=environment | variables,
        capture_output=True, text=True, check=True, timeout=60,
    )  # fmt: skip
    return done.stdout.splitlines()


def test_an_array_of_workers_runs_until_idle(tmp_path: Path) -> None:
    (tmp_path / "heliopsf.env").touch()
    *command, threads = called("workers.sh", tmp_path)
    command_exists(command[:2])
    assert command == ["heliopsf", "worker", "--until-idle", "60"] and threads == "8"


def test_the_tasks_of_an_array_share_the_images(tmp_path: Path) -> None:
    images = [tmp_path / f"image {number}.fits" for number in range(7)]
    for image in images:
        image.touch()
    shares = []
    for task in (1, 2, 3):
        array = {"SLURM_ARRAY_TASK_ID": str(task), "SLURM_ARRAY_TASK_MIN": "1", "SLURM_ARRAY_TASK_COUNT": "3"}
        words = called("images.sh", tmp_path, str(tmp_path), "out", **array)
        command_exists(words[:2])
        assert words[-4:-1] == ["-o", "out/", "--local"]
        shares.append(words[2:-4])
    assert sorted(path for share in shares for path in share) == sorted(map(str, images))
    assert [len(share) for share in shares] == [3, 2, 2]


# --- as many workers as there is work --------------------------------------------------------------------


KUBERNETES = Path(__file__).parents[2] / "deploy" / "kubernetes"
TRIGGERS = {
    one["metadata"]["name"].removeprefix("heliopsf-worker-"): one["spec"]["triggers"][0]["metadata"]
    for one in resources(KUBERNETES / "keda")
    if one["kind"] == "ScaledObject"
}
Manifest = dict[str, Any]


def rendered(name: str) -> list[Manifest]:
    """The manifests that `kubectl apply -k` sends to the cluster."""
    if shutil.which("kubectl") is None:
        pytest.skip("kubectl is not installed: only it applies the patches of the kustomizations")
    done = subprocess.run(
        ["kubectl", "kustomize", str(KUBERNETES / name)], capture_output=True, text=True, timeout=120
    )
    assert done.returncode == 0, done.stderr
    return list(yaml.safe_load_all(done.stdout))


def of_kind(manifests: list[Manifest], *kinds: str) -> dict[str, Manifest]:
    """The manifests of these kinds, by name."""
    return {one["metadata"]["name"]: one for one in manifests if one["kind"] in kinds}


def labels_of(workload: Manifest) -> dict[str, str]:
    """The labels of the pods of a workload."""
    found: dict[str, str] = workload["spec"]["template"]["metadata"]["labels"]
    return found


def is_selected(selector: Manifest, labels: dict[str, str]) -> bool:
    """Whether a selector of Kubernetes selects pods with these labels."""
    listed = all(labels.get(one["key"]) in one["values"] for one in selector.get("matchExpressions", []))
    return listed and selector.get("matchLabels", {}).items() <= labels.items()


def check_time_to_stop(manifests: list[Manifest]) -> None:
    """A pod is killed only after its process has ended by itself."""
    (config,) = of_kind(manifests, "ConfigMap").values()
    workloads = of_kind(manifests, "Deployment")
    for name in (name for name in workloads if name.startswith(("heliopsf-api", "heliopsf-worker"))):
        pod = workloads[name]["spec"]["template"]["spec"]
        known = config["data"] | {one["name"]: one.get("value") for one in pod["containers"][0]["env"]}
        settings = Settings(
            stop_s=float(known.get("HELIOPSF_STOP_S", Settings.model_fields["stop_s"].default))
        )
        assert pod["terminationGracePeriodSeconds"] > settings.gone_s, name


def check_selectors(manifests: list[Manifest]) -> None:
    """Policies, budgets and the ingress name pods, ports and services that exist."""
    pods = list(map(labels_of, of_kind(manifests, "Deployment", "StatefulSet").values()))
    for name, policy in of_kind(manifests, "NetworkPolicy").items():
        assert any(is_selected(policy["spec"]["podSelector"], pod) for pod in pods), name
        for rule in policy["spec"].get("ingress", []):
            ports = {port["port"] for port in rule["ports"]}
            assert ports <= {"http", "postgres", "redis"}, name
    for name, budget in of_kind(manifests, "PodDisruptionBudget").items():
        assert any(is_selected(budget["spec"]["selector"], pod) for pod in pods), name
    services, (config,) = of_kind(manifests, "Service"), of_kind(manifests, "ConfigMap").values()
    for ingress in of_kind(manifests, "Ingress").values():
        (rule,), (tls,) = ingress["spec"]["rules"], ingress["spec"]["tls"]
        backend = rule["http"]["paths"][0]["backend"]["service"]
        ports = {port["name"] for port in services[backend["name"]]["spec"]["ports"]}
        assert backend["port"]["name"] in ports
        assert tls["hosts"] == [rule["host"]]
        assert rule["host"] in config["data"]["HELIOPSF_ALLOWED_HOSTS"].split(",")


def test_the_base_gives_its_pods_time_and_names_what_there_is() -> None:
    for path in (one for one in KUBERNETES.rglob("*.yaml") if one.name != "kustomization.yaml"):
        kustomization = yaml.safe_load((path.parent / "kustomization.yaml").read_text("utf-8"))
        assert path.name in kustomization["resources"], path
    base = resources(KUBERNETES / "base")
    check_time_to_stop(base)
    check_selectors(base)
    stores = {"heliopsf-postgres", "heliopsf-redis"}
    part = {"app.kubernetes.io/part-of": "heliopsf"}.items()
    users = [*base, *resources(KUBERNETES / "migration")]
    for workload in of_kind(users, "Deployment", "StatefulSet", "Job").values():
        assert part <= labels_of(workload).items(), "only such pods reach the stores"
    reached = of_kind(base, "NetworkPolicy")["heliopsf-stores"]["spec"]
    assert set(reached["podSelector"]["matchExpressions"][0]["values"]) == stores
    assert of_kind(base, "Deployment")["heliopsf-api"]["spec"]["replicas"] > 1, "its budget keeps one of them"


def test_kubectl_renders_what_the_files_say() -> None:
    for name in ("base", "migration"):
        ours, theirs = (
            sorted((one["kind"], one["metadata"]["name"]) for one in found)
            for found in (resources(KUBERNETES / name), rendered(name))
        )
        assert ours == theirs


def test_the_overlay_has_a_scaled_worker_for_each_queue() -> None:
    manifests = rendered("keda")
    validate = pytest.importorskip("kubernetes_validate", reason="kubernetes-validate is not installed")
    workers = {
        name: one
        for name, one in of_kind(manifests, "Deployment").items()
        if is_selected({"matchLabels": {"app": "heliopsf-worker"}}, labels_of(one))
    }
    scaled, login = of_kind(manifests, "ScaledObject"), of_kind(manifests, "TriggerAuthentication")
    assert set(workers) == set(scaled) == {f"heliopsf-worker-{queue}" for queue in Queue}
    for queue in Queue:
        name = f"heliopsf-worker-{queue}"
        spec = workers[name]["spec"]
        assert spec["template"]["spec"]["containers"][0]["command"][-2:] == ["--queues", queue]
        assert "replicas" not in spec, "otherwise `kubectl apply` would undo the scaling"
        assert spec["selector"]["matchLabels"]["queue"] == queue
        assert scaled[name]["spec"]["scaleTargetRef"] == {"name": name}
        assert scaled[name]["spec"]["triggers"][0]["authenticationRef"]["name"] in login
    check_time_to_stop(manifests)
    check_selectors(manifests)
    for manifest in manifests:
        if "keda.sh" not in manifest["apiVersion"]:
            validate.validate(manifest, validate.latest_version(), strict=True)


def waiting(catalogue: Catalogue, queue: Queue, jobs: int, phase: Phase = Phase.QUEUED) -> None:
    """Add jobs to a queue."""
    add(catalogue, *(JobRow(
        id=f"{queue} {phase} {number}", owner="o", kind="deconvolve", parameters={}, phase=phase, queue=queue,
        request_key=f"{queue} {phase} {number}", created_at=time.time(),
    ) for number in range(jobs)))  # fmt: skip


def test_keda_counts_the_jobs_of_each_queue() -> None:
    with ExitStack() as opened:
        try:
            url = opened.enter_context(postgres_database())
        except Missing as missing:
            pytest.skip(str(missing))
        catalogue = Catalogue(Settings(database_url=url).catalogue_url)
        opened.callback(catalogue.close)
        catalogue.upgrade()

        def read(queue: Queue) -> tuple[int, int]:
            """The number that KEDA reads for a queue, and the workers that it then starts."""
            (number,) = rows(catalogue, text(TRIGGERS[queue]["query"]))
            return int(number), ceil(number / int(TRIGGERS[queue]["targetQueryValue"]))

        for queue in Queue:
            for jobs, workers in ((0, 0), (1, 1), (1000, 50 if queue == Queue.BULK else 1000)):
                waiting(catalogue, queue, max(jobs - 1, 0))
                waiting(catalogue, queue, min(jobs, 1), Phase.EXECUTING)
                waiting(catalogue, queue, 3, Phase.COMPLETED)  # does not count
                for other in set(Queue) - {queue}:
                    waiting(catalogue, other, 7)
                assert read(queue) == (jobs, workers), queue
                change(catalogue, text("DELETE FROM jobs"))
        run = bulk_row("o", total=1000, done=390, failed=10)
        ended = bulk_row("o", "ended", phase=BulkPhase.CANCELLED, total=50)
        add(catalogue, run, ended, bulk_row("o", "listing", listed=False))
        waiting(catalogue, Queue.BULK, 1)  # the turn of a run is a job too
        change(catalogue, text("UPDATE jobs SET kind = 'bulk'"))
        assert read(Queue.BULK) == (601, 31), "600 images, and a run that is being listed"
