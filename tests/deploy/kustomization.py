"""Reads the resources of a kustomization, without its patches."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import yaml


def resources(folder: Path) -> list[dict[str, Any]]:
    """The manifests that the kustomization in a folder names, and those of the folders that it names."""
    named = yaml.safe_load((folder / "kustomization.yaml").read_text("utf-8"))["resources"]
    found: list[dict[str, Any]] = []
    for path in (folder / name for name in named):
        found += resources(path) if path.is_dir() else yaml.safe_load_all(path.read_text("utf-8"))
    return found
