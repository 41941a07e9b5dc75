"""Shares of axes."""

from __future__ import annotations

import pytest

from psfcore.gap.verdict.where import _shapley


def test_shares_are_averages_over_orders() -> None:
    worth = {(): 0.0, ("a",): 1.0, ("b",): 2.0, ("a", "b"): 2.5}
    shares = _shapley(["a", "b"], worth)
    assert shares == pytest.approx({"a": 0.75, "b": 1.75})  # (1 + 0.5) / 2 and (2 + 1.5) / 2
