"""The parts that a product adds to the header and the image of its input: cards and planes."""
