"""The blind set: simulated transits that test the gap diagnosis. The effects in these transits are withheld from the
diagnosis.

Each case is simulated, and its truth is sealed by a hash. A process that sees only the images diagnoses the case.
Then the reports are compared with the truths. A further process computes from images without noise the bound: what a
Bayes observer could know.

``psfcore.blind`` and ``psfcore.gap`` share no code, on purpose. The blind set tests the gap library, so its effects
are written independently, with other formulas and other parameters. An error in shared code would remain undetected,
because it would be the same on both sides.
"""
