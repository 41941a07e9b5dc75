"""The entry point of the command ``heliopsf``."""

from __future__ import annotations

import sys
import time

from psfcore.errors import MissingExtra, module_of_extra

STARTED = time.perf_counter()  # when the command began, before the libraries are loaded


def main() -> None:
    """Run the command. If the packages of the extra "service" are missing, the exit status is 1 and one line says how to install them."""
    try:
        command = module_of_extra("service", "service.cli.main").main
    except MissingExtra as error:
        sys.exit(f"Error: {error}")
    command()
