"""FITS files: headers, images, PSFs and cut-outs."""
