"""The environments of the packages that `make bench-peers` times beside heliopsf: one for each package.

    python -m benchmarks.race.environments

makes the missing ones in `.venv-peers/NAME`. numpy and scipy have the versions of constraints.txt in all of them.
"""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

REPOSITORY = Path(__file__).parents[2]
FOLDER = REPOSITORY / ".venv-peers"
# PyTorch is pinned because a new release would be a download of gigabytes; any version works.
REQUIREMENTS: dict[str, tuple[str, ...]] = {
    "scipy": ("scipy",),
    "pyfftw": ("pyfftw>=0.14",),
    "ducc0": ("ducc0>=0.37",),
    "jax": ("jax>=0.4",),
    "torch": ("torch==2.13.0",),
    "scikit-image": ("scikit-image>=0.24",),
    "aiapy": ("aiapy>=0.9",),
}


def python_of(environment: str) -> str:
    """The interpreter of an environment; that of this process if the name is empty (heliopsf itself)."""
    return str(FOLDER / environment / "bin" / "python") if environment else sys.executable


def make(environment: str) -> None:
    """Make an environment, unless it is complete. Raises subprocess.CalledProcessError if pip fails."""
    done = FOLDER / environment / ".installed"
    wanted = " ".join(REQUIREMENTS[environment])
    if done.is_file() and done.read_text("utf-8") == wanted:
        return
    subprocess.run([sys.executable, "-m", "venv", str(FOLDER / environment)], check=True)
    pip = [python_of(environment), "-m", "pip", "install", "--quiet", "--disable-pip-version-check"]
    constraints = ["-c", str(REPOSITORY / "constraints.txt")]
    subprocess.run([*pip, *constraints, "numpy", "scipy", *REQUIREMENTS[environment]], check=True)
    done.write_text(wanted, "utf-8")


if __name__ == "__main__":
    for name in REQUIREMENTS:
        make(name)
