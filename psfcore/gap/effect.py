"""An effect that the model leaves out: declared once, used to explain a gap and to correct for it.

An effect is a change of the images, to first order and by a few numbers: e(n) for one unit of a parameter, in image n,
DN/s. What changes the optics changes the images by dH x, H the PSF and x the scene as it is lit. The discs show a
change through the whole estimate (`cells`), for the scene is reconstructed from the image that it is in. In the lit
part only what differs between images of one pointing is seen, as it stands.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Literal

from psfcore.gap.view import Field, View

Stage = Literal["scene", "optics", "detector"]


@dataclass(frozen=True)
class EffectParameter:
    """A number of an effect: its name, its unit, and how large it may well be; ten times that is hardly believed.

    positive: whether it can be nothing else, as a share of light.
    """

    name: str
    unit: str
    likely: float
    positive: bool = False


@dataclass(frozen=True, eq=False)
class Change:
    """What one unit of one parameter does: change(n, images) to image n [y, x] in DN/s.

    images: all images as they should be, each as bright as it is, or, for the lit part, their pointings' means. lit:
    whether it differs between images of one pointing where these are compared, so that the lit part shows it. disc:
    whether the discs do. numbers: how many numbers of its own were taken from the lit parts to make it, which its gain
    pays for.
    """

    change: Callable[[int, Sequence[Field]], Field]
    unocculted: bool = True
    disc: bool = True
    numbers: int = 0


@dataclass(frozen=True, eq=False)
class Effect:
    """One effect: its physical cause, what would settle it, and the axes along which it shows.

    changes(view): one a parameter; where there are fewer or more, as of what is fitted by pointing, the first ones'.
    why_not(view): why these data cannot show it, or None. trials: how many places were looked at for the best, about,
    which its gain pays for. named: whether it may be an answer; if not, it is a probe: a form that gaps of unknown cause
    have, which says that the cause is not in the library. held(view): of an effect that searches for a place, the same
    with that place held. field: whether its parameters are those of a random field, each about as large as is likely:
    its gain pays for what was learned of them, not for how many they are.
    """

    name: str
    stage: Stage
    parameters: tuple[EffectParameter, ...]
    cause: str
    settled_by: str
    axes: tuple[str, ...]
    changes: Callable[[View], Sequence[Change]]
    why_not: Callable[[View], str | None] = lambda view: None
    trials: int = 1
    named: bool = True
    held: Callable[[View], Effect] | None = None
    field: bool = False
