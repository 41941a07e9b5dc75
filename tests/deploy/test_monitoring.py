"""Dashboard and alerts: every metric, label and state that they name is exported by the service."""

from __future__ import annotations

import json
import re
import shutil
import subprocess
from collections import defaultdict
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import yaml
from fastapi.testclient import TestClient
from prometheus_client.parser import text_string_to_metric_families

from service.app import create_app
from tests.conftest import write_image
from tests.service.conftest import upload
from workers.catalogue.catalogue import Catalogue
from workers.settings import Settings
from workers.stage_timer import StageTime

DEPLOY = Path(__file__).parents[2] / "deploy"
DASHBOARD = json.loads((DEPLOY / "grafana" / "heliopsf.json").read_text("utf-8"))
ALERTS = yaml.safe_load((DEPLOY / "prometheus" / "alerts.yml").read_text("utf-8"))
PANELS: list[dict[str, Any]] = [panel for panel in DASHBOARD["panels"] if panel["type"] != "row"]
RULES: list[dict[str, Any]] = [rule for group in ALERTS["groups"] for rule in group["rules"]]
EXPRESSIONS = [target["expr"] for panel in PANELS for target in panel["targets"]] + [
    rule["expr"] for rule in RULES
]
OF_PROMETHEUS = {"up"}  # written by Prometheus itself
TARGET_LABELS = {"job", "instance"}  # added by Prometheus to every sample


@pytest.fixture(scope="module")
def exported(tmp_path_factory: pytest.TempPathFactory) -> dict[str, dict[str, set[str]]]:
    """The values of each label by the name of the sample, from a service with an upload and a job."""
    folder = tmp_path_factory.mktemp("service")
    write_image(folder / "image.fits")
    settings = Settings(data_dir=folder / "data", broker_url="filesystem://", allowed_hosts="testserver")
    with TestClient(create_app(settings)) as api:
        upload(api, folder / "image.fits")
        catalogue = Catalogue(settings.catalogue_url)  # as a worker would write it
        catalogue.stage_times.add("deconvolve", {"reading": StageTime(seconds=1.0, steps=1)})
        catalogue.close()
        api.get("/v1/jobs").raise_for_status()
        answer = api.get("/metrics").text
    found: dict[str, dict[str, set[str]]] = defaultdict(lambda: defaultdict(set))
    for family in text_string_to_metric_families(answer):
        for sample in family.samples:
            found[sample.name]
            for label, value in sample.labels.items():
                found[sample.name][label].add(value)
    return found


def selectors(expression: str) -> Iterator[tuple[str, list[tuple[str, str, str]]]]:
    """The metrics that an expression selects, with the (label, operator, value) of their conditions."""
    for name, conditions in re.findall(r'\b(heliopsf_\w+|up)\b(?:\{((?:[^"}]|"[^"]*")*)\})?', expression):
        yield name, re.findall(r'(\w+)\s*(=~|!~|!=|=)\s*"([^"]*)"', conditions)


def grouped(expression: str) -> set[str]:
    """The labels in `by (...)` and `without (...)`."""
    lists = re.findall(r"\b(?:by|without)\s*\(([^)]*)\)", expression)
    return {label.strip() for labels in lists for label in labels.split(",")}


def test_the_service_exports_what_an_expression_names(exported: dict[str, dict[str, set[str]]]) -> None:
    for expression in EXPRESSIONS:
        named = list(selectors(expression))
        assert named, expression
        known = {"le"} | TARGET_LABELS
        for name, conditions in (one for one in named if one[0] not in OF_PROMETHEUS):
            labels = exported.get(name)
            assert labels is not None, f"the service exports no metric {name}"
            known |= set(labels)
            for label, operator, value in conditions:
                if label in TARGET_LABELS:
                    continue
                assert label in labels, f"{name} has no label {label}"
                if operator == "=" or (operator == "=~" and label in ("phase", "queue")):
                    assert set(value.split("|")) <= labels[label], (name, label, value)
        assert grouped(expression) <= known, expression


def test_every_number_that_describes_the_whole_service_is_taken_once() -> None:
    """Each server exports the numbers of the database: to add them would count them once for each server."""
    once = re.compile(r"heliopsf_(jobs|job_|workers|files|file_|bulk_images|oldest|jobs_silent)")
    for expression in filter(once.search, EXPRESSIONS):
        assert re.search(r"\b(max|min) ?(by ?)?\(", expression), expression


def test_every_alert_says_what_to_do_has_a_case_and_names_routes_that_exist() -> None:
    tested = (DEPLOY / "prometheus" / "alerts_test.yml").read_text("utf-8")
    assert len({rule["alert"] for rule in RULES}) == len(RULES)
    for rule in RULES:
        assert set(rule["annotations"]) == {"summary", "action"}, rule["alert"]
        assert rule["labels"]["severity"] in ("warning", "critical"), rule["alert"]
        assert rule["alert"] in tested
    (expression,) = (rule["expr"] for rule in RULES if rule["alert"] == "HeliopsfSlowAnswers")
    described = json.loads((DEPLOY.parent / "openapi" / "openapi.json").read_text("utf-8"))["paths"]
    routes = [v for _, cs in selectors(expression) for label, _, v in cs if label == "route"]
    assert routes and [one for route in routes for one in route.split("|") if one not in described] == []


def test_prometheus_accepts_rules_configuration_and_dashboard_and_alerts_fire_when_they_should(
    tmp_path: Path,
) -> None:
    binary = shutil.which("promtool")
    if binary is None:
        pytest.skip("promtool is not installed (Debian: the package prometheus contains it)")

    def run(*arguments: str) -> str:
        done = subprocess.run(
            [binary, *arguments], cwd=DEPLOY / "prometheus", capture_output=True, text=True, timeout=120
        )
        assert done.returncode == 0, done.stdout + done.stderr
        return done.stdout

    assert f"{len(RULES)} rules found" in run("check", "rules", "alerts.yml")
    run("check", "config", "--syntax-only", "prometheus.yml")
    run("test", "rules", "alerts_test.yml")
    rules = [
        {"record": f"panel:{number}", "expr": target["expr"].replace("$job", "heliopsf")}
        for number, target in enumerate(target for panel in PANELS for target in panel["targets"])
    ]
    file = tmp_path / "dashboard.yml"
    file.write_text(yaml.safe_dump({"groups": [{"name": "dashboard", "rules": rules}]}))
    assert f"{len(rules)} rules found" in run("check", "rules", str(file))
