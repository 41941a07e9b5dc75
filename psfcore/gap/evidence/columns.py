"""The columns of the free fields: what a change of unknown form does to the discs and to the unocculted blocks.

A field is an operator times a modulation (`tree` lists them). The operator says what changes, for example added light,
the gain or the PSF; the modulation says how the change depends on place, time, pointing, or kind of image. A column is
one coefficient of the field.

| operator | change of image n at the place x, with the bumps b(x) |
|---|---|
| light | L b(x) |
| offset | L b(x) T / t_n |
| gain | E_n(x) b(x) |
| kernel | scene * k(r) times 1, cos a, sin a, cos 2a, sin 2a: a change of the PSF |
| ring | the same without the factors of the azimuth |
| | kernel and ring have one more form: a wider core, the mean of the neighbouring boxes minus the box |
| tilted_kernel | x or y times (scene * k(r)) |
| scatter | (b(x) scene) * k(r): more or less scatter of the light of a place |
| outside | light of b(side) beside the field, convolved with the PSF |
| edge | E and R times 1 and the patterns of `DiscCells.patterns`, in the discs alone; R is the scene around the disc |

L is the mean light of the discs, DN/s; t_n is the exposure time and 1 / T the mean of 1 / t_n; E_n is the expected
image; r and a are the radius and the azimuth in the PSF; * is the convolution. Bumps are Gaussians on a grid, of the
width w in units of half the detector; k(r) are Gaussians in the logarithm of the radius, half an octave wide. A change
e of the image changes a cell with the sensitivity q by q . e (`cells`), summed over boxes of the detector that are much
smaller than a bump.

In the unocculted blocks all images of a pointing share the scene: a change of the PSF there acts on the mean scene of
the pointing, because the scene of each image contains the changes of the Sun itself. The columns of all images
therefore are

    column(n, place; form, k) = S(pointing of n, place; form) size_n W(n; k)                              Eq. (1)

with the response S of the operator to one coefficient, its size_n in image n, and the modulation W. In a disc, S
belongs to the image.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial

import numpy as np
from numpy.typing import NDArray

from psfcore.arrays import Matrix, Vector
from psfcore.convolution.convolver import Convolver, linear_convolve
from psfcore.gap.effect import Change, Effect, EffectParameter
from psfcore.gap.evidence.cells import DiscCells
from psfcore.gap.evidence.responses import Evidence
from psfcore.gap.evidence.tree import FAMILIES, WIDTHS, Field

LIKELY = 0.02  # likely relative size of a coefficient; the evidence also tries ten times this size
KERNEL_LIKELY, OUTSIDE_LIKELY = (
    0.25,
    10.0,
)  # the same for the optics, and for light from outside, in units of LIKELY
SPACING = 1.2  # distance of two bumps, in units of their width
OCTAVES = 0.5  # width of a bump of the optics, and distance of two of them, in octaves of the radius
NEAREST_BOXES = 2.0  # smallest radius of a bump of the optics, in boxes
RINGS_OF_PLACES = {
    WIDTHS[1]: 2,
    WIDTHS[2]: 3,
}  # how many radii `scatter` distinguishes, by the width of its bumps
LARGEST_SQUARE = WIDTHS[1]  # width of the bumps whose squares are places on the detector
EDGE_FORMS = 12  # six patterns in units of the light of the disc, and six in units of the scene around it
EDGE_LIKELY = 0.1  # the likely size of the latter, in units of LIKELY
AROUND = (1.3, 2.5)  # the ring around a disc, in radii of its dark pixels
OUTSIDE_BOXES = 8  # how far light beside the field extends
SIDES = 3  # bumps on each side of the field
IN_TIME = WIDTHS[-1]  # width in time of the bumps of fields that also change with place, or with the radius
_OF_PSF = ("kernel", "ring", "tilted_kernel", "scatter")
_FACTORS: tuple[Callable[[Matrix], Matrix], ...] = (
    np.ones_like,
    np.cos,
    np.sin,
    lambda a: np.cos(2 * a),
    lambda a: np.sin(2 * a),
)


@dataclass(frozen=True, eq=False)
class Responses:
    """The response S of Eq. (1) of one operator.

    Attributes
    ----------
    discs
        The response of the discs (discs, cells, forms), DN/s, padded with zeros for discs with fewer cells.
    blocks
        The response of the blocks of each pointing (blocks, forms), DN/s; zero if the operator does not reach the
        blocks.
    size
        The factor size_n of each image (images,).
    """

    discs: Matrix
    blocks: dict[int, Matrix]
    size: Vector


class FieldColumns:
    """The columns of every field for the data of one fit. Only the data of `evidence` count, not its effects."""

    def __init__(self, evidence: Evidence) -> None:
        self._evidence = evidence
        self._discs, self._blocks, self._infos = evidence.discs, evidence.unocculted, evidence.image_info
        self._light = float(np.mean([disc.mean_expected for disc in evidence.discs]))
        readouts = np.array([1 / info.exposure_s for info in self._infos])
        self._readouts = readouts / readouts.mean()
        times = np.array([info.time_s for info in self._infos])
        self.times = np.asarray(2 * (times - times.min()) / max(float(np.ptp(times)), 1e-9) - 1)
        rows, columns = self._discs[0].boxes.shape[-2:]
        self.at = _middles(rows), _middles(columns)
        across = self._blocks.across
        self._block_at = _middles(self._blocks.levels.shape[1] // across), _middles(across)
        self._cells = max(disc.residual.size for disc in self._discs)
        self._of: dict[tuple[str, float | None], Responses] = {}

    def discs(self, field: Field) -> Matrix:
        """The columns of a field in the discs: (discs, cells, columns), DN/s."""
        of, weight = self._responses(field), self._modulation(field)
        images = list(self._evidence.images)
        out = of.discs[..., None] * (of.size[images, None] * weight[images])[:, None, None, :]
        return np.asarray(out.reshape(*of.discs.shape[:2], -1))

    def blocks(self, field: Field, pointing: int, images: Sequence[int]) -> Matrix:
        """The columns of a field in the blocks of images of one pointing: (images, blocks, columns), DN/s."""
        of, weight, here = self._responses(field), self._modulation(field), list(images)
        out = of.blocks[pointing][..., None] * (of.size[here, None] * weight[here])[:, None, None, :]
        return np.asarray(out.reshape(*out.shape[:2], -1))

    def all_blocks(self, field: Field) -> Matrix:
        """The columns of a field in the blocks of all images: (images, blocks, columns), DN/s."""
        pointing = self._blocks.pointing
        out = np.zeros((*self._blocks.levels.shape, self.count(field)))
        for one in np.unique(pointing).tolist():
            here = np.flatnonzero(pointing == one)
            out[here] = self.blocks(field, one, here.tolist()) if field.in_blocks else 0.0
        return out

    def count(self, field: Field) -> int:
        """The number of columns of a field."""
        return int(self._responses(field).discs.shape[2] * self._modulation(field).shape[1])

    def squares(self, field: Field) -> list[NDArray[np.intp]]:
        """For a field with bumps on a grid of the detector: the columns of each square of 2 x 2 neighbouring bumps,
        else an empty list.
        """
        if (
            field.width is None
            or field.modulation not in ("place", "pointing")
            or field.width > LARGEST_SQUARE
            or field.operator == "outside"
        ):
            return []
        side = bumps([0.0], field.width).shape[0]
        each = np.arange(self.count(field)).reshape(side, side, -1)
        corners = itertools.product(range(side - 1), repeat=2)
        return [each[y : y + 2, x : x + 2].ravel() for y, x in corners]

    def _modulation(self, field: Field) -> Matrix:
        """W of Eq. (1): (images, k)."""
        infos = self._infos
        if field.modulation in ("constant", "place"):
            return np.ones((len(infos), 1))
        if field.modulation.startswith("pointing"):
            every = sorted({info.pointing for info in infos}) if field.pointing is None else [field.pointing]
            return np.array([[float(info.pointing == one) for one in every] for info in infos])
        if field.modulation == "kind":
            kinds = [(info.exposure_s, info.gain_mode) for info in infos]
            return np.array([[float(kind == one) for one in dict.fromkeys(kinds)] for kind in kinds])
        width = field.width if field.modulation == "time" and field.width is not None else IN_TIME
        return bumps(self.times, width).T

    def _responses(self, field: Field) -> Responses:
        key = field.operator, field.width_of_forms
        if key not in self._of:
            self._of[key] = self._computed(*key)
        return self._of[key]

    def _computed(self, operator: str, width: float | None) -> Responses:
        ones, pointings = np.ones(len(self._infos)), np.unique(self._blocks.pointing).tolist()
        if operator == "edge":
            return Responses(self._patterns_of_discs(), self._nothing(EDGE_FORMS), ones)
        in_discs = self._in_discs(operator, width)
        if operator == "outside":
            return Responses(in_discs, self._nothing(in_discs.shape[2]), ones)
        if operator in _OF_PSF:
            means = {
                p: self._to_blocks(self._forms(operator, width, self._scene_of_pointing(p)))
                for p in pointings
            }
            return Responses(in_discs, means, ones)
        patterns = self._size(operator) * _patterns(*self._block_at, width).reshape(in_discs.shape[2], -1).T
        of_blocks = dict.fromkeys(pointings, patterns)
        if operator == "gain":
            of_blocks = {
                p: self._blocks.means[self._blocks.pointing == p][0][:, None] * patterns for p in pointings
            }
        return Responses(in_discs, of_blocks, self._readouts if operator == "offset" else ones)

    def _size(self, operator: str) -> float:
        """The change by a coefficient of 1 where its bump is 1: DN/s, or a share of the light."""
        return KERNEL_LIKELY if operator in _OF_PSF else 1.0 if operator == "gain" else self._light

    def _forms(self, operator: str, width: float | None, scene: Matrix) -> Matrix:
        """The change of an image by each form (forms, boxes along y, boxes along x), DN/s; for a gain relative to the
        image.

        Parameters
        ----------
        scene
            The scene of the image, on the boxes.
        """
        if operator == "outside":
            return self._outside
        if operator not in _OF_PSF:
            return self._size(operator) * _patterns(*self.at, width)
        scene = self._size(operator) * scene
        if operator == "kernel":
            return np.array([*(one.apply(scene) for one in self._kernels), _core(scene)], dtype=np.float64)
        rings = self._kernels[:: len(_FACTORS)]
        if operator == "scatter":
            assert width is not None
            chosen = np.linspace(1, len(rings) - 2, RINGS_OF_PLACES[width]).round().astype(int)
            weighted = scene * _patterns(*self.at, width)
            return np.array([rings[k].apply(one) for one in weighted for k in chosen], dtype=np.float64)
        changed = np.array([ring.apply(scene) for ring in rings], dtype=np.float64)
        if operator == "ring":
            return np.concatenate([changed, _core(scene)[None]])
        return np.concatenate([changed * self.at[1], changed * self.at[0][:, None]])

    @cached_property
    def _scenes(self) -> dict[int, Matrix]:
        """The scene of every image with a disc, on the boxes."""
        return {disc.index: disc.scene.astype(np.float64) for disc in self._discs}

    def _scene_of_pointing(self, pointing: int) -> Matrix:
        """The median scene of a pointing, on the boxes."""
        own = [scene for n, scene in self._scenes.items() if self._infos[n].pointing == pointing]
        return np.median(own, axis=0) if own else np.zeros([one.size for one in self.at])

    def _in_discs(self, operator: str, width: float | None) -> Matrix:
        """Q . e of every form for every cell (discs, cells, forms)."""
        boxes = (disc.boxes[int(operator == "gain")] for disc in self._discs)
        each = [one.reshape(len(one), -1).astype(np.float64) for one in boxes]
        if operator in _OF_PSF:
            planes = (self._forms(operator, width, self._scenes[disc.index]) for disc in self._discs)
            found = [q @ one.reshape(len(one), -1).T for q, one in zip(each, planes, strict=True)]
        else:
            forms = self._forms(operator, width, self._scenes[self._discs[0].index])
            whole = np.concatenate(each) @ forms.reshape(len(forms), -1).T
            found = np.split(whole, np.cumsum([len(q) for q in each])[:-1])
        return np.array([np.pad(one, ((0, self._cells - len(one)), (0, 0))) for one in found])

    # --- one field -----------------------------------------------------------------------------------------

    def effect(self, field: Field, part: Sequence[int], likely: Sequence[float]) -> Effect:
        """Some coefficients of a field as an effect.

        Parameters
        ----------
        likely
            The likely size of each coefficient.
        """
        weight, edge = self._modulation(field), self._evidence.box_px
        size = self._readouts if field.operator == "offset" else np.ones(len(weight))
        last: dict[int, Matrix] = {}

        def change(n: int, images: Sequence[NDArray[np.float32]], k: int) -> NDArray[np.float32]:
            if n not in last:
                last.clear()
                scene = self._scenes.get(n)
                if scene is None:
                    scene = self._scene_of_pointing(self._infos[n].pointing)
                last[n] = self._forms(field.operator, field.width_of_forms, scene)
            form, time = divmod(part[k], weight.shape[1])
            plane = (size[n] * weight[n, time] * last[n][form]).repeat(edge, axis=0).repeat(edge, axis=1)
            image = images[n]
            short = [(0, max(whole - own, 0)) for whole, own in zip(image.shape, plane.shape, strict=True)]
            plane = np.pad(plane, short, mode="edge")
            return np.asarray(plane * image if field.operator == "gain" else plane, dtype=np.float32)

        family = FAMILIES[field.family]
        return Effect(
            another(field.family),
            family.stage,
            tuple(EffectParameter(f"bump_{k}", "", float(one)) for k, one in enumerate(likely)),
            f"A change of another form: {family.words}.",
            family.settled_by,
            family.axes,
            lambda view: [Change(partial(change, k=k), unocculted=field.in_blocks) for k in range(len(part))],
            field=True,
            family=field.family,
        )

    def shape(self, field: Field, part: Sequence[int], values: Vector, covariance: Matrix) -> FieldShape:
        """The shape of a field with these coefficients (those of `part`): a map of the detector, or a curve.

        A map that changes with time is shown at the end. A curve in time shows the change that all places share; for
        the PSF, the light that all radii together move.
        """
        weight, optics = self._modulation(field), field.operator in _OF_PSF
        forms = self._responses(field).discs.shape[2]
        (y, x), edge = self.at, self._evidence.box_px
        axes, at = tuple[str, ...](), np.zeros((0, 0))
        of_forms, now = np.zeros((0, forms)), weight[-1:]
        if field.operator == "kernel":
            axes, at = ("radius_px",), np.array([[edge * 2.0**octave] for octave in self.octaves.tolist()])
            # The light of each bump in an octave around each radius.
            apart = self.octaves[:, None] - self.octaves
            rings = np.exp(-0.5 * (apart / OCTAVES) ** 2) / (OCTAVES * np.sqrt(2 * np.pi))
            of_forms = np.pad(np.kron(rings, np.eye(1, len(_FACTORS))), ((0, 0), (0, 1)))
        elif field.operator == "ring" or (field.modulation == "time" and field.operator != "tilted_kernel"):
            axes, at = ("time_s",), np.array([[info.time_s] for info in self._infos])
            of_forms, now = np.eye(1, forms), weight
            if optics:
                of_forms = np.append(np.ones((1, forms - 1)), [[0.0]], axis=1)
        elif field.operator not in ("edge", "outside") and field.modulation != "kind":
            patterns = _patterns(y, x, field.width_of_forms)[int(field.operator == "tilted_kernel") :]
            of_forms = np.repeat(patterns, forms // len(patterns), axis=0).reshape(forms, -1).T
            x_px, y_px = ((one + 1) / 2 * one.size * edge - 0.5 for one in (x, y))
            axes, at = ("x_px", "y_px"), np.stack(np.meshgrid(x_px, y_px), axis=-1).reshape(-1, 2)
            now = now if field.pointing is None else np.ones((1, 1))
        to_shape = self._size(field.operator) * np.kron(of_forms, now)[:, list(part)]
        sigma = np.sqrt(np.einsum("pc,cd,pd->p", to_shape, covariance, to_shape, optimize=True))
        unit = "share of the light" if optics else "" if field.operator == "gain" else "DN/s"
        return FieldShape(axes, at, to_shape @ values, sigma, unit)

    def _nothing(self, forms: int) -> dict[int, Matrix]:
        blocks = self._blocks.levels.shape[1]
        return {int(p): np.zeros((blocks, forms)) for p in np.unique(self._blocks.pointing)}

    def _to_blocks(self, planes: Matrix) -> Matrix:
        """Means over the blocks (blocks, forms) of planes on the boxes; a block has a whole number of boxes, or the
        nearest box counts.
        """
        (rows, columns), (down, across) = planes.shape[1:], (one.size for one in self._block_at)
        edge = rows // down
        if edge:
            cut = planes[:, : edge * down, : edge * across]
            return np.asarray(
                cut.reshape(-1, down, edge, across, edge).mean(axis=(2, 4)).reshape(len(planes), -1).T
            )
        y, x = (np.arange(n) * size // n for n, size in ((down, rows), (across, columns)))
        return np.asarray(planes[:, y[:, None], x].reshape(len(planes), -1).T)

    def _patterns_of_discs(self) -> Matrix:
        out = np.zeros((len(self._discs), self._cells, EDGE_FORMS))
        for k, disc in enumerate(self._discs):
            own = np.vstack([np.ones(disc.residual.size), disc.patterns]).T
            levels = disc.mean_expected, EDGE_LIKELY * self._around(disc)
            out[k, : disc.residual.size] = np.hstack([level * own for level in levels])
        return out

    def _around(self, disc: DiscCells) -> float:
        """The mean scene in a ring around a disc, DN/s."""
        info, edge = self._infos[disc.index], self._evidence.box_px
        y, x = ((np.arange(one.size) + 0.5) * edge - 0.5 for one in self.at)
        r = np.hypot(y[:, None] - info.y_px, x - info.x_px) / np.sqrt(disc.pixels.sum() / np.pi)
        ring = (r > AROUND[0]) & (r < AROUND[1])
        return float(disc.scene[ring].mean()) if ring.any() else 0.0

    # --- the PSF -------------------------------------------------------------------------------------------

    @cached_property
    def octaves(self) -> Vector:
        """log2 of the radius of each bump of the optics, in boxes."""
        reach = max(one.size for one in self.at)
        return np.arange(np.log2(NEAREST_BOXES), np.log2(reach), OCTAVES)

    @cached_property
    def _kernels(self) -> list[Convolver]:
        """The convolutions with the changes of the PSF on the boxes, each of sum 1 before its factor of the azimuth."""
        reach = max(one.size for one in self.at)
        d = np.arange(-reach + 1, reach)
        r, a = np.hypot(d[:, None], d[None, :]), np.arctan2(d[:, None], d[None, :])
        octave = np.log2(np.maximum(r, 0.5))
        rings = (np.exp(-0.5 * ((octave - centre) / OCTAVES) ** 2) for centre in self.octaves)
        shape = self.at[0].size, self.at[1].size
        return [Convolver(ring / ring.sum() * factor(a), shape) for ring in rings for factor in _FACTORS]

    @cached_property
    def _outside(self) -> Matrix:
        """The light of each bump beside the field that scatters onto the detector, DN/s."""
        rows, columns = (one.size for one in self.at)
        scene = float(np.mean([disc.scene.mean() for disc in self._discs]))
        wide = np.zeros((4 * SIDES, rows + 2 * OUTSIDE_BOXES, columns + 2 * OUTSIDE_BOXES))
        along_y, along_x = (bumps(_middles(n), 2 / (SIDES - 1) / SPACING)[:SIDES] for n in wide.shape[1:])
        for k in range(SIDES):
            wide[4 * k, :OUTSIDE_BOXES] = wide[4 * k + 1, -OUTSIDE_BOXES:] = along_x[k]
            wide[4 * k + 2, :, :OUTSIDE_BOXES] = wide[4 * k + 3, :, -OUTSIDE_BOXES:] = along_y[k][:, None]
        wide[:, OUTSIDE_BOXES:-OUTSIDE_BOXES, OUTSIDE_BOXES:-OUTSIDE_BOXES] = 0.0
        spread = linear_convolve(wide, self._evidence.kernel, (rows, columns))
        return OUTSIDE_LIKELY * scene * spread


@dataclass(frozen=True, eq=False)
class FieldShape:
    """The shape of a field.

    Attributes
    ----------
    axes
        The names of the axes of `at` (points, axes): x and y on the detector, time, or radius in the PSF; empty if the
        field has no shape.
    values, sigma
        Value and error at each point (points,), in `unit`; for the optics a share of the light, along the radius per
        octave.
    """

    axes: tuple[str, ...]
    at: Matrix
    values: Vector
    sigma: Vector
    unit: str

    @property
    def clearest(self) -> int:
        """The point whose value is largest in units of its error."""
        return int(np.argmax(np.abs(self.values) / np.maximum(self.sigma, 1e-300)))


def another(family: str) -> str:
    """The name of another form of a family, among the names of effects."""
    return f"another_{family}"


def with_effect(evidence: Evidence, effect: Effect, discs: Matrix, blocks: Matrix) -> Evidence:
    """The evidence with one more effect.

    Parameters
    ----------
    discs
        The columns of the effect in the discs (discs, cells, columns).
    blocks
        The columns of the effect in the blocks (images, blocks, columns).
    """
    own = tuple(range(evidence.size, evidence.size + len(effect.parameters)))
    errors = np.concatenate([evidence.unocculted.errors, np.moveaxis(blocks, -1, 0)])
    return replace(
        evidence,
        effects=(*evidence.effects, effect),
        columns=evidence.columns | {effect.name: own},
        discs=tuple(
            replace(disc, jacobian=np.vstack([disc.jacobian, change[: disc.residual.size].T]))
            for disc, change in zip(evidence.discs, discs, strict=True)
        ),
        unocculted=replace(evidence.unocculted, errors=errors),
    )


def _core(scene: Matrix) -> Matrix:
    """The change by a wider core of the PSF: the mean of the four neighbouring boxes minus the box. It moves light by
    less than a ring.
    """
    wide = np.pad(scene, 1, mode="edge")
    around = wide[:-2, 1:-1] + wide[2:, 1:-1] + wide[1:-1, :-2] + wide[1:-1, 2:]
    return np.asarray(around / 4 - scene)


def bumps(at: Sequence[float] | Vector, width: float) -> Matrix:
    """Gaussian bumps on a grid from -1 to 1: (bumps, places)."""
    count = int(np.ceil(2 / (SPACING * width))) + 1
    centres = np.linspace(-1, 1, count)
    return np.asarray(np.exp(-0.5 * ((np.asarray(at)[None] - centres[:, None]) / width) ** 2))


def _patterns(y: Vector, x: Vector, width: float | None) -> Matrix:
    """The forms of a change on the detector (forms, y, x): bumps of this width; None: 1, x and y."""
    if width is None:
        ones = np.ones((y.size, x.size))
        return np.array([ones, ones * x, ones * y[:, None]])
    grid = np.einsum("ay,bx->abyx", bumps(y, width), bumps(x, width))
    return np.asarray(grid.reshape(-1, y.size, x.size))


def _middles(count: int) -> Vector:
    """The middles of `count` equal parts of -1 ... 1."""
    return np.asarray((2 * np.arange(count) + 1) / count - 1)
