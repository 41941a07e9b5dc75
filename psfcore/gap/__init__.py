"""The gap between the fitted model and the images: where it lies, which effect causes it, how far it shrinks."""
