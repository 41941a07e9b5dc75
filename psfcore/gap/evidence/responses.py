"""The evidence: how the discs and the unocculted field respond to the PSF and to every effect.

The evidence consists of small arrays; the later steps of a diagnosis need nothing else. Each column of the Jacobian
belongs to one parameter: first the coordinates of the PSF, then the parameters of the effects. Near the fit, the images
are a linear function of these parameters. One pass over the images gives the Jacobian of the cells of the discs
(`cells`) and of the blocks of the unocculted field (`unocculted_blocks`).
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np

from psfcore.arrays import Flags, Matrix, Vector
from psfcore.gap.effect import Change, Effect
from psfcore.gap.evidence.cells import (
    DiscCells,
    box_px,
    cells_of,
    coarse_kernel,
    disc_cells,
    summed_over_boxes,
)
from psfcore.gap.evidence.unocculted_blocks import (
    UnoccultedBlocks,
    UnoccultedEquations,
    blocks,
    unocculted_blocks,
)
from psfcore.gap.view import View
from psfcore.scatter.reconstruction import Progress, Solution
from psfcore.scatter.total_psf import Blur
from psfcore.transit.occulter import UNDESCRIBED

AT_ONCE = 16  # number of fields that are processed together


@dataclass(frozen=True)
class ImageInfo:
    """The properties of one image: its values on the axes.

    Attributes
    ----------
    scattering_distance_px
        The scattering distance; nan if the fit did not use the image.
    described
        Whether the neighbouring images in time show the scene around the occulter; the fitted position of the occulter
        is then reliable.
    """

    file: str
    pointing: int
    x_px: float
    y_px: float
    time_s: float
    exposure_s: float
    gain_mode: str | None
    scattering_distance_px: float = math.nan
    described: bool = True


@dataclass(frozen=True, eq=False)
class Prior:
    """The prior of the parameter of each column, a Gaussian (columns,). The coordinates of the PSF have no prior.

    Attributes
    ----------
    likely
        The largest plausible size of the parameter; infinite for the coordinates of the PSF.
    positive
        Whether the parameter cannot be negative.
    field
        Whether the parameter is a coefficient of a random field.
    """

    likely: Vector
    positive: Flags
    field: Flags


@dataclass(frozen=True, eq=False)
class Evidence:
    """All the data that a diagnosis uses.

    Attributes
    ----------
    effects
        The effects that these data can show.
    columns
        The columns of each effect, by its name.
    base
        The columns that every fit contains.
    discs
        The cells of each image that the fit used.
    image_info
        The properties of every image, used or not.
    untestable
        The reasons why effects cannot be tested, by name.
    box_px
        The edge of a box of `DiscCells.boxes`.
    kernel
        The total PSF, summed over boxes.
    templates
        The number of templates that the data distinguish (`Effect.distinguished`), by effect.
    """

    effects: tuple[Effect, ...]
    columns: dict[str, tuple[int, ...]]
    base: tuple[int, ...]
    discs: tuple[DiscCells, ...]
    unocculted: UnoccultedBlocks
    image_info: tuple[ImageInfo, ...]
    untestable: dict[str, str]
    box_px: int
    kernel: Matrix
    templates: dict[str, float] = field(default_factory=dict)

    @cached_property
    def prior(self) -> Prior:
        """The prior of every column."""
        nothing = np.zeros(self.size, np.bool_)
        found = Prior(np.full(self.size, np.inf), nothing, nothing.copy())
        for effect in self.effects:
            for column, parameter in zip(self.columns[effect.name], effect.parameters, strict=False):
                found.likely[column] = parameter.likely
                found.positive[column], found.field[column] = parameter.positive, effect.field
        return found

    @cached_property
    def images(self) -> tuple[int, ...]:
        """The index, among all images, of each image with a disc."""
        return tuple(disc.index for disc in self.discs)

    @cached_property
    def all_unocculted(self) -> UnoccultedEquations:
        """The normal equations of all columns from the unocculted blocks of all images."""
        return self.unocculted.equations(range(self.size))

    @property
    def size(self) -> int:
        """The number of columns."""
        return int(self.discs[0].jacobian.shape[0])


def gather(
    solution: Solution,
    library: Sequence[Effect],
    *,
    view: View | None = None,
    progress: Progress = lambda stage, step, steps: None,
) -> Evidence:
    """Compute the evidence of a solution for a library of effects.

    Raises DataError "bad-effects" if an added effect fails.

    Parameters
    ----------
    view
        The view of the solution, if it exists already.
    """
    view = view or View(solution)
    base = tuple(range(solution.inversion.coordinates.size))
    changes: list[Change] = []
    columns: dict[str, tuple[int, ...]] = {}
    untestable: dict[str, str] = {}
    for effect in library:
        reason = effect.why_not(view)
        if reason is not None:
            untestable[effect.name] = reason
            continue
        first = len(base) + len(changes)
        changes.extend(effect.changes(view))
        columns[effect.name] = tuple(range(first, len(base) + len(changes)))
    unocculted = unocculted_blocks(view, len(base) + len(changes), progress)
    part, frames = set(solution.part), solution.transit.frames
    discs, infos = [], []
    moved = _moved_outwards(view)
    for n, (frame, seen) in enumerate(zip(frames, solution.sky.found, strict=True)):
        progress("effects", n, len(frames))
        info = ImageInfo(
            file=frame.file,
            pointing=frame.pointing,
            x_px=seen.place.x_px,
            y_px=seen.place.y_px,
            time_s=frame.time_s,
            exposure_s=frame.exposure_s,
            gain_mode=frame.gain_mode,
            described=seen.neighbours > 0 and seen.chi2_per_pixel < UNDESCRIBED,
        )
        if n in part:
            discs.append(disc_with_jacobian(view, n, changes))
            dark = solution.sky.dark[n]
            far = moved.field(moved.convolve(view.occulted_scenes[n]))[dark].mean()
            light = max(float(view.expected[n][dark].mean()), 1e-9)
            info = replace(info, scattering_distance_px=float(far / light))
        infos.append(info)
        for k, change in enumerate(changes, len(base)):
            if change.unocculted:
                unocculted.errors[k, n] = blocks(change.change(n, view.pointing_means))
    for name, here in list(columns.items()):
        cells = max(float(np.abs(disc.jacobian[list(here)]).max(initial=0.0)) for disc in discs)
        # The Sun has no template.
        if here and not (cells > 0 or np.abs(unocculted.errors[list(here)]).max() > 0):
            untestable[name] = "it changes no image of this transit"
            del columns[name]
    effects = tuple(effect for effect in library if effect.name in columns)
    return Evidence(
        effects=effects,
        columns=columns,
        base=base,
        discs=tuple(discs),
        unocculted=unocculted,
        image_info=tuple(infos),
        untestable=untestable,
        box_px=box_px(solution.transit.shape),
        kernel=coarse_kernel(view.kernel, box_px(solution.transit.shape)),
        templates={
            effect.name: effect.distinguished(view) if effect.distinguished else float(effect.trials)
            for effect in effects
        },
    )


def _moved_outwards(view: View) -> Blur:
    """The convolution with the PSF times the distance r: the mean r from which light scatters, times this light."""
    d = np.arange(view.kernel.shape[0]) - view.kernel.shape[0] // 2
    weighted = view.kernel * np.hypot(d[:, None], d[None, :])
    return Blur(weighted, view.solution.transit.shape, threads=view.solution.threads)


def disc_with_jacobian(view: View, n: int, changes: Sequence[Change]) -> DiscCells:
    """The cells of image n, with the Jacobian of all columns."""
    solution = view.solution
    cells, planes = disc_cells(solution, n)
    flat = planes.reshape(planes.shape[0], -1)
    scene = view.occulted_scenes[n]
    slopes = (slope.field(slope.convolve(scene)) for slope in view.slopes)
    fields = itertools.chain(slopes, (change.change(n, view.expected) for change in changes))
    jacobian = np.zeros((len(view.slopes) + len(changes), flat.shape[0]))
    for first in range(0, len(jacobian), AT_ONCE):
        # Several fields are processed together, so that the large planes of the cells are read from memory only once
        # for them.
        some = np.array([np.ravel(one) for one in itertools.islice(fields, AT_ONCE)], dtype=flat.dtype)
        jacobian[first : first + AT_ONCE] = some @ flat.T
    boxes = np.array([summed_over_boxes(planes), summed_over_boxes(planes * view.expected[n])])
    whole = solution.optics.field(scene)
    in_boxes = summed_over_boxes(whole[None])[0].astype(np.float64) / box_px(whole.shape) ** 2
    return replace(cells, jacobian=jacobian, boxes=boxes, scene=in_boxes)


def residuals_at(
    view: View,
    evidence: Evidence,
    columns: Sequence[int] = (),
    changes: Sequence[Change] = (),
    progress: Progress = lambda stage, step, steps: None,
) -> Evidence:
    """The evidence of another PSF for the same transit: its residuals and its Jacobian of the PSF, with the Jacobian of
    the effects of `evidence`.

    The Jacobian of the effects takes most of the time of `gather`, and hardly differs. The result has no effects. Discs
    that `evidence` lacks are left out.

    Parameters
    ----------
    view
        The view of the other PSF.
    columns
        The columns after the base that are kept.
    changes
        The changes that belong to these columns, for discs whose cells have moved.
    """
    rows = [*evidence.base, *columns]
    part = set(view.solution.part)
    unocculted = unocculted_blocks(view, len(rows), progress)
    unocculted.errors[:] = evidence.unocculted.errors[rows]
    return replace(
        evidence,
        effects=(),
        columns={},
        untestable={},
        discs=tuple(_disc_at(view, disc, rows, changes) for disc in evidence.discs if disc.index in part),
        unocculted=unocculted,
    )


def _disc_at(view: View, disc: DiscCells, rows: Sequence[int], changes: Sequence[Change]) -> DiscCells:
    other = view.solution
    place = other.sky.found[disc.index].place
    cells = cells_of(other.sky.dark[disc.index], place.x_px, place.y_px)
    if cells.pixels.size != disc.pixels.size:  # its outermost dark pixels moved
        return disc_with_jacobian(view, disc.index, changes)
    residual, expected, by_coordinates = other.residual_with_jacobian(disc.index, view.slopes)
    jacobian = disc.jacobian[list(rows)]
    jacobian[: len(by_coordinates)] = by_coordinates @ cells.weights.T
    return replace(
        disc,
        residual=cells.weights @ residual,
        expected=cells.weights @ expected,
        jacobian=jacobian,
    )
