"""The figure of a PSF that changes over the field."""

from __future__ import annotations

from matplotlib.colors import LogNorm
from matplotlib.figure import Figure
from matplotlib.layout_engine import ConstrainedLayoutEngine

from psfcore.instruments.psf_statements import title
from psfcore.psf import Psf, crop_centred, light_beyond_map
from psfcore.psf_field import nine_places

_CENTRAL_PX = 129
_TOLD_PX = 10.0
_FAINTEST = 1e-6  # of the peak


def field_figure(psf: Psf) -> Figure:
    """Draw the centre of a PSF at nine places of the detector, with one scale for all, and the light beyond a radius at
    each place.
    """
    assert psf.place is not None
    nx, ny = psf.place.detector
    figure = Figure(figsize=(11.0, 11.6), dpi=100, facecolor="white", layout=ConstrainedLayoutEngine())
    heading = f"{title(psf.name, psf.version, psf.status)}, at nine places of the detector of {nx} x {ny} px"
    figure.suptitle(heading, fontsize=14, weight="bold")
    size = min(_CENTRAL_PX, *psf.kernel.shape)
    places = list(nine_places())
    centres = [crop_centred(psf.at(u, v), (size, size)) for u, v in places]
    peak = max(float(centre.max()) for centre in centres)
    extent = (-(size // 2) - 0.5, size - size // 2 - 0.5) * 2
    of_places = figure.subplots(3, 3, sharex=True, sharey=True)
    beyond = light_beyond_map(psf, [_TOLD_PX])
    for axes, (u, v), centre, pct in zip(of_places[::-1].flat, places, centres, beyond.flat, strict=True):
        drawn = axes.imshow(
            centre,
            origin="lower",
            cmap="magma",
            norm=LogNorm(peak * _FAINTEST, peak, clip=True),
            extent=extent,
            interpolation="nearest",
        )
        pixel = f"x {(u + 1) / 2 * (nx - 1):.0f}, y {(v + 1) / 2 * (ny - 1):.0f} px"
        axes.set_title(f"{pixel}: {pct:.2f} % beyond {_TOLD_PX:g} px", fontsize=10)
    figure.colorbar(drawn, ax=of_places, label="Weight (fraction per pixel)", shrink=0.6)
    figure.supxlabel("x from centre (px)")
    figure.supylabel("y from centre (px)")
    return figure
