"""The scene of each pointing of a transit: east limb, solar disc or west limb; synthetic, or taken from an image."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import zoom

from psfcore.errors import DataError
from psfcore.simulate.plan import DISC, EAST, WEST, Plan
from psfcore.simulate.scene import Layout, solar_scene

Plane = NDArray[np.float64]

_LIMB = Layout(
    limb_centre=(2.10, 0.45),
    corona_dn_per_s=420.0,
    corona_height=0.075,
    sky_dn_per_s=4.0,
    regions=(),
    filament=False,
)
_DISC = Layout(limb_centre=(0.5, 0.5))
_LAYOUTS = {EAST: _LIMB, DISC: _DISC, WEST: _LIMB}


def drawn_scene(plan: Plan, pointing: int, seed: int) -> Plane:
    """The synthetic scene of a pointing, with margins: [y, x] in DN/s.

    Along each axis, a detector pixel contains plan.oversampling scene pixels. A west limb is a mirrored east limb made
    with another seed. Equal plans and seeds give equal scenes.
    """
    view = plan.views[pointing - 1]
    edge = plan.size_px * plan.oversampling
    own = int(np.random.SeedSequence([seed, pointing]).generate_state(1)[0])
    margin = plan.margin_px * plan.oversampling
    scene = solar_scene((edge, edge), own, layout=_LAYOUTS[view], margin_px=margin)
    return np.ascontiguousarray(plan.brightness * (scene[:, ::-1] if view == WEST else scene))


def scene_from_image(image: Plane, plan: Plan) -> Plane:
    """A scene of the same shape as drawn_scene returns, made from the pixels of an image [y, x] in DN/s.

    If the image is larger than the scene, its middle is used. If the image is smaller, it is enlarged by bilinear
    interpolation until its shorter edge equals the edge of the scene; the values in DN/s keep their level. Pixels that
    are negative or not finite become 0. Raises DataError "bad-scene".
    """
    if image.ndim != 2 or min(image.shape) < 2:
        raise DataError("bad-scene", f"expected a scene image with two axes; got shape {image.shape}")
    light = np.maximum(np.nan_to_num(image.astype(np.float64), nan=0.0, posinf=0.0, neginf=0.0), 0.0)
    if light.max() <= 0:
        raise DataError(
            "bad-scene",
            "expected a scene image with at least one positive pixel; all pixels of this image are 0, negative or not "
            "finite: give another image",
        )
    edge = (plan.size_px + 2 * plan.margin_px) * plan.oversampling
    if min(light.shape) < edge:
        factor = edge / min(light.shape)
        light = np.maximum(zoom(light, [max(edge, round(n * factor)) / n for n in light.shape], order=1), 0.0)
    top, left = (light.shape[0] - edge) // 2, (light.shape[1] - edge) // 2
    return np.ascontiguousarray(plan.brightness * light[top : top + edge, left : left + edge])
