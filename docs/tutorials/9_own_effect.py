"""
An effect of your own
=====================

The gap diagnosis tests the effects of a library. If you suspect another cause in your instrument, write it down as an
effect: one function that says how the images change. This tutorial adds a lamp beside the detector, and asks whether a
transit shows it.
"""

import json
import subprocess
from pathlib import Path
from tempfile import TemporaryDirectory

import matplotlib.pyplot as plt
import numpy as np
from astropy.io import fits

import heliopsf
from psfcore.psf import crop_centred
from psfcore.simulate.plan import default_plan
from psfcore.simulate.scatter_truth import ScatterTruth
from psfcore.simulate.transit import simulate, write

# %%
# A transit with the light of a lamp
# ----------------------------------
#
# The transit is simulated without an effect. Then the light of the lamp is added to each image: 40 DN/s at the middle
# of the right half, the same in all rows.

diffraction = crop_centred(heliopsf.build_psf("hri_euv").components["DIFFRACTION"], (256, 256))
diffraction /= diffraction.sum()
plan = default_plan(images=12, size_px=128, oversampling=1, brightness=8.0)

temporary = TemporaryDirectory()
folder = Path(temporary.name, "transit")
write(simulate(plan, ScatterTruth(b_px=6.15, c=2.53, total=0.411), diffraction, seed=3), folder)

glow = 40.0 * np.exp(-(((np.linspace(-0.5, 0.5, 128) - 0.25) / 0.15) ** 2))
for path in sorted(folder.glob("[0-9]*.fits")):
    pixels, header = fits.getdata(path), fits.getheader(path)  # DN
    bright = (pixels + glow * header["XPOSURE"]).astype("f4")
    fits.writeto(path, bright, header, overwrite=True, checksum=True)

# %%
# The effect
# ----------
#
# An effect has a name, a stage, its parameters with likely sizes, and a function: the change of image n for one unit of
# each parameter, in DN/s. ``view`` has the places of the pixels, the scenes and the PSF; :doc:`the gap diagnosis
# </gap>` lists all of it. The lamp is the same in all images of a pointing, so it cannot be seen in the unocculted
# field.

mine = Path(temporary.name, "lamp.py")
mine.write_text(
    """
import numpy as np
from psfcore.gap.effect import Change, Effect, EffectParameter


def glow(view):
    x, _ = view.places
    plane = np.exp(-(((x - 0.25) / 0.15) ** 2)).astype(np.float32)
    return [Change(lambda n, images: plane, unocculted=False)]


EFFECTS = (
    Effect(
        "lamp_glow",
        "detector",
        (EffectParameter("height", "DN/s", 20.0),),
        "A lamp beside the detector lights its right half.",
        "a dark exposure",
        ("detector_x",),
        glow,
        family="light_place",
    ),
)
"""
)

# %%
# The diagnosis
# -------------
#
# The file contains code, so only the person who runs the diagnosis can name it.

command = [
    "heliopsf",
    "gap",
    str(folder),
    "--local",
    "--effects",
    str(mine),
    "--json",
    f"{temporary.name}/gap.json",
]
subprocess.run(command, check=True, capture_output=True)
report = json.loads(Path(temporary.name, "gap.json").read_text())
print("\n".join(report["lines"]))

# %%
# The lamp has a height of 40 DN/s. The report compares the effect with the library and with the other forms of its
# family.

shown = sorted(report["effects"], key=lambda one: one["probability"])[-6:]
figure, axes = plt.subplots(figsize=(7, 3), layout="constrained")
axes.barh([one["words"] for one in shown], [one["probability"] for one in shown])
axes.set(xlabel="Probability", xlim=(0, 1))

# %%
# Write a test of the effect
# --------------------------
#
# Simulate a transit with the effect and one without it, as above, and test that the diagnosis tells them apart. In a
# service, the operator names the file in ``HELIOPSF_GAP_EFFECTS``.
