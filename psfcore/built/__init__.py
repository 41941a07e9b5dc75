"""PSFs built from instrument files: their recipes and identities, and the cache that keeps them."""
