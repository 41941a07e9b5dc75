"""Plain JSON values of results."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import fields, is_dataclass
from typing import Any

import numpy as np


def json_values(value: Any) -> Any:
    """The JSON values of a result.

    Arrays become lists, mappings and dataclasses become objects, and nan and infinity become null, because JSON cannot
    express them.
    """
    if is_dataclass(value):
        value = {field.name: getattr(value, field.name) for field in fields(value)}
    if isinstance(value, Mapping):
        return {str(key): json_values(each) for key, each in value.items()}
    if isinstance(value, np.ndarray | np.generic):
        value = value.tolist()
    if isinstance(value, list | tuple):
        return [json_values(each) for each in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


def json_attributes(of: object, *names: str) -> dict[str, Any]:
    """The JSON values of some attributes of an object, by name."""
    return {name: json_values(getattr(of, name)) for name in names}
