"""The library of effects, sorted by stage, and the effects that users or operators add."""
