"""A report on a transit and its PSF, as a paper shows it: numbers, figures and one page."""
