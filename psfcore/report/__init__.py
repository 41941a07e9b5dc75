"""The report on a transit and its PSF: the numbers and figures that a publication shows, on one HTML page."""
