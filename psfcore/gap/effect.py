"""An effect that the model does not contain: declared once, then used to explain a gap and to correct for it.

An effect changes the images, to first order, in proportion to a few parameters: e(n), in DN/s, is the change of image n
for one unit of a parameter. An effect of the optics changes the images by dH x, where H is the PSF and x the scene with
its occulter. The discs respond to a change through the whole estimate (`evidence.cells`), because the scene is
reconstructed from the same image. The unocculted field shows only differences between images of one pointing, and it
shows them directly.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Literal

from psfcore.gap.view import Field, View

Stage = Literal["scene", "optics", "detector"]


@dataclass(frozen=True)
class EffectParameter:
    """A parameter of an effect.

    likely: its largest plausible size, in its unit; ten times this value is hardly credible. positive: whether it cannot be
    negative, like a share of light.
    """

    name: str
    unit: str
    likely: float
    positive: bool = False


@dataclass(frozen=True, eq=False)
class Change:
    """What one unit of one parameter does: change(n, images) is the change of image n, [y, x] in DN/s.

    images: for the discs, all images as the model expects them, each with its own brightness; for the unocculted field, the
    mean image of each pointing. unocculted: whether the change differs between images of one pointing, so that the
    unocculted field shows it. disc: whether the discs show it. numbers: how many numbers were measured in the unocculted
    field to build this change; the effect's score is reduced for them.
    """

    change: Callable[[int, Sequence[Field]], Field]
    unocculted: bool = True
    disc: bool = True
    numbers: int = 0


@dataclass(frozen=True, eq=False)
class Effect:
    """One effect: its physical cause, the observation that would confirm it, and the axes along which it shows.

    changes(view): one change for each parameter. An effect that is fitted per pointing may return fewer or more changes;
    then they belong to the first parameters. why_not(view): why these data cannot show the effect, or None. trials: about
    how many places were searched; the score is reduced for them. named: whether the effect may be an answer. If not, it is
    a probe: a pattern typical of gaps of unknown cause, which suggests that the cause is not in the library. held(view): for
    an effect that searches for a place, the same effect with that place fixed. field: whether its parameters describe a
    random field in which each parameter is about as large as `likely`; the score is then reduced for the information gained
    about the parameters, not for their number.
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
