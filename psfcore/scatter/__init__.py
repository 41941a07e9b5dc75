"""Diffuse scatter by the mirrors: its shapes, its fit to a transit, and tests of the fit."""
