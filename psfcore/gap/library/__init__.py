"""The library of effects, by stage, with the probes and the effects that users or operators add."""
