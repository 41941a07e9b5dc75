"""The withheld effects of the blind set, and the optics on fine pixels that they act on."""
