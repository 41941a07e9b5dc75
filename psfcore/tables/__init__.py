"""Tables of a PSF: `make` writes them, `lookup` describes them and answers questions from them."""
