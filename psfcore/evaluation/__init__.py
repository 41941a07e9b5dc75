"""Evaluation of a PSF: the light that it predicts in the occulter, compared with the observed light."""
