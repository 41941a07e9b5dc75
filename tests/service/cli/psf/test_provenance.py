"""``heliopsf psf lineage --prov FILE``."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import prov
from fastapi.testclient import TestClient

from tests.service.vo.made import add_product


def test_both_forms_are_written(api: TestClient, tmp_path: Path, command: Callable[..., str]) -> None:
    ids = add_product(api, tmp_path)
    for name in ("l.json", "l.provn"):
        out = command("psf", "lineage", ids["product"][-64:], "--product", "--prov", tmp_path / name)
        assert out.startswith("product ")
        assert len(prov.read((tmp_path / name).read_bytes()).get_record(f"product:{ids['product']}")) == 1
    assert (tmp_path / "l.provn").read_text().startswith("document")
    again = command("psf", "lineage", ids["psf"], "--prov", tmp_path / "l.json", code=1)
    assert "--overwrite" in again
