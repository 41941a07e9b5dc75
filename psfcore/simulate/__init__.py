"""Scenes and observations whose truth is known."""
