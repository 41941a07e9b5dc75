"""Whose waiting job comes next, and ended jobs that run again."""
