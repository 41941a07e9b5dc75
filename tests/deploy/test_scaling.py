"""The Kubernetes manifests: names that match, time to stop, and as many workers as there is work."""

from __future__ import annotations

import shutil
import subprocess
import time
from contextlib import ExitStack
from math import ceil
from pathlib import Path
from typing import Any

import pytest
import yaml
from sqlalchemy import text

from tests.deploy.test_units import resources
from tests.whole.stack import Missing, postgres_database
from tests.workers.databases import add, change, rows
from tests.workers.jobs import bulk_row
from workers.catalogue.catalogue import Catalogue
from workers.catalogue.tables import JobRow
from workers.contract.bulk import BulkPhase
from workers.contract.jobs import Phase, Queue
from workers.settings import Settings

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
