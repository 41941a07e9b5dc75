"""
A first image in three lines
============================

This tutorial deconvolves an image of HRI_EUV, the high-resolution imager of Solar Orbiter at 174 Å. The image is the
simulated sample image that heliopsf contains. To use your own image, replace ``path``.

Install heliopsf with sunpy and matplotlib: ``pip install '.[map,plot]'`` in a checkout.
"""

from importlib.resources import files

import matplotlib.pyplot as plt
from matplotlib.colors import PowerNorm

path = files("service.pages") / "sample.fits"

# %%
# Deconvolve
# ----------
#
# ``sunpy.map.Map`` reads the file. :func:`heliopsf.deconvolve` finds the telescope in the header, builds the PSF of the
# telescope, and deconvolves the image. The first image of a telescope takes up to a minute longer, because its PSF is
# built; heliopsf keeps the PSF for later images.

import sunpy.map

import heliopsf

image = sunpy.map.Map(path)
sharp = heliopsf.deconvolve(image)

# %%
# Before and after
# ----------------
#
# The result is a Map with the coordinates of the image. Both panels have the same colour scale. Bright loops become
# brighter, and dark regions become darker, because deconvolution returns the scattered light to its origin.

norm = PowerNorm(0.4, vmin=0, vmax=6000)
figure = plt.figure(figsize=(9, 4.2), layout="constrained")
before = figure.add_subplot(1, 2, 1, projection=image)
after = figure.add_subplot(1, 2, 2, projection=sharp)
image.plot(axes=before, norm=norm, title="Before")
sharp.plot(axes=after, norm=norm, title="After")
after.coords[1].set_axislabel(" ")
figure.colorbar(after.images[0], ax=[before, after], label="DN/s", shrink=0.8)

# %%
# The header says which PSF was used
# ----------------------------------
#
# ``PSFID`` identifies the PSF: equal ids mean equal weights. ``PSFVERS`` is its version. This PSF is a draft, because
# parts of its description are assumed (see :doc:`the instrument file </instruments>`).

for card in ("PSFID", "PSFVERS", "PSFSTAT", "DCNVMETH", "DCNVITER"):
    print(f"{card:8} {sharp.meta[card]}")

# %%
# Save the result with ``sharp.save("sharp.fits")``.
#
# More about the result
# ---------------------
#
# With ``full=True`` the result is a :class:`heliopsf.Deconvolution`. It also has the plane QUALITY, the changes, and
# plots.

result = heliopsf.deconvolve(image, full=True)
figure, axes = plt.subplots(figsize=(6.4, 4.8))
result.plot_change(axes).set_title("Change")

# %%
# QUALITY is 0 for a good pixel; :doc:`Products </products>` explains the other values. Here the pixels near the edges
# are marked, because a part of their light may come from beyond the image.

print(f"good pixels: {100 * (result.quality == 0).mean():.0f} %")
change = result.changes["change_pct"]
print(f"1 % of the pixels lose at least {-change['p1']:.0f} %")
print(f"1 % of the pixels gain at least {change['p99']:.0f} %")

# %%
# The same with a command, which writes a FITS file with all planes:
#
# .. code-block:: console
#
#    $ heliopsf deconvolve image.fits -o sharp.fits --local
#
# Next: :doc:`2_aia` compares a PSF with the PSF of another program. The page :doc:`/python` lists all forms of images
# that heliopsf accepts.
