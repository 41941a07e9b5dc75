"""The entry point of the command ``heliopsf``."""

from __future__ import annotations

import gc
import sys
import time

from psfcore.errors import MissingExtra, module_of_extra

STARTED = time.perf_counter()  # when the command began, before the libraries are loaded
# Libraries make many objects when they are loaded, and hardly any garbage. With Python's own value (700), the collector would
# look for garbage about a thousand times in the meantime.
NEW_OBJECTS = 50_000


def main() -> None:
    """Run the command. If the packages of the extra "service" are missing, the exit status is 1 and one line says how to install them."""
    gc.set_threshold(NEW_OBJECTS)
    try:
        command = module_of_extra("service", "service.cli.main").main
    except MissingExtra as error:
        sys.exit(f"Error: {error}")
    command()
