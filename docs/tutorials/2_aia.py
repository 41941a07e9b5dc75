"""
AIA at 171 Å beside aiapy
=========================

heliopsf builds the PSFs of the seven EUV channels of AIA from their filter meshes, as aiapy does. This tutorial shows
the PSF at 171 Å and compares it with the PSF of aiapy.

aiapy does not run on this page. The numbers of aiapy come from :doc:`the comparison of all channels </aia>`, which
``make bench-peers`` computes with aiapy 0.10.2.
"""

import matplotlib.pyplot as plt
import numpy as np

import heliopsf

psf = heliopsf.build_psf("aia_171")

# %%
# The arms
# --------
#
# The entrance filter has two pieces, and each piece has a square mesh. Each mesh diffracts light into two arms.
# The dashed lines are the four arms of aiapy.

arms_deg = np.array([49.81, 39.57, -40.13, -50.38])  # aiapy, from the +x axis of the detector

figure, axes = plt.subplots(figsize=(6, 5))
psf.plot(axes, size=301)
axes.set_autoscale_on(False)
along = np.array([-140, 140])
for angle in np.deg2rad(arms_deg):
    axes.plot(along * np.cos(angle), along * np.sin(angle), "w--", linewidth=0.6)

# %%
# Light beyond a radius
# ---------------------
#
# ``light_beyond`` gives 1 - encircled energy, in percent of all light.

radii_px = [2, 10, 100]
aiapy_pct = [21.90, 18.42, 2.95]

print("radius   heliopsf      aiapy")
for radius, own, other in zip(radii_px, psf.light_beyond(radii_px), aiapy_pct, strict=True):
    print(f"{radius:4} px   {own:6.2f} %   {other:6.2f} %")

axes = psf.plot_curve()
axes.plot(radii_px, aiapy_pct, "o", color="black", label="aiapy")
axes.legend(frameon=False)

# %%
# The curve falls at the diffraction orders of the entrance meshes, which are 16.26 px apart. The values differ by at
# most 0.2 percentage points. :doc:`The comparison of all channels </aia>` gives the reasons.
#
# Replace a call of aiapy
# -----------------------
#
# The parameters have the same names and the same order:
#
# .. code-block:: python
#
#    sharp = aiapy.psf.deconvolve(image, iterations=20)  # before
#    sharp = heliopsf.deconvolve(image, iterations=20)   # after
#
# A PSF of aiapy is an array. heliopsf deconvolves with such an array too: ``heliopsf.deconvolve(image, psf=array)``.
# The page :doc:`/python` lists the differences.
#
# This PSF describes diffraction alone. AIA also scatters light diffusely; this light stays in the image. To remove it,
# fit the scatter to a transit, as in :doc:`4_transit`.
