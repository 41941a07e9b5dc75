"""Writes the OpenAPI description: ``python -m service.openapi openapi/openapi.json``."""

from __future__ import annotations

import json
import sys
from pathlib import Path

from service.app import create_app
from workers.settings import Settings


def description() -> str:
    """The OpenAPI document as text, as stored in ``openapi/``."""
    return json.dumps(create_app(Settings()).openapi(), indent=1, sort_keys=True) + "\n"


if __name__ == "__main__":
    Path(sys.argv[1]).write_text(description())
