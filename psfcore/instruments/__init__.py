"""Instrument descriptions: one TOML file each, found by `files`, checked by `model`."""
