"""Lineage as W3C PROV, over HTTP."""

from __future__ import annotations

import sys
from pathlib import Path

import prov
import pytest
from fastapi.testclient import TestClient
from prov.model import ProvDocument, ProvEntity
from prov.scripts.convert import main as prov_convert

from tests.service.conftest import refusal
from tests.service.vo.made import ENDED_AT, STARTED_AT, add_product
from tests.workers.psf_examples import identity, product, psf
from workers.catalogue.catalogue import Catalogue
from workers.lineage import provenance, provenance_text


def read(text: str) -> ProvDocument:
    """The document that the package prov reads. It raises an error for text that is not PROV."""
    return prov.read(text if isinstance(text, bytes) else text.encode())


def named(document: ProvDocument, name: str) -> list[dict[str, list[str]]]:
    """The attributes of the records with this name."""
    return [
        {str(key): sorted(map(str, values)) for key, values in _attributes(record).items()}
        for record in document.get_record(name)
    ]


def _attributes(record: ProvEntity) -> dict[object, set[object]]:
    return {key: set(record.get_attribute(key)) for key, _ in record.attributes}


def relations(document: ProvDocument, kind: str) -> set[tuple[str, ...]]:
    """The first two names of every relation of a kind, such as ``Usage``."""
    return {
        tuple(str(value) for value in record.args[:2])
        for record in document.get_records()
        if type(record).__name__ == f"Prov{kind}"
    }


def test_a_product_s_provenance(api: TestClient, tmp_path: Path) -> None:
    ids = add_product(api, tmp_path)
    here = f"/v1/products/{ids['product']}/provenance"
    as_json, as_provn = api.get(here), api.get(f"{here}?format=provn")
    assert as_json.headers["content-type"] == "application/json"
    assert as_provn.headers["content-type"].startswith("text/provenance-notation")
    document = read(as_json.text)
    assert document == read(as_provn.text), "both say the same"
    names = {thing: f"{thing}:{ids[thing]}" for thing in ("product", "psf", "image", "job")}
    [made] = named(document, names["product"])
    digest = api.get(f"/v1/products/{ids['product']}").json()["sha256"]
    assert made["heliopsf:sha256"] == [digest] and "voprov:DatasetEntity" in made["prov:type"]
    [job] = document.get_record(names["job"])
    assert (job.get_startTime().timestamp(), job.get_endTime().timestamp()) == (STARTED_AT, ENDED_AT)
    assert relations(document, "Generation") == {(names["product"], names["job"])}
    assert relations(document, "Usage") == {(names["job"], names["image"]), (names["job"], names["psf"])}
    assert relations(document, "Derivation") == {
        (names["product"], names["image"]),
        (names["product"], names["psf"]),
    }
    [parameter] = named(document, f"parameter:{ids['job']}.method")
    assert parameter["prov:value"] == ['{"name": "linear", "steps": 2}']
    agents = {agent for _, agent in relations(document, "Association")}
    [software] = agents - {"owner:local"}
    [told] = named(document, software)
    assert told["heliopsf:library"] == ["astropy 8.0.2", "numpy 2.4.6"]
    attributed = {entity for entity, _ in relations(document, "Attribution")}
    assert attributed == {names["product"], names["image"], names["psf"]}
    assert "Generation" not in str(named(document, names["psf"])), "an upload has no activity"


def test_prov_convert_reads_both_forms(
    api: TestClient, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    ids = add_product(api, tmp_path)
    wrong = api.get(f"/v1/products/{ids['product']}/provenance?format=xml")
    assert "'json' or 'provn'" in refusal(wrong, 422, "invalid-request")
    for of in ("product", "psf"):
        refusal(api.get(f"/v1/{of}s/{'f' * 64}/provenance"), 404, f"no-such-{of}")
    for of, form, other in (
        ("product", "json", "provn"),
        ("product", "provn", "json"),
        ("psf", "json", "provn"),
    ):
        text = api.get(f"/v1/{of}s/{ids[of]}/provenance?format={form}").text
        (tmp_path / f"in.{form}").write_text(text)
        out = tmp_path / f"{of}-{form}.{other}"
        words = ["prov-convert", "-i", form, "-f", other, str(tmp_path / f"in.{form}"), str(out)]
        monkeypatch.setattr(sys, "argv", words)
        assert not prov_convert()
        assert read(out.read_text()) == read(text)


def test_generations_weights_and_deleted_parents(tmp_path: Path) -> None:
    """An interpolated PSF, its two ends, of which one was deleted, and a transit."""
    catalogue = Catalogue(f"sqlite:///{tmp_path / 'c.sqlite'}")
    catalogue.upgrade()
    made = {"provenance": {"software_version": "0.1.0"}, "transit_id": identity("transit")}
    catalogue.add(psf("early", origin="fitted", details=made))
    ends = {"before": identity("early"), "after": identity("late")}
    weights = {identity("early"): 0.25, identity("late"): 0.75}
    between = psf("between", origin="interpolated", details={"parents": ends, "weights": weights})
    catalogue.add(between)
    image = product("image", "between")
    catalogue.add(image)
    for row in (between, image):
        document = provenance(catalogue, row)
        for form in ("json", "provn"):
            assert read(provenance_text(catalogue, row, form)) == document
    usages = {
        str(record.args[1]): record.get_attribute("heliopsf:weight")
        for record in document.get_records()
        if type(record).__name__ == "ProvUsage"
    }
    assert usages[f"psf:{identity('early')}"] == {0.25} and usages[f"psf:{identity('late')}"] == {0.75}
    assert f"transit:{identity('transit')}" in usages
    [late] = named(document, f"psf:{identity('late')}")
    assert late["heliopsf:deleted"] == ["True"] and "heliopsf:sha256" not in late
    catalogue.close()
