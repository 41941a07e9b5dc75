"""What the files of images and products hold: pixels and headers."""
