"""A real gap report in the catalogue, from the small diagnosis that the tests of the gap share."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from psfcore.gap.report import plot
from psfcore.gap.report.page import gap_page
from psfcore.gap.report.report import gap_report
from tests.psfcore.gap import small_gaps
from workers.catalogue.catalogue import Catalogue
from workers.catalogue.tables import DEFAULT_OWNER
from workers.files.store import Store
from workers.settings import Settings
from workers.tasks.catalogue_workspace import CatalogueWorkspace
from workers.tasks.results import report_result

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
    workspace = CatalogueWorkspace(catalogue, store, settings, owner, "j", lambda *_: None)
    result = report_result(GAP_ID, "gap", said, {"sentence": said["sentence"]}, page=lambda: drawn)
    if old:
        files = {name: result.files[name] for name in ("file", "html")}
        result = replace(result, files=files, figures=lambda: ())
    workspace.add(result)
    catalogue.close()
    return said


def settings_of(data_dir: Path) -> Settings:
    """The settings of a local service in this folder."""
    return Settings(data_dir=data_dir, database_url=None, broker_url="filesystem://")
