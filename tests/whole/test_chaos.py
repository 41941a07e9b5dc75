"""A little of `make chaos`: jobs while what they need is killed."""

from __future__ import annotations

import pytest

from studies import chaos
from tests.whole.stack import Missing


@pytest.mark.slow
@pytest.mark.parametrize("redis_keeps", [False, True])
def test_nothing_is_lost_or_made_twice(redis_keeps: bool) -> None:
    try:
        found = chaos.run(20, 5, 128, seed=3, redis_keeps=redis_keeps)
    except Missing as missing:
        pytest.skip(str(missing))
    assert found["jobs"] == found["products"] == 20
    assert sum(count for name, count in found.items() if name.startswith("kills of ")) == 5
