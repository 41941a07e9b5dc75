"""Diagnose the gap between the fitted model and the images: where it lies, which effect causes it, how far it shrinks.

This package and `psfcore.blind` share no code on purpose: the blind set tests this library, so its effects are written
independently.

Each effect is one `effect.Effect`. To add an effect of your own, write a Python file that defines EFFECTS, like this
one:

    import numpy as np
    from psfcore.gap.effect import Change, Effect, EffectParameter

    def glow(view):
        x, _ = view.places
        plane = np.exp(-(((x - 0.5) / 0.15) ** 2)).astype(np.float32)
        return [Change(lambda n, images: plane, unocculted=False)]

    EFFECTS = (Effect("lamp_glow", "detector", (EffectParameter("height", "DN/s", 5.0),),
        "A lamp beside the detector lights its right edge.", "a dark exposure", ("detector_x",), glow),)

`heliopsf gap TRANSIT --local --effects FILE.py` tests your effects together with the library. A service also tests the
effects of the modules that its operator names in HELIOPSF_GAP_EFFECTS.
"""
