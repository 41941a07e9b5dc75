"""The entry point of the command ``heliopsf``."""

from __future__ import annotations

import atexit
import gc
import time
from importlib import import_module

STARTED = time.perf_counter()  # when the command began, before the libraries are loaded
# Libraries make many objects when they are loaded, and hardly any garbage. With Python's own value (700), the collector
# would look for garbage about a thousand times in the meantime.
NEW_OBJECTS = 50_000


def main() -> None:
    """Run the command."""
    gc.set_threshold(NEW_OBJECTS)
    # At its end, Python would search all objects for garbage, although their memory is given back with the process.
    atexit.register(gc.freeze)
    import_module("service.cli.main").main()
