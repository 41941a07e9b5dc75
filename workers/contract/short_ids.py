"""Shortened ids: the first digits of an id stand for the id, if no other id begins with them."""

from __future__ import annotations

FEWEST_DIGITS = 8
SHORT_ID = rf"[0-9a-f]{{{FEWEST_DIGITS},63}}"  # pattern of a text that can be a shortened id
