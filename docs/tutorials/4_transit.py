"""
From a transit to a certified PSF
=================================

When a planet passes in front of the Sun, no sunlight comes from its disc. The light that an image shows inside the disc
is stray light. heliopsf fits the diffuse scatter to this light. This tutorial simulates a small transit whose PSF is
known, fits it, and compares the result with the known PSF.
"""

from pathlib import Path
from tempfile import TemporaryDirectory

import matplotlib.pyplot as plt
import numpy as np
from astropy.io import fits

import heliopsf
from psfcore.psf import crop_centred, cumulative_curve
from psfcore.simulate.plan import default_plan
from psfcore.simulate.scatter_truth import ScatterTruth, total_kernel
from psfcore.simulate.transit import simulate, write

# %%
# Simulate a transit
# ------------------
#
# The transit has 18 images of 128 px in three pointings, like the transit of Mercury that the paper uses. The scene is
# eight times as bright as usual, so that a few small images suffice. The command ``heliopsf simulate transit -o
# transit`` writes a larger transit.

diffraction = crop_centred(heliopsf.build_psf("hri_euv").components["DIFFRACTION"], (256, 256))
diffraction /= diffraction.sum()
truth = ScatterTruth(b_px=6.15, c=2.53, total=0.411)
plan = default_plan(images=18, size_px=128, brightness=8.0)

temporary = TemporaryDirectory()
folder = Path(temporary.name)
write(simulate(plan, truth, diffraction, seed=3), folder)

# %%
# The folder contains the images and ``transit.json``, which says where the disc is in each image (:doc:`format
# </transits>`). The disc contains stray light:

image = fits.getdata(folder / "008.fits")
figure, axes = plt.subplots(figsize=(5, 4.2))
drawn = axes.imshow(image, origin="lower", norm="log", cmap="magma")
axes.set(xlabel="x (px)", ylabel="y (px)", title="008.fits")
figure.colorbar(drawn, label="DN")

# %%
# Fit the scatter
# ---------------

fit = heliopsf.fit_scatter(folder)
for name, value in fit.inversion.values.items():
    print(f"{name:6} {value:.3f} ± {fit.value_sigma[name]:.3f}")

# %%
# The parameters depend on each other. Therefore compare the curve of 1 - encircled energy, not the single numbers. The
# lower panel shows the difference from the known PSF, with the standard error of the fit.

radii_px = fit.curve.radii_px
known_pct = cumulative_curve(total_kernel(truth, diffraction), radii_px)
difference = fit.curve.pct - known_pct

figure, (upper, lower) = plt.subplots(2, 1, sharex=True, height_ratios=[2, 1], figsize=(7, 6))
fit.plot(upper)
upper.plot(radii_px, known_pct, "k.", label="known total PSF")
upper.set(title="Fitted and known PSF", xlabel="")
upper.legend()
lower.axhline(0, color="black", linewidth=0.8)
lower.errorbar(radii_px, difference, fit.curve.sigma, fmt="o", markersize=4)
lower.set(xlabel="Radius (px)", ylabel="Difference (points)")

# %%
# Read the limits of the fit. They say what these data do not determine.

for limit in fit.limits:
    print("-", limit)
print(f"largest difference: {np.abs(difference).max():.2f} percentage points")

# %%
# Certify the PSF
# ---------------
#
# A fitted PSF is a draft. ``fit.psf()`` is this PSF, and ``fit.psf().write("fitted.fits")`` keeps it. These commands
# fit the transit on a service, test the fit on held-out images, and certify the PSF for a range of observation times:
#
# .. code-block:: console
#
#    $ heliopsf serve                                       # in another terminal
#    $ heliopsf psf fit transit -o psf.fits                 # prints the id of the PSF
#    $ heliopsf psf crossval transit --json crossval.json   # the uncertainty of the fit
#    $ heliopsf report transit --psf ID -o report.html      # PSF and transit on one page
#    $ heliopsf psf certify ID --version 1.0.0 --from 2020-06-01
#
# From now on the service deconvolves images of this telescope with this PSF, if they were taken on 1 June 2020 or
# later. ``heliopsf psf lineage ID`` shows from which data the PSF was made. The page :doc:`/versions` explains versions
# and contexts.
#
# Before you certify a PSF, check that the residuals contain nothing but noise: :doc:`5_gap`.
