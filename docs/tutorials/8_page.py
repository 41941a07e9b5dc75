"""
In the browser
==============

The pages of a service need no installation on the reader's machine. This tutorial starts a service, sends it the sample
image as the first page does, and shows the pictures that the pages show.
"""

import subprocess
from importlib.resources import files
from pathlib import Path
from tempfile import TemporaryDirectory

import matplotlib.pyplot as plt

import heliopsf

# %%
# Start a service
# ---------------
#
# .. code-block:: console
#
#    $ heliopsf serve
#
# The command prints an address such as ``http://127.0.0.1:8765``. Open it in a browser. This tutorial takes any free
# port.

temporary = TemporaryDirectory()
service = subprocess.Popen(
    ["heliopsf", "serve", "--port", "0", "--data", str(Path(temporary.name, "data"))],
    stdout=subprocess.PIPE,
    stderr=subprocess.DEVNULL,
    text=True,
)
address = service.stdout.readline().split(" serves ")[1].split()[0]
client = heliopsf.Client(address)
client.wait_until_up()

# %%
# Drop an image
# -------------
#
# The first page shows a sample before and after its deconvolution; **Use this sample** takes it. To use your own image,
# drop its FITS file there. The page of the image then says which PSF the service takes and why, what is assumed in this
# PSF, and how long the deconvolution takes. **Start** starts it. The client sends the same requests:

sample = files("service.pages") / "sample.fits"
product = client.deconvolve(
    sample, Path(temporary.name, "product.fits"), preview=Path(temporary.name, "preview.png")
)
print(f"page of the image:   {address}/images/{product['image_id'][:12]}...")
print(f"page of the product: {address}/products/{product['id'][:12]}...")

# %%
# Before and after
# ----------------
#
# The page of the product has a viewer: a divider or the key ``b`` compares both images, and the values under the cursor
# are those of the file. Without scripts it shows this picture.

figure, axes = plt.subplots(figsize=(9, 4), layout="constrained")
axes.imshow(plt.imread(Path(temporary.name, "preview.png")))
axes.set_axis_off()

# %%
# What changed, and how sure
# --------------------------
#
# Below the viewer stand the changes of flux, bright and dark pixels, and the score of artefacts: from 1 on, look at the
# marked pixels.

details = product["details"]
print(f"flux {details['flux_change_pct']:+.3f} %, brightest 1 %: {details['bright_change_pct']:+.1f} %")
print(f"score of artefacts: {details['changes']['artefacts']['score']:.2f}")
print("caveats of the PSF:", "; ".join(details["psf"]["assumed"]))

# %%
# Print and cite
# --------------
#
# **Report on one page** shows the product on one sheet A4 for paper or PDF: image and PSF with their hashes, method,
# masked pixels, changes and errors. **Download FITS** brings the product; its header names the PSF.
#
# Stop the service. In a terminal, press Control-C.

client.close()
service.terminate()
service.wait()
