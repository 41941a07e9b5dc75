"""VOSI: the documents that a registry and a client read first."""

from __future__ import annotations

from collections.abc import Callable

import pytest
from fastapi.testclient import TestClient
from vo_models.vodataservice.models import TableSet
from vo_models.vosi.availability import Availability
from vo_models.vosi.capabilities import VOSICapabilities
from vo_models.vosi.tables.models import VOSITableSet

from service.vo.columns import TABLES
from service.vo.interfaces import OFFERED
from tests.service.keyed import Keyed
from workers import checks


def test_availability(api: TestClient, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(checks, "needed", lambda *_: {})  # the worker of a test does not announce itself
    answer = api.get("/vo/availability")
    assert answer.headers["content-type"].startswith("text/xml")
    found = Availability.from_xml(answer.content)
    assert found.available and found.up_since is not None and not found.note

    def broken(*_: object) -> dict[str, Callable[[], None]]:
        def away() -> None:
            raise checks.Unusable("the broker does not answer")

        return {"broker": away}

    monkeypatch.setattr(checks, "needed", broken)
    found = Availability.from_xml(api.get("/vo/availability").content)
    assert not found.available and found.note == ["the broker does not answer"]
    assert api.get("/readyz").status_code == 503, "both read the same checks"


def test_capabilities_name_addresses_that_answer(api: TestClient) -> None:
    found = VOSICapabilities.from_xml(api.get("/vo/capabilities").content)
    addresses = {
        str(one.standard_id): str(one.interface[0].access_url[0].value)  # type: ignore[index]
        for one in found.capability
    }
    assert set(addresses) == {one.standard_id for one in OFFERED}
    for standard, address in addresses.items():
        assert address.startswith("http://testserver/")
        status = 400 if standard == "urn:heliopsf:cutout" else 200  # a cut-out without parameters
        assert api.get(address).status_code == status, standard


def test_a_service_with_keys_shows_its_interfaces_to_everybody(service: Keyed) -> None:
    for name in ("availability", "capabilities", "tables"):
        assert service.api.get(f"/vo/{name}").status_code == 200
    found = VOSICapabilities.from_xml(service.api.get("/vo/capabilities").content)
    for one in found.capability:
        [interface] = one.interface or []
        needs_key = "VOSI" not in str(one.standard_id)
        assert bool(interface.security_method) == needs_key
        if needs_key:
            refused = service.api.get(str(interface.access_url[0].value))
            assert refused.status_code == 401 and "Basic" in refused.headers["WWW-Authenticate"]


def test_tables_list_every_column(api: TestClient) -> None:
    found: TableSet = VOSITableSet.from_xml(api.get("/vo/tables").content)
    [schema] = found.tableset_schema
    assert schema.table is not None
    named = {table.table_name: [c.column_name for c in table.column or []] for table in schema.table}
    assert named == {table.name: [column.name for column in table.columns] for table in TABLES}
