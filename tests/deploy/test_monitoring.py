"""Dashboard and alerts: every metric, label and state that they name is exported by the service."""

from __future__ import annotations

import json
import re
import shutil
import subprocess
from collections import defaultdict
from collections.abc import Callable, Iterator
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
from workers.stage_timer import Spent

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
        catalogue.stage_times.add("deconvolve", {"reading": Spent(seconds=1.0, steps=1)})
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


def test_the_conditions_of_a_metric_are_found() -> None:
    expression = 'sum by (a, b) (heliopsf_x{route=~"/v1/{id}|y",c!="d"}) / heliopsf_y'
    expected = [("heliopsf_x", [("route", "=~", "/v1/{id}|y"), ("c", "!=", "d")]), ("heliopsf_y", [])]
    assert list(selectors(expression)) == expected
    assert grouped(expression) == {"a", "b"}


def test_the_service_exports_what_an_expression_names(
    subtests: pytest.Subtests, exported: dict[str, dict[str, set[str]]]
) -> None:
    for expression in EXPRESSIONS:
        with subtests.test(str(expression)):
            named = list(selectors(expression))
            assert named
            known = {"le"} | TARGET_LABELS
            for name, conditions in named:
                if name in OF_PROMETHEUS:
                    continue
                assert name in exported, f"the service exports no metric {name}"
                known |= set(exported[name])
                for label, operator, value in conditions:
                    if label in TARGET_LABELS:
                        continue
                    assert label in exported[name], f"{name} has no label {label}"
                    if operator == "=":
                        assert value in exported[name][label], (
                            f"{name} is never exported with {label}={value}"
                        )
            assert grouped(expression) <= known


def test_each_alternative_of_a_phase_or_queue_exists(
    subtests: pytest.Subtests, exported: dict[str, dict[str, set[str]]]
) -> None:
    for expression in [one for one in EXPRESSIONS if "phase=~" in one or "queue=~" in one]:
        with subtests.test(str(expression)):
            for name, conditions in selectors(expression):
                for label, operator, value in conditions:
                    if operator == "=~" and label in ("phase", "queue"):
                        assert set(value.split("|")) <= exported[name][label]


def test_the_alert_of_slow_answers_names_routes_that_exist() -> None:
    (expression,) = (rule["expr"] for rule in RULES if rule["alert"] == "HeliopsfSlowAnswers")
    described = json.loads((DEPLOY.parent / "openapi" / "openapi.json").read_text("utf-8"))["paths"]
    routes = [v for _, cs in selectors(expression) for label, _, v in cs if label == "route"]
    assert [one for route in routes for one in route.split("|") if one not in described] == []


def test_every_number_that_describes_the_whole_service_is_taken_once() -> None:
    """Each server exports the numbers of the database: to add them would count them once for each server."""
    once = re.compile(r"heliopsf_(jobs|job_|workers|files|file_|bulk_images|oldest|jobs_silent)")
    for expression in filter(once.search, EXPRESSIONS):
        assert re.search(r"\b(max|min) ?(by ?)?\(", expression), expression


def test_every_alert_says_what_happened_and_what_to_do() -> None:
    assert len({rule["alert"] for rule in RULES}) == len(RULES)
    for rule in RULES:
        assert set(rule["annotations"]) == {"summary", "action"}, rule["alert"]
        assert rule["labels"]["severity"] in ("warning", "critical"), rule["alert"]


def test_panels_have_titles_of_their_own_and_do_not_overlap() -> None:
    ids = [panel["id"] for panel in DASHBOARD["panels"]]
    assert len(set(ids)) == len(ids)
    cells: set[tuple[int, int]] = set()
    for panel in DASHBOARD["panels"]:
        place = panel["gridPos"]
        assert place["x"] + place["w"] <= 24 and panel["title"], panel["id"]
        own = {
            (place["x"] + column, place["y"] + line)
            for column in range(place["w"])
            for line in range(place["h"])
        }
        assert not own & cells, panel["title"]
        cells |= own


@pytest.fixture
def promtool() -> Callable[..., str]:
    binary = shutil.which("promtool")
    if binary is None:
        pytest.skip("promtool is not installed (Debian: the package prometheus contains it)")

    def run(*arguments: str) -> str:
        done = subprocess.run(
            [binary, *arguments], cwd=DEPLOY / "prometheus", capture_output=True, text=True, timeout=120
        )
        assert done.returncode == 0, done.stdout + done.stderr
        return done.stdout

    return run


def test_prometheus_accepts_the_rules_and_the_configuration(promtool: Callable[..., str]) -> None:
    assert f"{len(RULES)} rules found" in promtool("check", "rules", "alerts.yml")
    promtool("check", "config", "--syntax-only", "prometheus.yml")


def test_alerts_fire_when_they_should_and_only_then(promtool: Callable[..., str]) -> None:
    promtool("test", "rules", "alerts_test.yml")
    tested = (DEPLOY / "prometheus" / "alerts_test.yml").read_text("utf-8")
    assert [rule["alert"] for rule in RULES if rule["alert"] not in tested] == []


def test_prometheus_can_parse_every_expression_of_the_dashboard(
    promtool: Callable[..., str], tmp_path: Path
) -> None:
    rules = [
        {"record": f"panel:{number}", "expr": target["expr"].replace("$job", "heliopsf")}
        for number, target in enumerate(target for panel in PANELS for target in panel["targets"])
    ]
    file = tmp_path / "dashboard.yml"
    file.write_text(yaml.safe_dump({"groups": [{"name": "dashboard", "rules": rules}]}))
    assert f"{len(rules)} rules found" in promtool("check", "rules", str(file))
