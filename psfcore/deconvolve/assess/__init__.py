"""What deconvolution changed in an image, how certain its pixels are, and signs of artefacts."""
