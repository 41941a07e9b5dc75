"""A real gap report in the catalogue, from the small diagnosis that the tests of the gap share."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import pytest

from psfcore.gap.report import plot
from psfcore.gap.report.page import gap_page
from psfcore.gap.report.report import gap_report
from tests.psfcore.gap import small_gaps
from workers.catalogue.catalogue import Catalogue
from workers.catalogue.tables import DEFAULT_OWNER
from workers.files.store import Store
from workers.settings import Settings
from workers.tasks.context import Context
from workers.tasks.results import add_report, keep_page, write_json

GAP_ID = "9a" * 32


def keep_gap_report(settings: Settings, owner: str = DEFAULT_OWNER, *, old: bool = False) -> dict[str, Any]:
    """Add the report GAP_ID of an owner to the catalogue, as the job gap-diagnose does; returns its JSON.

    old: as a version did that kept the page in one file alone.
    """
    found = small_gaps.found()
    said = gap_report(found)
    with pytest.MonkeyPatch.context() as patched:
        patched.setattr(plot, "PLOT_DPI", 40)  # quicker to draw
        drawn = gap_page(found, said)
    catalogue, store = Catalogue(settings.catalogue_url), Store(settings.data_dir)
    context = cast(Context, SimpleNamespace(owner=owner, store=store, add=catalogue.add))
    named = keep_page(drawn, store)
    with store.temporary() as text:
        write_json(text, said)
        files = {"page_sha256": named["page_sha256"]} if old else named
        add_report(context, GAP_ID, "gap", text=text, details={"sentence": said["sentence"], **files})
    catalogue.close()
    return said


def settings_of(data_dir: Path) -> Settings:
    """The settings of a local service in this folder."""
    return Settings(data_dir=data_dir, database_url=None, broker_url="filesystem://")
