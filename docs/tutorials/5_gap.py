"""
Is the gap real?
================

A fitted PSF never reproduces a transit exactly. The *gap* is the part of the residuals that noise does not explain. The
gap diagnosis states where the gap lies, which cause explains it, and how far it shrinks with this cause in the model.
This tutorial adds a known error to a simulated transit and reads the diagnosis.
"""

from pathlib import Path
from tempfile import TemporaryDirectory

import matplotlib.pyplot as plt

import heliopsf
from psfcore.psf import crop_centred
from psfcore.simulate.plan import default_plan
from psfcore.simulate.scatter_truth import ScatterTruth
from psfcore.simulate.transit import simulate, write

# %%
# A transit with an error
# -----------------------
#
# The detector adds 6 DN to every pixel of every exposure. The images are not corrected for this dark offset.

diffraction = crop_centred(heliopsf.build_psf("hri_euv").components["DIFFRACTION"], (256, 256))
diffraction /= diffraction.sum()
plan = default_plan(images=12, size_px=128, oversampling=1, brightness=8.0, dark_offset_dn=6.0)

temporary = TemporaryDirectory()
folder = Path(temporary.name)
write(simulate(plan, ScatterTruth(b_px=6.15, c=2.53, total=0.411), diffraction, seed=3), folder)

# %%
# The diagnosis
# -------------
#
# Begin with the three lines and the cautions of the report.

gap = heliopsf.diagnose_gap(folder)
report = gap.report()
print("\n".join(report["lines"]))
print(report["cautions"] or "No cautions.")

# %%
# The causes
# ----------
#
# The report lists the causes that act together; here there is one. Each cause has one or more alternatives: one of them
# is the cause. An alternative is an effect of the library, or another form of a family: a change of this kind whose
# form the library does not have. The *level* of a cause says what is told: the name of an effect, a family, a stage
# (scene, optics or detector), or none of these (``open``). On transits like those of the calibration, the alternatives
# contain a true cause with a probability of 90 % (``coverage``); with effects of another author it was less, see the
# results in :doc:`the gap diagnosis </gap>`.

print("verdict:", report["verdict"])
for cause in report["causes"]:
    print("level:  ", cause["level"])
    for one in cause["alternatives"]:
        print(f"  {one['words']} ({one['stage']}, family {one['family']}): {one['probability']:.3f}")

# %%
# The figure shows the effects with the highest probabilities. The bars show the closure: the share of the gap in
# held-out images that disappears when the effect is added to the model. A high closure does not identify the cause,
# because another effect can look alike; the probabilities at the right decide. They need not sum to 1, because several
# effects can act together.

figure, axes = plt.subplots(figsize=(8, 5), layout="constrained")
gap.plot(axes)

# %%
# The report states the size of each effect with its error, and the closure with its 90 % interval. The interval is wide
# here, because the gap is only twice the noise.

best = report["effects"][0]
offset = best["parameters"]["offset"]
print(f"{best['words']}: {offset['value']:.2f} ± {offset['sigma']:.2f} {offset['unit']}")
low, high = report["closure"]["ci90"]
print(f"closure on held-out images: {report['closure']['value']:.2f} ({low:.2f} to {high:.2f})")

# %%
# What these data could have shown
# --------------------------------
#
# An effect that is not told may act, but too weakly to be seen. ``found_90`` is the strength with which the effect
# excludes "no cause" in 90 % of observations; ``excluded_95`` is the strength above which these data exclude the
# effect.

print(f"{'effect':20} {'found_90':>10} {'excluded_95':>12}")
for name in ("dark_offset", "intensity_gradient", "column_smear", "ghost"):
    limit = report["limits"][name]
    found, excluded = limit["found_90"], limit["excluded_95"]
    print(f"{name:20} {found:10.3g} {excluded:12.3g} {limit['unit']}")

# %%
# What next?
# ----------
#
# ``gap.quicklook()`` draws the whole diagnosis, and ``heliopsf gap transit -o gap.html`` writes it as a page. What to
# do next depends on the verdict:
#
# - ``attributed``: ``report["would_confirm"]`` names the observation that would confirm the cause. Correct it, here the
#   dark level, and fit again. ``heliopsf gap transit --corrected psf.fits`` writes a PSF that was fitted with the
#   effect in the model.
# - ``tie``: ``report["would_separate"]`` names the observation that would separate the effects.
# - ``none``: no gap was found. The limits state how strong an effect can still be.
# - ``unknown`` or ``inconclusive``: at least one alternative is a form that the library does not have.
#   ``report["causes"]`` has its family, and where possible a map or a curve of it; see
#   :doc:`the gap diagnosis </gap>`, which also states how often the diagnosis is right.
#   :doc:`Two real transits </real_transits>` shows what can be said without a diagnosis.
