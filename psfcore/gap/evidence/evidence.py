"""What discs and lit parts say of every effect at once: small arrays, from which all questions are answered.

Columns are the PSF's coordinates first, then the effects' parameters. About the solution everything is linear in
them: one look at each image gives how its cells (`cells`) and its lit blocks (`lit_blocks`) answer to all of them.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from psfcore.gap.effect import Change, Effect, View
from psfcore.gap.evidence.cells import DiscCells, disc_cells
from psfcore.gap.evidence.lit_blocks import LitBlocks, LitEquations, blocks, lit_blocks
from psfcore.scatter.inversion import Progress, Solution
from psfcore.scatter.optics import Blur
from psfcore.transit.occulter import UNDESCRIBED, FoundPlace
from psfcore.transit.transit import Frame

Vector = NDArray[np.float64]
Matrix = NDArray[np.float64]

AT_ONCE = 16  # fields that are looked at together


@dataclass(frozen=True)
class Taken:
    """How one image was taken: what the axes are made of. described: whether its neighbours in time show what is round its
    occulter, so that this was found where it is."""

    file: str
    fov: int
    x_px: float
    y_px: float
    time_s: float
    exposure_s: float
    gain_mode: str | None
    scattering_distance_px: float
    described: bool = True


@dataclass(frozen=True, eq=False)
class Evidence:
    """All that a diagnosis goes by. discs: of the images that took part. taken: of all images. numbers: of `Change`, by
    column."""

    effects: tuple[Effect, ...]
    columns: dict[str, tuple[int, ...]]
    base: tuple[int, ...]
    discs: tuple[DiscCells, ...]
    lit: LitBlocks
    taken: tuple[Taken, ...]
    untestable: dict[str, str]
    numbers: dict[int, int] = field(default_factory=dict)

    def numbers_of(self, columns: Sequence[int]) -> int:
        """How many numbers were taken from the lit parts to make the changes of these columns."""
        return sum(self.numbers.get(column, 0) for column in columns)

    @cached_property
    def images(self) -> tuple[int, ...]:
        """Positions, among all images, of those with a disc."""
        return tuple(disc.index for disc in self.discs)

    def lit_equations(self, images: Sequence[int] | None = None) -> LitEquations:
        """The lit blocks' equations of all columns, from some images (none: all)."""
        return self.whole_lit if images is None else self.lit.equations(range(self.size), images)

    @cached_property
    def whole_lit(self) -> LitEquations:
        """`lit_equations` of all images."""
        return self.lit.equations(range(self.size))

    @cached_property
    def steady_lit(self) -> LitEquations:
        """`whole_lit` with restless blocks weighed by what they show: what is left is judged by these."""
        return self.lit.with_restless_blocks().equations(range(self.size))

    @property
    def size(self) -> int:
        """How many columns there are."""
        return self.discs[0].answers.shape[0]

    @property
    def of_effects(self) -> range:
        """The columns behind the base: about a refit those of the effects that are in it."""
        return range(len(self.base), self.size)


def gather(
    solution: Solution,
    library: Sequence[Effect],
    *,
    view: View | None = None,
    progress: Progress = lambda stage, step, steps: None,
) -> Evidence:
    """The evidence of a solution on all effects of a library that these data can show. view: of it, where there is one.

    Raises DataError "bad-effects" of what somebody added.
    """
    view = view or View(solution)
    changes, columns, untestable = _changes(view, library)
    base = tuple(range(solution.inversion.coordinates.size))
    columns = {name: tuple(c + len(base) for c in here) for name, here in columns.items()}
    lit = lit_blocks(view, len(base) + len(changes), progress)
    part = set(solution.part)
    discs, distances = [], []
    count = len(solution.transit.frames)
    far = _Distance(view)
    for n in range(count):
        progress("effects", n, count)
        if n in part:
            discs.append(_disc(view, n, changes))
            distances.append(far.of(view, n))
        else:
            distances.append(float("nan"))
        for k, change in enumerate(changes):
            if change.lit:
                lit.errors[len(base) + k, n] = blocks(change.change(n, view.lit))
    found = Evidence(
        effects=tuple(effect for effect in library if effect.name in columns),
        columns=columns,
        base=base,
        discs=tuple(discs),
        lit=lit,
        taken=tuple(
            _taken(frame, place, distance)
            for frame, place, distance in zip(
                solution.transit.frames, solution.sky.found, distances, strict=True
            )
        ),
        untestable=untestable,
        numbers={len(base) + k: change.numbers for k, change in enumerate(changes) if change.numbers},
    )
    return _without_unseen(found)


def _changes(
    view: View, library: Sequence[Effect]
) -> tuple[list[Change], dict[str, tuple[int, ...]], dict[str, str]]:
    """Every effect's changes in a row, where each effect's are, and why some cannot be shown."""
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


def _disc(view: View, n: int, changes: Sequence[Change]) -> DiscCells:
    """The cells of one image with the answers of all columns."""
    solution = view.solution
    cells, planes = disc_cells(solution, n)
    flat = planes.reshape(planes.shape[0], -1)
    lit = view.lit_scene(n)
    slopes = (slope.field(slope.see(lit)) for slope in view.slopes)
    shown = [k for k, change in enumerate(changes) if change.disc]
    fields = itertools.chain(slopes, (changes[k].change(n, view.expected) for k in shown))
    rows = [*range(len(view.slopes)), *(len(view.slopes) + k for k in shown)]
    answers = np.zeros((len(view.slopes) + len(changes), flat.shape[0]))
    for first in range(0, len(rows), AT_ONCE):
        # Together: the cells' planes are read from memory once for all of them.
        some = np.array([np.ravel(one) for one in itertools.islice(fields, AT_ONCE)], dtype=flat.dtype)
        answers[rows[first : first + AT_ONCE]] = some @ flat.T
    return replace(cells, answers=answers)


class _Distance:
    """From how far, on average, light scatters into a disc: the mean of r weighted by the light that comes from there."""

    def __init__(self, view: View) -> None:
        kernel, solution = view.kernel, view.solution
        d = np.arange(kernel.shape[0]) - kernel.shape[0] // 2
        weighted = kernel * np.hypot(d[:, None], d[None, :])
        self._blur = Blur(weighted, solution.transit.shape, threads=solution.threads)

    def of(self, view: View, n: int) -> float:
        """In px, for image n."""
        solution = view.solution
        dark = solution.sky.dark[n]
        lit = view.lit_scene(n)
        there = self._blur.field(self._blur.see(lit))[dark].mean()
        return float(there / max(float(view.expected[n][dark].mean()), 1e-9))


def _taken(frame: Frame, found: FoundPlace, distance_px: float) -> Taken:
    return Taken(
        file=frame.file,
        fov=frame.pointing,
        x_px=found.place.x_px,
        y_px=found.place.y_px,
        time_s=frame.time_s,
        exposure_s=frame.exposure_s,
        gain_mode=frame.gain_mode,
        scattering_distance_px=distance_px,
        described=found.neighbours > 0 and found.chi2_per_pixel < UNDESCRIBED,
    )


def _without_unseen(evidence: Evidence) -> Evidence:
    """The evidence without effects that no image answers to."""
    untestable, columns = dict(evidence.untestable), dict(evidence.columns)
    for name, here in evidence.columns.items():
        cells = max(float(np.abs(disc.answers[list(here)]).max()) for disc in evidence.discs)
        if not (cells > 0 or np.abs(evidence.lit.errors[list(here)]).max() > 0):
            untestable[name] = "no image of this transit answers to it"
            del columns[name]
    effects = tuple(effect for effect in evidence.effects if effect.name in columns)
    return replace(evidence, effects=effects, columns=columns, untestable=untestable)
