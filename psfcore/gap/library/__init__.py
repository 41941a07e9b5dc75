"""The library of effects, sorted by stage; the probes; and the effects that users or operators add."""
