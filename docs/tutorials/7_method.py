r"""
The method
==========

heliopsf implements the methods of Hofmeister et al., *A Point-Spread Function for the Extreme Ultraviolet
High-Resolution Imager on board Solar Orbiter*. This page explains the method with figures, and says where heliopsf
differs from the paper.
"""

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.colors import LogNorm

import heliopsf
from psfcore.psf import crop_centred, cumulative_curve
from psfcore.scatter.power_law import scatter_kernel

psf = heliopsf.build_psf("hri_euv")

# %%
# What is computed: diffraction
# -----------------------------
#
# The entrance filter is held by a square mesh and a mount. Both diffract light, and so does the edge of the
# aperture. The far field of a mesh of :math:`N` windows along one axis is
#
# .. math::
#
#    I(x) = \left( \frac{\sin \alpha}{\alpha} \right)^2 \left( \frac{\sin N \beta}{\sin \beta} \right)^2 ,
#    \qquad \alpha = \frac{\pi w x}{\lambda f} , \quad \beta = \frac{\pi d x}{\lambda f}
#
# with the pitch :math:`d`, the width :math:`w` of a window, the wavelength :math:`\lambda` and the focal length
# :math:`f`. heliopsf integrates it exactly over each pixel. The diffraction orders of the entrance mesh of HRI_EUV are
# :math:`\lambda f / d = 5.74` px apart. A second mesh at the filter wheel has orders that are 0.37 px apart; it widens
# the core. The PSF of aperture and mount is a Fourier transform of the pupil.

spacing_px = 174e-4 * 4187e3 / 1270 / 10
print(f"spacing of the orders: {spacing_px:.2f} px")

names = ["ENTRANCE_MESH", "MOUNT", "FILTER_WHEEL", "DIFFRACTION"]
figure, axes = plt.subplots(2, 2, figsize=(7.4, 6.4), layout="constrained")
for one, name in zip(axes.flat, names, strict=True):
    centre = np.maximum(crop_centred(psf.components[name], (81, 81)), 1e-9)
    drawn = one.imshow(centre, norm=LogNorm(1e-8, 1), origin="lower", cmap="magma")
    one.set(title=name, xlabel="x (px)", ylabel="y (px)")
figure.colorbar(drawn, ax=axes, label="Weight")

# %%
# The drawing of the mount is not public. Its bars are assumed, such that all diffraction puts about as much light
# outside the central pixel as the paper states (26.4 %). Therefore the PSF is a draft.
#
# What is fitted: diffuse scatter
# -------------------------------
#
# The roughness of the mirrors scatters light. No drawing describes it, so it is fitted to the stray light inside the
# disc of a transit. The scatter kernel is a softened power law of the radius :math:`r` in px,
#
# .. math::
#
#    s(r) = \frac{a}{(b + r)^c} \quad (r > 0), \qquad s(0) = 1 - t ,
#
# where :math:`t` is the sum over all :math:`r > 0` on 2048 × 2048 px. The total PSF is the scatter kernel convolved
# with the diffraction PSF.

figure, axes = plt.subplots(figsize=(7, 4.5))
psf.plot_curve(axes)

# %%
# The inversion
# -------------
#
# The fit repeats these steps until the PSF no longer changes:
#
# 1. Deconvolve every image with the present PSF.
# 2. Set the disc to zero, because the scene is dark there.
# 3. Convolve the scene with the PSF, and compare the light in the disc with the observed light.
# 4. Change the parameters of the scatter kernel such that they agree.
#
# :doc:`4_transit` runs this fit.
#
# Four biases of the published fit
# --------------------------------
#
# The paper's fit has four biases. heliopsf corrects them; ``heliopsf psf fit --as-published`` also runs the published
# fit and shows the effect of each bias on your transit.
#
# **1. Weights from observed values.** The published fit divides each equation by its own noisy intensity. A pixel that
# is dark by chance then gets a large weight, and the fitted light is too low. heliopsf takes the noise of the expected
# intensity. An example: 100,000 pixels that expect 12 photons.

rng = np.random.default_rng(1)
photons = np.maximum(rng.poisson(12, 100_000), 1)
print(f"mean with equal weights:          {photons.mean():.2f} photons")
print(f"mean with weights 1 / observed:   {np.average(photons, weights=1 / photons):.2f} photons")

# %%
# **2. Sum or convolution.** In the published equations, the scatter kernel is added to the diffraction PSF. But the
# scattered light is diffracted as well, so the two must be convolved. The figure shows the difference of 1 - encircled
# energy between the two forms, for the same parameters. The published fit makes up for this difference with too much
# scatter.

scattered = psf.components["SCATTER"].copy()
scattered[1024, 1024] = 0
added = scattered + (1 - scattered.sum()) * psf.components["DIFFRACTION"]
radii_px = np.geomspace(0.5, 1000, 200)
difference = cumulative_curve(psf.kernel, radii_px) - cumulative_curve(added, radii_px)

figure, axes = plt.subplots(figsize=(6.4, 4.4))
axes.semilogx(radii_px, difference)
axes.axhline(0, color="black", linewidth=0.8)
axes.set(xlabel="Radius (px)", ylabel="Convolution minus sum (points)")

# %%
# **3. Light beyond the array.** A smaller array does not hold all scattered light. If the light on the array is taken
# for the total, the light in the core is too large. heliopsf always counts light on the same area of 2048 × 2048 px.
# This is the light that is scattered within arrays of several sizes:

for size in (256, 512, 1024, 2048):
    kernel = scatter_kernel(6.15, 2.53, 0.411, size)
    print(f"{size:5} px: {100 * (kernel.sum() - kernel.max()):5.1f} % of the light")

# %%
# **4. Pixels on the edge of the disc.** The published fit sets all pixels to zero whose centres lie inside the disc.
# Some of them are partly lit, so this removes sunlight from the scene. heliopsf sets only fully dark pixels to zero.

radius_px = 10.75
y, x = np.mgrid[-12:13, -12:13]
inside = np.hypot(x, y) <= radius_px
dark = np.hypot(np.abs(x) + 0.5, np.abs(y) + 0.5) <= radius_px
print(f"centre inside the disc: {inside.sum()} pixels; fully dark: {dark.sum()} pixels")

# %%
# Deconvolution
# -------------
#
# The default method is Richardson-Lucy with 20 iterations, as the paper recommends:
#
# .. math::
#
#    x_{k+1} = x_k \cdot H^T \! \left( \frac{y}{H x_k} \right) ,
#
# where :math:`y` is the image, :math:`x_k` the scene after :math:`k` iterations, :math:`H` the convolution with the
# PSF, and :math:`H^T` its transpose. In the paper, the sky beyond the image is dark. heliopsf continues the image
# beyond its edges by reflection; ``edges="zero"`` follows the paper.
#
# How accurate is it?
# -------------------
#
# - The fit: :doc:`4_transit` compares a fitted PSF with the known PSF. ``heliopsf simulate bound`` computes the
#   smallest error that photon noise and read noise allow.
# - The PSFs of AIA: :doc:`the comparison of all channels </aia>` with those of aiapy.
# - :doc:`The gap diagnosis </gap>`: this page states how often it is right on simulated transits whose effect is
#   withheld.
