"""What a person looks at in a stored FITS file: the pixels of one plane, and the cards of all headers."""
