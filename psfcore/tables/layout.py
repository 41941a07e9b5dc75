"""The layout of the tables of a PSF, shared by `make`, which writes them, and `lookup`, which reads them.

    E(R) = sum of the weights with r <= R                encircled energy                Eq. (1)
    C(R) = 100 max(1 - E(R), 0)                          1 - encircled energy, percent   Eq. (2)

E is a fraction of all light. C(R) is the light that falls farther than R from the centre, or outside the array.
On an array larger than the full reach the weights can sum to more than 1 (E > 1); then C is 0.

| field | content |
|---|---|
| schema | SCHEMA |
| name, version, shape, reach_px, plate_scale_arcsec | these fields of the PSF |
| sum, central_weight | sum of all weights; weight of the central pixel |
| radii_px | the radii R of the tables, ascending |
| exact_to_px | up to this radius E is a staircase, and the tables hold every step |
| interpolation_error | by component: the largest error of an interpolated E, found at test radii |
| encircled | by component, TOTAL included: E at radii_px |
| encircled_changes | by component: one row for each axis of the fit's covariance, with the change of E for a step of 1 sigma; {} if not fitted |
| profile | by ring of one pixel: radius_px, pixels, mean_weight, sigma, azimuthal_rms_over_mean (of TOTAL) |

To compute the 1-sigma error of a number that is linear in E, compute the same number from each row of
encircled_changes, and take the root of the sum of the squares of these numbers. This method includes correlations. For
example, the error of the light in an annulus is not the sum of the errors at its two radii.

This module imports only the standard library, because the web process reads tables and must not load numerical libraries.
"""

from __future__ import annotations

SCHEMA = "psf-tables/1"
TOTAL = "TOTAL"
EXACT_TO_PX = 50
WHOLE_TO_PX = 100  # up to this radius, the tables contain every radius that is a whole number of pixels
STEP = 1.02  # beyond this radius: the ratio of two successive radii of the tables
FIELDS = (
    "schema",
    "name",
    "version",
    "shape",
    "sum",
    "central_weight",
    "reach_px",
    "plate_scale_arcsec",
    "radii_px",
    "exact_to_px",
    "interpolation_error",
    "encircled",
    "encircled_changes",
    "profile",
)
