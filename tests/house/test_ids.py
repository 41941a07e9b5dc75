"""No test hides another."""

from __future__ import annotations

import pytest

from tests.conftest import pytest_collection_modifyitems


def test_tests_of_one_id_are_refused(request: pytest.FixtureRequest) -> None:
    pytest_collection_modifyitems(request.config, [request.node])
    with pytest.raises(pytest.UsageError, match="test_tests_of_one_id_are_refused"):
        pytest_collection_modifyitems(request.config, [request.node, request.node])
