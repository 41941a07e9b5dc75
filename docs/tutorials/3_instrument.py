"""
Your own instrument
===================

An instrument file describes a telescope in TOML. heliopsf builds a PSF from it. This tutorial writes such a file for an
invented telescope, builds its PSF, and deconvolves an image with it.
"""

from pathlib import Path
from tempfile import TemporaryDirectory

import matplotlib.pyplot as plt
import numpy as np
from astropy.nddata import CCDData

import heliopsf
from psfcore.simulate.scene import solar_scene

folder = TemporaryDirectory()
file = Path(folder.name) / "small_telescope.toml"

# %%
# Write the file
# --------------
#
# The telescope has an aperture of 60 mm and one filter mesh at its entrance. The table ``[scatter]`` describes the
# diffuse scatter. :doc:`The instrument file </instruments>` explains every key.

text = """
name = "small_telescope"
version = "1.0.0"
status = "draft"
wavelength_angstrom = 195.0
focal_length_mm = 2500.0

[match]
DETECTOR = "SMALL"

[aperture]
diameter_mm = 60.0

[[meshes]]
name = "entrance"
place = "entrance"
pitch_um = 360.0
wire_um = 40.0
windows = 167
angle_deg = 30.0

[detector]
pixel_pitch_um = 12.0
pixels = 1024
readout_pixels = 1024
plate_scale_arcsec = 0.99

[scatter]
b_px = 4.0
c = 2.6
total = 0.2
basis = "inferred"
"""
file.write_text(text)

# %%
# Build the PSF and look at it
# ----------------------------

psf = heliopsf.build_psf(file, size=512)
figure, (left, right) = plt.subplots(1, 2, figsize=(9, 4), layout="constrained")
psf.plot(left).set_title("Weights")
psf.plot_curve(right).set_title("Light beyond a radius")

# %%
# The diffraction orders of the mesh are :math:`\lambda f / d` apart: wavelength times focal length over the pitch.

spacing_um = 195e-4 * 2500e3 / 360
print(f"spacing of the orders: {spacing_um / 12:.2f} px")
print("light beyond 1, 10 and 100 px:", np.round(psf.light_beyond([1, 10, 100]), 2), "%")

# %%
# Change one number
# -----------------
#
# Thicker wires diffract more light. The hash of the file is a part of the identity of its PSF, so the changed
# file gives another PSF with another id.

figure, axes = plt.subplots(figsize=(6.4, 4.4))
radii_px = np.geomspace(0.5, 250, 300)
for wire_um in (20, 40, 80):
    file.write_text(text.replace("wire_um = 40.0", f"wire_um = {wire_um}.0"))
    changed = heliopsf.build_psf(file, size=512)
    axes.semilogx(radii_px, changed.light_beyond(radii_px), label=f"wires of {wire_um} µm")
axes.set(xlabel="Radius (px)", ylabel="1 - encircled energy (%)")
axes.legend()

# %%
# Errors in the file
# ------------------
#
# A misspelt key is an error. The message names the key and says what was expected.

file.write_text(text.replace("pitch_um = 360.0", "pich_um = 360.0"))
try:
    heliopsf.build_psf(file)
except heliopsf.DataError as error:
    print(error)

# %%
# Deconvolve with this PSF
# ------------------------
#
# Give the PSF to :func:`heliopsf.deconvolve`. The image here is a simulated scene as a ``CCDData`` of astropy. heliopsf
# compares the wavelength and the plate scale of image and PSF.

scene = solar_scene((256, 256), seed=5)
header = {"DETECTOR": "SMALL", "WAVELNTH": 195, "CDELT1": 0.99, "CUNIT1": "arcsec"}
image = CCDData(scene, unit="DN/s", meta=header)
sharp = heliopsf.deconvolve(image, psf)
print(f"brightest pixel: {image.data.max():.0f} DN/s before, {sharp.data.max():.0f} DN/s after")

# %%
# The same with commands:
#
# .. code-block:: console
#
#    $ heliopsf psf build --instrument small_telescope.toml -o psf.fits --local
#    $ heliopsf psf show psf.fits
#    $ heliopsf deconvolve image.fits -o sharp.fits --psf psf.fits --local
#
# ``heliopsf psf upload psf.fits`` adds the PSF to a service.
