"""The version of the installed package."""

from __future__ import annotations

from importlib.metadata import version


def software_version() -> str:
    """Version of the installed package, as recorded in products."""
    return version("heliopsf")
