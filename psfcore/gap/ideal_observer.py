"""A program that computes what an ideal observer could know about a simulated transit (`psfcore.gap.evidence.ideal`).

    python -m psfcore.gap.ideal_observer FOLDER FILE.json

FOLDER/with_effects and FOLDER/without_effects are transits of noise-free images (DN, fractions allowed), with the noise figures
that images of this transit have. It is a separate program, so that the code that simulated the transit and the gap
library share nothing.
"""

from __future__ import annotations

import json
import sys
from collections.abc import Sequence
from pathlib import Path

from psfcore.build import known_diffraction
from psfcore.errors import DataError
from psfcore.fits.blocks import FitsLimits
from psfcore.gap.evidence.ideal import ideal_observer
from psfcore.gap.library.registry import LIBRARY
from psfcore.transit.folder import read_transit
from psfcore.transit.transit import Transit
from psfcore.whole_files import write_whole

LIMITS = FitsLimits(max_pixels=2**26)


def main(arguments: Sequence[str]) -> int:
    """Run the program. Returns the exit status."""
    if len(arguments) != 2:
        print(f"expected two arguments, a folder and a JSON file; got {len(arguments)}", file=sys.stderr)
        return 2
    folder, file = (Path(one) for one in arguments)
    try:
        found = ideal_observer(_read(folder / "with_effects"), _read(folder / "without_effects"), LIBRARY)
    except DataError as error:
        print(f"{error.code}: {error.message}", file=sys.stderr)
        return 1
    write_whole(file, json.dumps(found.to_json(), allow_nan=False))
    return 0


def _read(folder: Path) -> Transit:
    return read_transit(
        folder,
        LIMITS,
        diffraction=lambda instrument, _shape: known_diffraction(instrument, threads=1),
    )


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
