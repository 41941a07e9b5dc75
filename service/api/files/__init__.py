"""The contents of the files of images and products: pixels and headers."""
