"""What a product adds to the image of its input: header cards of its own, and planes."""
