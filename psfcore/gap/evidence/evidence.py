"""The evidence: how the discs and the unocculted field respond to the PSF and to every effect.

The evidence consists of small arrays; the later steps of a diagnosis need nothing else. Each column of the Jacobian
belongs to one parameter: first the coordinates of the PSF, then the parameters of the effects. Near the fit, the images
are a linear function of these parameters. One pass over the images gives the Jacobian of the cells of the discs (`cells`)
and of the blocks of the unocculted field (`unocculted_blocks`).
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

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
from psfcore.transit.occulter import UNDESCRIBED, FoundPlace
from psfcore.transit.transit import Frame

Vector = NDArray[np.float64]
Matrix = NDArray[np.float64]

AT_ONCE = 16  # number of fields that are processed together


@dataclass(frozen=True)
class ImageInfo:
    """The properties of one image: its values on the axes.

    described: whether the neighbouring images in time show the scene around the occulter; the fitted position of the occulter
    is then reliable.
    """

    file: str
    pointing: int
    x_px: float
    y_px: float
    time_s: float
    exposure_s: float
    gain_mode: str | None
    scattering_distance_px: float
    described: bool = True


@dataclass(frozen=True, eq=False)
class Prior:
    """The prior of the parameter of each column, a Gaussian (columns,). The coordinates of the PSF have no prior.

    likely: the largest plausible size; infinite for the coordinates of the PSF. positive: whether the parameter cannot be
    negative. field: whether it is a coefficient of a random field.
    """

    likely: Vector
    positive: NDArray[np.bool_]
    field: NDArray[np.bool_]

    def precision(self, columns: Sequence[int], scale: float | Vector = 1.0) -> Vector:
        """1 / variance for these columns. scale: the width of the Gaussian, in units of the likely size."""
        return np.asarray((self.likely[list(columns)] * scale) ** -2.0)


@dataclass(frozen=True, eq=False)
class Evidence:
    """All the data that a diagnosis uses.

    effects: the effects that these data can show. columns: the columns of each effect, by its name. base: the columns that
    every fit contains. discs: the cells of each image that the fit used. image_info: the properties of every image,
    used or not. untestable: the reasons why effects cannot be tested, by name. box_px: the edge of a box of `DiscCells.boxes`. kernel: the total PSF, summed over boxes. templates: `Effect.distinguished` by effect.
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

    def columns_of(self, effect: str) -> dict[str, int]:
        """The column of each parameter of an effect, by the parameter's name.

        An effect that is fitted for each pointing may have fewer or more columns than parameters; a column or parameter
        without a partner is left out.
        """
        (found,) = (one for one in self.effects if one.name == effect)
        names = (parameter.name for parameter in found.parameters)
        return dict(zip(names, self.columns[effect], strict=False))

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
        return self.discs[0].jacobian.shape[0]

    @property
    def of_effects(self) -> range:
        """The columns after the base. For a full refit, these belong to the effects of that refit."""
        return range(len(self.base), self.size)


def gather(
    solution: Solution,
    library: Sequence[Effect],
    *,
    view: View | None = None,
    progress: Progress = lambda stage, step, steps: None,
) -> Evidence:
    """Compute the evidence of a solution for a library of effects. view: the view of the solution, if it exists already.

    Raises DataError "bad-effects" if an added effect fails.
    """
    view = view or View(solution)
    changes, columns, untestable = _changes(view, library)
    base = tuple(range(solution.inversion.coordinates.size))
    columns = {name: tuple(c + len(base) for c in here) for name, here in columns.items()}
    unocculted = unocculted_blocks(view, len(base) + len(changes), progress)
    part = set(solution.part)
    discs, distances = [], []
    count = len(solution.transit.frames)
    far = _Distance(view)
    for n in range(count):
        progress("effects", n, count)
        if n in part:
            discs.append(disc_with_jacobian(view, n, changes))
            distances.append(far.of(view, n))
        else:
            distances.append(float("nan"))
        for k, change in enumerate(changes):
            if change.unocculted:
                unocculted.errors[len(base) + k, n] = blocks(change.change(n, view.pointing_means))
    found = Evidence(
        effects=tuple(effect for effect in library if effect.name in columns),
        columns=columns,
        base=base,
        discs=tuple(discs),
        unocculted=unocculted,
        image_info=tuple(
            _image_info(frame, place, distance)
            for frame, place, distance in zip(
                solution.transit.frames, solution.sky.found, distances, strict=True
            )
        ),
        untestable=untestable,
        box_px=box_px(solution.transit.shape),
        kernel=coarse_kernel(view.kernel, box_px(solution.transit.shape)),
        templates={
            effect.name: effect.distinguished(view) if effect.distinguished else float(effect.trials)
            for effect in library
            if effect.name in columns
        },
    )
    return _testable(found)


def _changes(
    view: View, library: Sequence[Effect]
) -> tuple[list[Change], dict[str, tuple[int, ...]], dict[str, str]]:
    """Three results: the changes by all testable effects, in one list; for each of these effects, the indices of its
    changes in the list; for each other effect, the reason why it cannot be tested."""
    changes: list[Change] = []
    columns: dict[str, tuple[int, ...]] = {}
    untestable: dict[str, str] = {}
    for effect in library:
        reason = effect.why_not(view)
        if reason is not None:
            untestable[effect.name] = reason
            continue
        first = len(changes)
        changes.extend(effect.changes(view))
        columns[effect.name] = tuple(range(first, len(changes)))
    return changes, columns, untestable


def disc_with_jacobian(view: View, n: int, changes: Sequence[Change]) -> DiscCells:
    """The cells of image n, with the Jacobian of all columns."""
    solution = view.solution
    cells, planes = disc_cells(solution, n)
    flat = planes.reshape(planes.shape[0], -1)
    scene = view.occulted_scene(n)
    slopes = (slope.field(slope.convolve(scene)) for slope in view.slopes)
    fields = itertools.chain(slopes, (change.change(n, view.expected) for change in changes))
    jacobian = np.zeros((len(view.slopes) + len(changes), flat.shape[0]))
    for first in range(0, len(jacobian), AT_ONCE):
        # Several fields are processed together, so that the large planes of the cells are read from memory only once for them.
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
    """The evidence of another PSF for the same transit: its residuals and its Jacobian of the PSF, with the Jacobian of the effects
    of `evidence`.

    The Jacobian of the effects takes most of the time of `gather`, and hardly differs. view: of the other PSF. columns:
    the columns after the base that are kept; changes: the changes that belong to them, for discs whose cells have moved.
    The result has no effects. Discs that `evidence` lacks are left out.
    """
    kept = [*evidence.base, *columns]
    part = set(view.solution.part)
    unocculted = unocculted_blocks(view, len(kept), progress)
    unocculted.errors[:] = evidence.unocculted.errors[kept]
    return replace(
        evidence,
        effects=(),
        columns={},
        untestable={},
        discs=tuple(_disc_at(view, disc, kept, changes) for disc in evidence.discs if disc.index in part),
        unocculted=unocculted,
    )


def _disc_at(view: View, disc: DiscCells, kept: Sequence[int], changes: Sequence[Change]) -> DiscCells:
    other = view.solution
    place = other.sky.found[disc.index].place
    cells = cells_of(other.sky.dark[disc.index], place.x_px, place.y_px)
    if cells.pixels.size != disc.pixels.size:  # its outermost dark pixels moved
        return disc_with_jacobian(view, disc.index, changes)
    residual, expected = other.residual(disc.index)
    jacobian = disc.jacobian[list(kept)]
    for k, slope in enumerate(view.slopes):
        jacobian[k] = cells.weights @ other.jacobian(disc.index, slope)
    return replace(
        disc,
        residual=cells.weights @ residual,
        expected=cells.weights @ expected,
        jacobian=jacobian,
    )


class _Distance:
    """The mean distance r from which light scatters into a disc, weighted with the light that comes from each
    distance."""

    def __init__(self, view: View) -> None:
        kernel, solution = view.kernel, view.solution
        d = np.arange(kernel.shape[0]) - kernel.shape[0] // 2
        weighted = kernel * np.hypot(d[:, None], d[None, :])
        self._blur = Blur(weighted, solution.transit.shape, threads=solution.threads)

    def of(self, view: View, n: int) -> float:
        """The mean distance for image n, px."""
        solution = view.solution
        dark = solution.sky.dark[n]
        scene = view.occulted_scene(n)
        there = self._blur.field(self._blur.convolve(scene))[dark].mean()
        return float(there / max(float(view.expected[n][dark].mean()), 1e-9))


def _image_info(frame: Frame, found: FoundPlace, distance_px: float) -> ImageInfo:
    return ImageInfo(
        file=frame.file,
        pointing=frame.pointing,
        x_px=found.place.x_px,
        y_px=found.place.y_px,
        time_s=frame.time_s,
        exposure_s=frame.exposure_s,
        gain_mode=frame.gain_mode,
        scattering_distance_px=distance_px,
        described=found.neighbours > 0 and found.chi2_per_pixel < UNDESCRIBED,
    )


def _testable(evidence: Evidence) -> Evidence:
    """Remove the effects that change neither a disc nor a block, and list them as untestable."""
    untestable, columns = dict(evidence.untestable), dict(evidence.columns)
    for name, here in evidence.columns.items():
        if not here:  # the Sun has no template
            continue
        cells = max(float(np.abs(disc.jacobian[list(here)]).max()) for disc in evidence.discs)
        if not (cells > 0 or np.abs(evidence.unocculted.errors[list(here)]).max() > 0):
            untestable[name] = "it changes no image of this transit"
            del columns[name]
    effects = tuple(effect for effect in evidence.effects if effect.name in columns)
    return replace(evidence, effects=effects, columns=columns, untestable=untestable)
