"""Fields: smooth changes of unknown form at each stage of the light, as alternatives to the forms of the library.

A field is a sum of bumps with random coefficients. Its bumps are Gaussians on a grid of the detector, of time, or of the
logarithm of the radius in the PSF. A field stands for every cause that acts at its stage and is smooth on the scale of its
width. The fields of some forms have the name of an effect of the library (`Field.effect`): a smooth gain error is a flat-field
residual, whatever its form. All other fields are an unknown cause. A field goes through the operator of its stage, as the
effects of the library do: a cell with the sensitivity q changes by q . e (`cells`). e is constant in boxes of the detector,
which are much smaller than a bump.

| form | stage | change of image n at the place x, with the bumps b |
|---|---|---|
| outside | scene | light of b(side) beside the field, in the images of one pointing, convolved with the PSF |
| light_in_pointing | scene | L b(x) in the images of one pointing |
| kernel | optics | the scene convolved with b(log r) times 1, cos a, sin a, cos 2a, sin 2a |
| kernel_over_field | optics | x or y times the scene convolved with b(log r) |
| kernel_in_time | optics | the scene convolved with b(log r), times b(time) |
| disc_shape | optics | the patterns of `DiscCells.patterns`, the same in every disc |
| light | detector | L b(x) |
| dark | detector | L b(x) T / t_n |
| gain | detector | E_n(x) b(x) |
| gain_by_exposure | detector | E_n(x) T / t_n times 1, x and y |
| light_in_time, dark_in_time, gain_in_time | time | as light, dark and gain, with b(time) times 1, x and y in place of b(x) |

L is the mean light of the discs, DN/s. t_n is the exposure time and 1 / T the mean of 1 / t_n. E_n is the expected image.
r and a are the radius and the azimuth in the PSF. The prior of a coefficient has the width LIKELY; for the optics this
width is KERNEL_LIKELY times as large, for light from outside OUTSIDE_LIKELY times.

A cause may have no form at all. The fields of the stage None stand for this case: every disc, every cell of every disc, or
every block of the detector (the same in every readout) changes by its own amount. They have many coefficients, so they are
probable only if the residuals after every other hypothesis are much larger than the noise.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from psfcore.convolution.convolver import Convolver, linear_convolve
from psfcore.gap.effect import Change, Effect, EffectParameter, Stage
from psfcore.gap.evidence.cells import DiscCells
from psfcore.gap.evidence.evidence import Evidence
from psfcore.gap.evidence.likelihood import Directions

Vector = NDArray[np.float64]
Matrix = NDArray[np.float64]
Planes = NDArray[np.float64]

UNKNOWN = "unknown"  # no effect may have this name
LIKELY = 0.02  # likely relative size of a coefficient; the likelihood also tries ten times this size
KERNEL_LIKELY, OUTSIDE_LIKELY = 0.25, 10.0
WIDTHS = (0.2, 0.4, 0.8)  # of a bump, in units of half the detector or half the duration
SPACING = 1.2  # distance of two bumps, in units of their width
OCTAVES = 0.5  # width of a bump of the optics, and distance of two of them, in octaves of the radius
NEAREST_BOXES = 2.0  # smallest radius of a bump of the optics, in boxes
OUTSIDE_BOXES = 8  # how far light beside the field extends
SIDES = 3  # bumps on each side of the field
DISC, CELL, BLOCK = "each_disc", "each_cell", "each_block"
FORMLESS = ((DISC,), (DISC, CELL), (BLOCK,), (DISC, BLOCK))

WORDS = {
    "outside": "light from beside the field in pointing",
    "light_in_pointing": "light added in pointing",
    "kernel": "a change of the PSF",
    "kernel_over_field": "a change of the PSF over the field",
    "kernel_in_time": "a change of the PSF with time",
    "disc_shape": "a change of the light with the place in the disc",
    "light": "light added on the detector",
    "dark": "an offset of each readout on the detector",
    "gain": "a gain error on the detector",
    "gain_by_exposure": "a gain that changes with the exposure time",
    "light_in_time": "added light that changes with time",
    "dark_in_time": "an offset of each readout that changes with time",
    "gain_in_time": "a gain that changes with time",
    DISC: "a change of each disc by its own amount",
    CELL: "a change of each place in each disc by its own amount",
    BLOCK: "a change of each block of the detector by its own amount",
}
_FACTORS: tuple[Callable[[Matrix], Matrix], ...] = (
    np.ones_like,
    np.cos,
    np.sin,
    lambda a: np.cos(2 * a),
    lambda a: np.sin(2 * a),
)


@dataclass(frozen=True)
class Field:
    """A field. form: of the table above. width: of its bumps, if it has one. pointing: of light in one pointing. parts: of a
    field without form, what changes."""

    stage: Stage | None
    form: str
    width: float | None = None
    pointing: int | None = None
    parts: tuple[str, ...] = ()

    @property
    def effect(self) -> str:
        """The name of the effect of the library whose form is free in this field; UNKNOWN if there is none."""
        if self.form == "light" and self.width == WIDTHS[-1]:
            return "intensity_gradient"
        # Bumps of the smallest width can change every disc by its own amount, so they say nothing of a flat field.
        if self.form == "gain" and self.width != WIDTHS[0]:
            return "flat_field_residual"
        return "field_dependent_scatter" if self.form == "kernel_over_field" else UNKNOWN

    @property
    def axes(self) -> tuple[str, ...]:
        """The axes of the report along which the field varies."""
        if self.stage == "time":
            return ("time",)
        if self.stage == "optics":
            return ("radius_in_disc", "azimuth_in_disc", "scattering_distance")
        along = {"dark": ("exposure",), "gain_by_exposure": ("exposure",)}.get(self.form, ())
        return () if self.stage is None else ("detector_x", "detector_y", *along)

    @property
    def words(self) -> str:
        """The field as text for reports."""
        if self.stage is None:
            return " and ".join(WORDS[part] for part in self.parts)
        told = WORDS[self.form]
        if self.pointing is not None:
            told += f" {self.pointing}"
        if self.width is None:
            return told
        of_what = "the duration" if self.stage == "time" else "the detector"
        return f"{told}, smooth over {50 * self.width:.0f} % of {of_what}"


def fields_of(evidence: Evidence) -> list[Field]:
    """The fields that the discs and blocks of a transit can show."""
    infos = evidence.image_info
    exposures = len({info.exposure_s for info in infos}) > 1
    pointings = sorted({info.pointing for info in infos})
    forms = ["light", "gain", *(["dark"] if exposures else [])]
    found = [Field("detector", form, width) for form in forms for width in WIDTHS]
    found += [Field("time", f"{form}_in_time", width) for form in forms for width in WIDTHS]
    for pointing in pointings:
        found.append(Field("scene", "outside", None, pointing))
        if len(pointings) > 1:
            found += [Field("scene", "light_in_pointing", width, pointing) for width in WIDTHS]
    if exposures:
        found.append(Field("detector", "gain_by_exposure"))
    found += [
        Field("optics", form) for form in ("kernel", "kernel_over_field", "kernel_in_time", "disc_shape")
    ]
    # An offset of a block that is the same in all exposures is a part of the scene.
    formless = [parts for parts in FORMLESS if exposures or BLOCK not in parts]
    return [*found, *(Field(None, "+".join(parts), parts=parts) for parts in formless)]


def bumps(at: Sequence[float] | Vector, width: float) -> Matrix:
    """Gaussian bumps on a grid from -1 to 1: (bumps, places)."""
    count = int(np.ceil(2 / (SPACING * width))) + 1
    centres = np.linspace(-1, 1, count)
    return np.asarray(np.exp(-0.5 * ((np.asarray(at)[None] - centres[:, None]) / width) ** 2))


class FieldColumns:
    """The columns of fields: the changes of the cells and blocks by their bumps.

    evidence: only its data count, not its effects. before: the columns of another fit to the same images. Its columns are used
    for the discs whose cells are the same, because they hardly differ.
    """

    def __init__(self, evidence: Evidence, before: FieldColumns | None = None) -> None:
        self._evidence = evidence
        self._discs, self._blocks = evidence.discs, evidence.unocculted
        self._infos = evidence.image_info
        self._light = float(np.mean([disc.mean_expected for disc in evidence.discs]))
        readouts = np.array([1 / info.exposure_s for info in self._infos])
        self._readouts = readouts / readouts.mean()
        times = np.array([info.time_s for info in self._infos])
        self._times = 2 * (times - times.min()) / max(float(np.ptp(times)), 1e-9) - 1
        self._scenes = {disc.index: disc.scene.astype(np.float64) for disc in self._discs}
        rows, columns = self._discs[0].boxes.shape[-2:]
        self._at = _middles(rows), _middles(columns)
        down = self._blocks.levels.shape[1] // self._blocks.across
        self._block_at = _middles(down), _middles(self._blocks.across)
        self._static: dict[tuple[Field, int], Planes] = {}
        self._through_kernels: dict[int, NDArray[np.float32]] = {}
        self._before = before
        self._of: dict[Field, Directions] = {}
        self._numbers = {disc.index: k for k, disc in enumerate(self._discs)}

    def of(self, field: Field) -> Directions:
        """The columns of a field. They are computed once."""
        if field not in self._of:
            formless = field.stage is None or field.form == "disc_shape"
            self._of[field] = self._without_planes(field) if formless else self._with_planes(field)
        return self._of[field]

    def _with_planes(self, field: Field) -> Directions:
        cells = max(disc.residual.size for disc in self._discs)
        in_discs = []
        for disc in self._discs:
            change = None if self._before is None else self._before.in_disc(field, disc)
            if change is None:
                planes = self.planes(field, disc.index)
                q = disc.boxes[int(_relative(field))].reshape(disc.residual.size, -1)
                change = q.astype(np.float64) @ planes.reshape(len(planes), -1).T
            in_discs.append(np.pad(change, ((0, cells - len(change)), (0, 0))))
        in_blocks = np.zeros((in_discs[0].shape[1], *self._blocks.levels.shape))
        if _in_blocks(field):
            for n in range(in_blocks.shape[1]):
                planes = self._of_detector(field, *self._block_at, n)
                in_blocks[:, n] = planes.reshape(len(planes), -1)
                if _relative(field):
                    in_blocks[:, n] *= self._blocks.means[n]
        return Directions(np.array(in_discs), in_blocks, LIKELY)

    def in_disc(self, field: Field, disc: DiscCells) -> Matrix | None:
        """The columns of a field in the cells of a disc (cells, columns); None if these columns have other cells for the disc."""
        k = self._numbers.get(disc.index)
        if k is None or self._discs[k].residual.size != disc.residual.size:
            return None
        return self.of(field).discs[k, : disc.residual.size]

    def planes(self, field: Field, n: int) -> Planes:
        """The change of image n for one unit of each coefficient (columns, boxes along y, boxes along x), DN/s; for a gain
        relative to the image."""
        if field.stage == "optics":
            return self._of_kernel(field, n)
        if field.form != "outside":
            return self._of_detector(field, *self._at, n)
        own = self._infos[n].pointing == field.pointing
        return self._outside if own else np.zeros_like(self._outside)

    def effect(self, field: Field, name: str) -> Effect:
        """The field as an effect of this name, for a full refit; it has one parameter for each bump. The fields that `refittable`
        excludes have no such effect."""
        edge = self._evidence.box_px
        count = len(self.planes(field, self._discs[0].index))
        last: dict[int, Planes] = {}

        def change(n: int, k: int, image: NDArray[np.float32]) -> NDArray[np.float32]:
            if n not in last:
                last.clear()
                last[n] = self.planes(field, n).astype(np.float32)
            plane = last[n][k].repeat(edge, axis=0).repeat(edge, axis=1)
            short = [(0, max(whole - part, 0)) for whole, part in zip(image.shape, plane.shape, strict=True)]
            plane = np.pad(plane, short, mode="edge")
            return np.asarray(plane * image if _relative(field) else plane)

        def changes(view: object) -> list[Change]:
            return [
                Change(lambda n, images, k=k: change(n, k, images[n]), unocculted=_in_blocks(field))  # type: ignore[misc]
                for k in range(count)
            ]

        return Effect(
            name,
            field.stage or "detector",
            tuple(EffectParameter(f"bump_{k}", "", LIKELY) for k in range(count)),
            f"A change of unknown form: {field.words}.",
            "images in which this change is stronger",
            field.axes,
            changes,
            field=True,
            exact=True,
        )

    def shown(self, field: Field, coefficients: Vector, covariance: Matrix) -> FieldShape:
        """The shape of a field with these coefficients: a map of the detector, or a curve."""
        infos, edge = self._infos, self._evidence.box_px
        relative = _relative(field)
        size, unit = (1.0, "") if relative else (self._light, "DN/s")
        if field.stage is None or field.form == "disc_shape":
            nowhere = np.zeros((0, coefficients.size))
            return _shape(field, (), np.zeros((0, 0)), nowhere, coefficients, covariance, "")
        if field.stage == "optics":
            # Of the factors beside each ring: for `kernel` the part that is round, for `kernel_in_time` its value at the end.
            factor = {"kernel": np.eye(1, len(_FACTORS)), "kernel_in_time": bumps([1.0], WIDTHS[-1]).T}
            sides = 2 if field.form == "kernel_over_field" else 1
            of_rings = KERNEL_LIKELY * np.kron(self._rings.T, factor.get(field.form, np.eye(1)))
            at = np.asarray(np.tile(2.0**self._octaves * edge, sides)[:, None], dtype=np.float64)
            to_shape = np.asarray(np.kron(np.eye(sides), of_rings), dtype=np.float64)
            return _shape(field, ("radius_px",), at, to_shape, coefficients, covariance, "1/octave")
        if field.stage == "time":
            assert field.width is not None
            now = bumps(self._times, field.width)
            to_shape = np.zeros((len(infos), coefficients.size))
            to_shape[:, ::3] = size * now.T  # the part that is the same at all places
            seconds = np.array([info.time_s for info in infos])
            return _shape(field, ("time_s",), seconds[:, None], to_shape, coefficients, covariance, unit)
        of_pointing = (i for i, info in enumerate(infos) if field.pointing in (None, info.pointing))
        n = min(of_pointing, key=lambda i: abs(self._readouts[i] - 1))
        planes = self.planes(field, n)
        x_px, y_px = ((one + 1) / 2 * one.size * edge - 0.5 for one in self._at[::-1])
        at = np.stack(np.meshgrid(x_px, y_px), axis=-1).reshape(-1, 2)
        to_shape = planes.reshape(len(planes), -1).T
        return _shape(field, ("x_px", "y_px"), at, to_shape, coefficients, covariance, unit)

    def _of_detector(self, field: Field, y: Vector, x: Vector, n: int) -> Planes:
        """`planes` for the stages detector and time and for light in one pointing, at the places of a grid."""
        size = 1.0 if _relative(field) else self._light
        if field.form.startswith("dark") or field.form == "gain_by_exposure":
            size *= self._readouts[n]
        if field.pointing is not None and self._infos[n].pointing != field.pointing:
            size = 0.0
        if field.width is None or field.stage == "time":
            ones = np.ones((y.size, x.size))
            planes = np.array([ones, ones * x, ones * y[:, None]])
            if field.width is None:
                return size * planes
            now = size * bumps(self._times[n : n + 1], field.width)[:, 0]
            return np.asarray((now[:, None, None, None] * planes).reshape(-1, *ones.shape))
        if (field, y.size) not in self._static:
            grid = np.einsum("ay,bx->abyx", bumps(y, field.width), bumps(x, field.width))
            self._static[field, y.size] = grid.reshape(-1, y.size, x.size)
        return size * self._static[field, y.size]

    def _of_kernel(self, field: Field, n: int) -> Planes:
        """The scene of image n, convolved with the changes of the PSF; 0 for an image without a disc, whose scene is not kept."""
        if n not in self._through_kernels:
            scene = KERNEL_LIKELY * self._scenes.get(n, np.zeros([one.size for one in self._at]))
            self._through_kernels[n] = np.array([kernel.apply(scene) for kernel in self._kernels])
        every = self._through_kernels[n].astype(np.float64)
        if field.form == "kernel":
            return every
        rings = every[:: len(_FACTORS)]
        if field.form == "kernel_over_field":
            y, x = self._at
            return np.concatenate([rings * x, rings * y[:, None]])
        now = bumps(self._times[n : n + 1], WIDTHS[-1])[:, 0]
        return np.asarray((rings[:, None] * now[:, None, None]).reshape(-1, *rings.shape[1:]))

    def _without_planes(self, field: Field) -> Directions:
        """The columns of a field that no light on the detector makes: a change of the shape of the discs, or no form."""
        cells = max(disc.residual.size for disc in self._discs)
        patterns = np.zeros((len(self._discs), 6, cells))
        for k, disc in enumerate(self._discs):
            own = np.vstack([np.ones(disc.residual.size), disc.patterns])
            patterns[k, :, : disc.residual.size] = own * disc.mean_expected
        whole, shapes = patterns[:, 0], patterns[:, 1:]
        each = np.eye(len(self._discs))
        levels = self._blocks.levels.shape
        usual = float(np.maximum(self._blocks.means, 1e-9).mean())
        readouts = self._readouts - self._readouts.mean()
        parts = {
            "disc_shape": (shapes.transpose(1, 0, 2), None),
            DISC: (each[:, :, None] * whole, None),
            CELL: (
                (each[:, None, :, None] * shapes.transpose(1, 0, 2)[None]).reshape(-1, *whole.shape),
                None,
            ),
            BLOCK: (None, readouts[:, None] * usual * np.eye(levels[1])[:, None]),
        }
        in_discs, in_blocks = [], []
        for part in field.parts or (field.form,):
            discs, blocks = parts[part]
            count = len(discs if discs is not None else blocks)
            in_discs.append(np.zeros((count, *whole.shape)) if discs is None else discs)
            in_blocks.append(np.zeros((count, *levels)) if blocks is None else blocks)
        return Directions(np.moveaxis(np.concatenate(in_discs), 0, -1), np.concatenate(in_blocks), LIKELY)

    @cached_property
    def _outside(self) -> Planes:
        """The light of each bump beside the field that scatters onto the detector, DN/s."""
        rows, columns = (one.size for one in self._at)
        scene = float(np.mean([one.mean() for one in self._scenes.values()]))
        wide = np.zeros((4 * SIDES, rows + 2 * OUTSIDE_BOXES, columns + 2 * OUTSIDE_BOXES))
        along_y, along_x = (bumps(_middles(n), 2 / (SIDES - 1) / SPACING)[:SIDES] for n in wide.shape[1:])
        for k in range(SIDES):
            wide[4 * k, :OUTSIDE_BOXES] = wide[4 * k + 1, -OUTSIDE_BOXES:] = along_x[k]
            wide[4 * k + 2, :, :OUTSIDE_BOXES] = wide[4 * k + 3, :, -OUTSIDE_BOXES:] = along_y[k][:, None]
        wide[:, OUTSIDE_BOXES:-OUTSIDE_BOXES, OUTSIDE_BOXES:-OUTSIDE_BOXES] = 0.0
        spread = linear_convolve(wide, self._evidence.kernel, (rows, columns))
        return OUTSIDE_LIKELY * scene * spread

    @cached_property
    def _octaves(self) -> Vector:
        """log2 of the radius of each bump of the optics, in boxes."""
        reach = max(one.size for one in self._at)
        return np.arange(np.log2(NEAREST_BOXES), np.log2(reach), OCTAVES)

    @cached_property
    def _rings(self) -> Matrix:
        """The light of each bump of the optics in an octave around each radius of `_octaves` (bumps, radii)."""
        apart = self._octaves[None] - self._octaves[:, None]
        return np.asarray(np.exp(-0.5 * (apart / OCTAVES) ** 2) / (OCTAVES * np.sqrt(2 * np.pi)))

    @cached_property
    def _kernels(self) -> list[Convolver]:
        """The convolutions with the changes of the PSF on the boxes, each of sum 1 before its factor of the azimuth."""
        reach = max(one.size for one in self._at)
        d = np.arange(-reach + 1, reach)
        r, a = np.hypot(d[:, None], d[None, :]), np.arctan2(d[:, None], d[None, :])
        octave = np.log2(np.maximum(r, 0.5))
        shape = self._at[0].size, self._at[1].size
        kernels = []
        for centre in self._octaves:
            ring = np.exp(-0.5 * ((octave - centre) / OCTAVES) ** 2)
            kernels += [Convolver(ring / ring.sum() * factor(a), shape) for factor in _FACTORS]
        return kernels


@dataclass(frozen=True, eq=False)
class FieldShape:
    """The shape of a field.

    axes: the names of the axes of `at` (points, axes): x and y on the detector, time, or radius in the PSF (for a kernel over
    the field the change in proportion to x, then that in proportion to y); no axes and no points for a field without form.
    values, sigma: (points,), in `unit`; for a gain relative, for the optics the share of the light in an octave of the radius.
    """

    field: Field
    axes: tuple[str, ...]
    at: Matrix
    values: Vector
    sigma: Vector
    unit: str

    @property
    def clearest(self) -> int:
        """The point whose value is largest in units of its error."""
        return int(np.argmax(np.abs(self.values) / np.maximum(self.sigma, 1e-300)))


def widest_fields(evidence: Evidence, columns: FieldColumns) -> tuple[Directions, list[range]]:
    """The columns of all fields of an unknown cause that are the widest of their form, together; the numbers of the columns of each."""
    fields = [f for f in fields_of(evidence) if f.effect == UNKNOWN and f.width in (None, WIDTHS[-1])]
    each = [columns.of(field) for field in fields]
    ends = np.cumsum([0, *(len(one.unocculted) for one in each)]).tolist()
    together = Directions(
        np.concatenate([one.discs for one in each], axis=2),
        np.concatenate([one.unocculted for one in each]),
        LIKELY,
    )
    return together, [range(*ends[k : k + 2]) for k in range(len(each))]


def with_field(evidence: Evidence, effect: Effect, directions: Directions) -> Evidence:
    """The evidence with a field as one more effect. It takes the place of an effect with the same name.

    effect, directions: of `FieldColumns.effect` and `FieldColumns.of`.
    """
    discs = tuple(
        replace(disc, jacobian=np.vstack([disc.jacobian, change[: disc.residual.size].T]))
        for disc, change in zip(evidence.discs, directions.discs, strict=True)
    )
    blocks = evidence.unocculted
    own = tuple(range(evidence.size, evidence.size + len(effect.parameters)))
    effects = {one.name: one for one in evidence.effects} | {
        effect.name: effect
    }  # in the order of the library
    return replace(
        evidence,
        effects=tuple(effects.values()),
        columns=evidence.columns | {effect.name: own},
        discs=discs,
        unocculted=replace(blocks, errors=np.concatenate([blocks.errors, directions.unocculted])),
    )


def with_likely(effect: Effect, likely: float) -> Effect:
    """The effect of a field with another likely size of its coefficients."""
    return replace(effect, parameters=tuple(replace(one, likely=likely) for one in effect.parameters))


def refittable(field: Field) -> bool:
    """Whether a change of the images stands for the field, so that a full refit can subtract it."""
    return field.stage is not None and field.form != "disc_shape"


def _relative(field: Field) -> bool:
    """Whether the field is a relative change of the image."""
    return field.form.startswith("gain")


def _in_blocks(field: Field) -> bool:
    """Whether the field differs between the images of one pointing, so that the unocculted field shows it."""
    return field.stage == "time" or field.form in ("dark", "gain_by_exposure")


def _shape(
    field: Field,
    axes: tuple[str, ...],
    at: Matrix,
    to_shape: Matrix,
    coefficients: Vector,
    covariance: Matrix,
    unit: str,
) -> FieldShape:
    sigma = np.sqrt(np.einsum("pc,cd,pd->p", to_shape, covariance, to_shape, optimize=True))
    return FieldShape(field, axes, at, to_shape @ coefficients, sigma, unit)


def _middles(count: int) -> Vector:
    """The middles of `count` equal parts of -1 ... 1."""
    return np.asarray((2 * np.arange(count) + 1) / count - 1)
