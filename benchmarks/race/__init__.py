"""heliopsf beside other packages; `make bench-peers` runs these benchmarks."""
