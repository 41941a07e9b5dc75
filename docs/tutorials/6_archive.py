"""
An archive in an afternoon
==========================

A service deconvolves many images with the same certified PSF, and records which PSF made which product. This tutorial
runs a whole service with a small archive of simulated images. Every step is shown as a command and in Python.
"""

import os
import subprocess
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory

import matplotlib.pyplot as plt
from astropy.io import fits
from matplotlib.colors import PowerNorm

import heliopsf
from psfcore.psf import crop_centred
from psfcore.simulate.plan import default_plan
from psfcore.simulate.scatter_truth import ScatterTruth
from psfcore.simulate.transit import simulate, write

# %%
# The archive
# -----------
#
# The archive of this tutorial is a folder with twelve images of 128 px. The PSF is cut to 256 px, which makes the run
# faster.

temporary = TemporaryDirectory()
archive, products = Path(temporary.name, "archive"), Path(temporary.name, "products")

psf = heliopsf.build_psf("hri_euv")
diffraction = crop_centred(psf.components["DIFFRACTION"], (256, 256))
plan = default_plan(images=12, size_px=128, oversampling=1)
write(simulate(plan, ScatterTruth(6.15, 2.53, 0.411), diffraction / diffraction.sum(), seed=3), archive)

small = replace(psf, kernel=crop_centred(psf.kernel, (256, 256)), components={}, version="1.0.0")
small.write(Path(temporary.name, "psf.fits"))

# %%
# Start a service
# ---------------
#
# .. code-block:: console
#
#    $ export HELIOPSF_BULK_ROOTS=/archive HELIOPSF_BULK_OUTPUT_ROOTS=/products
#    $ heliopsf serve
#
# The service reads only folders in the first variable, and writes only to folders in the second. ``heliopsf serve``
# also starts a worker. To use more machines, start ``heliopsf worker`` on each of them; the page :doc:`/operating`
# explains how.

service = subprocess.Popen(
    ["heliopsf", "serve", "--port", "0", "--data", str(Path(temporary.name, "data"))],
    env=os.environ | {"HELIOPSF_BULK_ROOTS": str(archive), "HELIOPSF_BULK_OUTPUT_ROOTS": str(products)},
    stdout=subprocess.PIPE,
    stderr=subprocess.DEVNULL,
    text=True,
)
address = service.stdout.readline().split(" serves ")[1].split()[0]
client = heliopsf.Client(address)
client.wait_until_up()

# %%
# Certify the PSF
# ---------------
#
# .. code-block:: console
#
#    $ heliopsf psf upload psf.fits --instrument hri_euv --channel 174 --kind total
#    $ heliopsf psf certify ID --version 1.0.0 --from 2020-06-01
#    $ heliopsf context create 2026-01
#
# The context fixes the PSFs that are certified now. Products that name it stay reproducible when PSFs change later.

uploaded = client.upload_psf(
    Path(temporary.name, "psf.fits"), instrument="hri_euv", channel="174", kind="total"
)
client.certify_psf(uploaded["id"], version="1.0.0", valid_from="2020-06-01")
client.create_context("2026-01")

# %%
# Start the bulk run
# ------------------
#
# .. code-block:: console
#
#    $ heliopsf bulk submit '/archive/*.fits' --where WAVELNTH=174 --context 2026-01 --output /products --wait
#
# The service reads the headers of all files that match the pattern, and deconvolves those that meet the condition.

run = client.submit_bulk(
    files=[{"glob": f"{archive}/*.fits", "where": {"WAVELNTH": 174}}],
    context="2026-01",
    output=str(products),
    name="tutorial",
)
run = client.wait_for_bulk(run["id"])
print(run["phase"], run["images"])

# %%
# Look at the results
# -------------------
#
# The report of the run lists the highest artefact scores first. Look at these products before you publish the others.
# Here the highest scores belong to images in which the dark disc of the occulter looks like an artefact. The folder
# also contains a PSF; the run refuses to deconvolve it, and says why.

command = ["heliopsf", "bulk", "report", run["id"], "--server", address, "--most", "5"]
print(subprocess.run(command, capture_output=True, text=True, check=True).stdout)

# %%
# An image and its product:

product = fits.open(next(products.glob("006-*.fits")))[0]
print("PSF of the product:", product.header["PSFNAME"], product.header["PSFVERS"])
image = fits.open(archive / "006.fits")[0]
norm = PowerNorm(0.4, vmin=0, vmax=8000)

figure, (left, right) = plt.subplots(1, 2, figsize=(8, 3.6), layout="constrained")
left.imshow(image.data, origin="lower", norm=norm, cmap="magma")
right.imshow(product.data, origin="lower", norm=norm, cmap="magma")
left.set_title("Image")
right.set_title("Product")
figure.colorbar(right.images[0], ax=[left, right], label="DN")

# %%
# These commands show the progress of a run, process failed images again, and name the PSF of every product:
#
# .. code-block:: console
#
#    $ heliopsf bulk status ID
#    $ heliopsf bulk retry ID
#    $ heliopsf bulk report ID -o manifest.csv
#
# The same image, PSF and parameters always give the same product. If you submit the run again, for example after a
# power failure, no image is processed twice.

# %%
# Stop the service. In a terminal, press Control-C.
#
# The page :doc:`/operating` explains how to run a service for many people: database, keys, limits, and monitoring.

client.close()
service.terminate()
service.wait()
