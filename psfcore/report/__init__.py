"""The report on a transit and its PSF: numbers, figures and one HTML page, as in a publication."""
