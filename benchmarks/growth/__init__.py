"""How time and memory grow; see `benchmarks.growth.__main__`."""
