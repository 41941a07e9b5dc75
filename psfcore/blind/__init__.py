"""The blind set: simulated transits with withheld effects, which test the gap diagnosis.

A case is made, its truth is sealed, a process that sees only the images diagnoses it, and the reports are scored.

``psfcore.blind`` and ``psfcore.gap`` share no code, on purpose. The blind set judges the gap library: its effects are
written independently, with other formulas and other parameters. Shared code would hide the same error on both sides.
"""
