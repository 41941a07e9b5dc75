"""The transit, solution and evidence that the tests of evidence and verdict share."""

from __future__ import annotations

import pytest

from psfcore.gap.evidence.columns import FieldColumns
from psfcore.gap.evidence.responses import Evidence, gather
from psfcore.scatter.inversion import invert
from psfcore.scatter.reconstruction import Solution
from psfcore.simulate.plan import default_plan
from psfcore.simulate.transit import simulate
from psfcore.transit.transit import Transit
from tests.psfcore.gap.linear_models import FEW
from tests.transit_files import TRUTH, diffraction


@pytest.fixture(scope="session")
def clean() -> Transit:
    plan = default_plan(9, 160, oversampling=1, brightness=4.0)
    return simulate(plan, TRUTH, diffraction(), seed=5).transit


@pytest.fixture(scope="session")
def solution(clean: Transit) -> Solution:
    return invert(clean)


@pytest.fixture(scope="session")
def evidence(solution: Solution) -> Evidence:
    return gather(solution, FEW)


@pytest.fixture(scope="session")
def columns(evidence: Evidence) -> FieldColumns:
    """The columns of the fields of the evidence, which do not depend on its residuals and effects."""
    return FieldColumns(evidence)
