"""An effect: a physical cause that the model leaves out. The same declaration serves to explain a gap and to correct
for it.

To first order, an effect changes the images in proportion to a few parameters: e(n), in DN/s, is the change of image n
for one unit of a parameter. An effect of the optics changes the images by dH x: dH is the change of the PSF, and x is
the scene with its occulter. The scene is reconstructed from the image. A change of the image therefore also changes the
light that the model predicts in the disc (`evidence.cells`). The unocculted field shows a change only if it
differs between the images of one pointing.

The stage of an effect is the step of the light on which it acts: the scene, the optics or the detector. Its family
(`evidence.tree`) says what kind of change it is, for example added light that changes with time.
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

    Attributes
    ----------
    likely
        The largest plausible size of the parameter, in its unit; ten times this size is hardly credible.
    positive
        Whether the parameter cannot be negative, for example because it is a share of light.
    """

    name: str
    unit: str
    likely: float
    positive: bool = False


@dataclass(frozen=True, eq=False)
class Change:
    """The change of the images by one unit of one parameter: change(n, images) is the change of image n, [y, x] in
    DN/s.

    images: one image [y, x] for each image of the transit. To compute the change of the discs, these are the model
    images. To compute the change of the unocculted field, they are the mean images of the pointings. unocculted:
    whether the change differs between images of one pointing, so that the unocculted field shows it.
    """

    change: Callable[[int, Sequence[Field]], Field]
    unocculted: bool = True


@dataclass(frozen=True, eq=False)
class Effect:
    """One effect: its physical cause, the observation that would confirm it, and the axes along which the gap varies.

    Attributes
    ----------
    family
        The name of the family of the effect in `evidence.tree`; empty: the effect is a family alone.
    cause
        A sentence about the cause, for the report.
    settled_by
        An observation that would confirm the effect, or exclude it.
    axes
        Names of the axes of the report along which the effect varies.
    changes
        Function of the view that returns one change for each parameter. An effect that is fitted for each pointing may
        return fewer or more changes than it has parameters. In this case, changes and parameters are paired in order. A
        change or parameter without a partner is not fitted.
    why_not
        Function of the view that returns the reason why these data cannot show the effect; None if they can.
    trials
        The approximate number of positions or templates among which the effect searches; it raises the p-value and the
        detection limit.
    distinguished
        Function of the view that returns how many of the positions or templates of `trials` the data distinguish
        (`search.distinguished`). A larger number lowers the evidence. None: the data distinguish all of them.
    held
        Function of the view, for an effect that searches for a position or a template: it returns the same effect with
        the result of the search fixed.
    field
        Whether the parameters describe a random field, in which each parameter is about as large as `likely`.
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
    distinguished: Callable[[View], float] | None = None
    held: Callable[[View], Effect] | None = None
    field: bool = False
    family: str = ""
