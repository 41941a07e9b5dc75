"""Tables of a PSF: `make` writes them, `lookup` answers questions from them, `layout` describes them."""
