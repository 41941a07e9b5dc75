"""Instrument descriptions: one TOML file each; `files` finds them, `model` checks them."""
