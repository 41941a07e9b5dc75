"""The layout of the tables of a PSF, shared by `make`, which writes them, and `lookup`, which reads them.

    E(R) = sum of the weights with r <= R                encircled energy                Eq. (1)
    C(R) = 100 max(1 - E(R), 0)                          1 - encircled energy, percent   Eq. (2)

E is a fraction of all light. C(R) is the light that lands farther than R from the centre, or outside the array.
An array larger than the full reach can hold more than all of the light (E > 1); then C is 0.

| field | content |
|---|---|
| schema | SCHEMA |
| name, version, shape, reach_px, plate_scale_arcsec | of the PSF |
| sum, central_weight | sum of all weights; weight of the central pixel |
| radii_px | the radii R of the tables, ascending |
| exact_to_px | up to this radius E is a staircase, and the tables hold every step |
| interpolation_error | by component: the largest error of E found between two radii |
| encircled | by component, TOTAL included: E at radii_px |
| encircled_changes | by component: changes of E by 1 sigma along each axis of the fit's covariance; {} if not fitted |
| profile | by ring of one pixel: radius_px, pixels, mean_weight, sigma, azimuthal_rms_over_mean (of TOTAL) |

A 1-sigma error of any number read from the tables is the root of the sum of squares of the same number read from
each row of encircled_changes. So correlations are included: the error of an annulus is not the sum of two errors.

Standard library only: the web process reads tables, and must not load numerical libraries.
"""

from __future__ import annotations

SCHEMA = "psf-tables/1"
TOTAL = "TOTAL"
EXACT_TO_PX = 50
WHOLE_TO_PX = 100  # up to here every whole pixel is a radius of the tables
STEP = 1.02  # ratio of two radii of the tables farther out
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
