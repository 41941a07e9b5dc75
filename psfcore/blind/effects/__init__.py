"""The withheld effects of the blind set, and the simulated optics on fine pixels."""
