"""Fields: smooth changes of unknown form at each stage of the light, as alternatives of an unknown cause.

A field is a sum of bumps with random coefficients. Its bumps are Gaussians on a grid of the detector, of time, or of the
logarithm of the radius in the PSF. A field stands for every cause that acts at its stage and is smooth on the scale of its
width. In contrast to the polynomials of `discrepancy`, a field goes through the operator of its stage, as the effects of the
library do: a cell with the sensitivity q changes by q . e (`cells`). The sums q . e are taken over boxes of the detector,
which are much smaller than a bump.

| form | stage | change of image n at the place x, with the bumps b |
|---|---|---|
| light | detector | L b(x) |
| dark | detector | L b(x) T / t_n |
| gain | detector | E_n(x) b(x) |
| light_in_pointing | detector | L b(x) in the images of one pointing |
| light_in_time, dark_in_time, gain_in_time | detector | as light, dark and gain, with b(time) times 1, x and y in place of b(x) |
| kernel | optics | the scene convolved with b(log r) times 1, cos a, sin a, cos 2a, sin 2a |
| kernel_over_field | optics | x or y times the scene convolved with b(log r) |

L is the mean light of the discs, DN/s. t_n is the exposure time and 1 / T the mean of 1 / t_n. E_n is the expected image.
r and a are the radius and the azimuth in the PSF. A coefficient has the width `discrepancy.LIKELY`; those of the optics
have KERNEL_LIKELY times this width.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from psfcore.convolution.convolver import correlations
from psfcore.gap.effect import Stage
from psfcore.gap.evidence.discrepancy import LIKELY
from psfcore.gap.evidence.evidence import Evidence
from psfcore.gap.evidence.likelihood import Directions

Vector = NDArray[np.float64]
Matrix = NDArray[np.float64]

WIDTHS = (0.2, 0.4, 0.8)  # of a bump, in units of half the detector or half the duration
SPACING = 1.2  # distance of two bumps, in units of their width
KERNEL_LIKELY = 0.25
OCTAVES = 0.5  # width of a bump of the optics, and distance of two of them, in octaves of the radius
NEAREST_BOXES = 2.0  # smallest radius of a bump of the optics, in boxes

WORDS = {
    "light": "light added on the detector",
    "dark": "an offset of each readout on the detector",
    "gain": "a gain error on the detector",
    "light_in_pointing": "light added on the detector in pointing",
    "light_in_time": "added light that changes with time",
    "dark_in_time": "an offset of each readout that changes with time",
    "gain_in_time": "a gain that changes with time",
    "kernel": "a change of the PSF",
    "kernel_over_field": "a change of the PSF over the field",
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
    """A field. form: of the table above. width: of its bumps; None for the optics. pointing: of light in one pointing."""

    stage: Stage
    form: str
    width: float | None = None
    pointing: int | None = None

    @property
    def words(self) -> str:
        """The field as text for reports."""
        told = WORDS[self.form]
        if self.pointing is not None:
            told += f" {self.pointing}"
        if self.width is None:
            return told
        of_what = "the duration" if self.form.endswith("_in_time") else "the detector"
        return f"{told}, smooth over {50 * self.width:.0f} % of {of_what}"


def fields_of(evidence: Evidence) -> list[Field]:
    """The fields that the discs and blocks of a transit can show."""
    infos = evidence.image_info
    exposures = len({info.exposure_s for info in infos}) > 1
    pointings = sorted({info.pointing for info in infos})
    forms = ["light", "gain", *(["dark"] if exposures else [])]
    static = [Field("detector", form, width) for form in forms for width in WIDTHS]
    shifting = [Field("detector", f"{form}_in_time", width) for form in forms for width in WIDTHS]
    single = [
        Field("detector", "light_in_pointing", width, pointing)
        for pointing in (pointings if len(pointings) > 1 else [])
        for width in WIDTHS
    ]
    return [*static, *shifting, *single, Field("optics", "kernel"), Field("optics", "kernel_over_field")]


def bumps(at: Sequence[float] | Vector, width: float) -> Matrix:
    """Gaussian bumps on a grid from -1 to 1: (bumps, places)."""
    count = int(np.ceil(2 / (SPACING * width))) + 1
    centres = np.linspace(-1, 1, count)
    return np.asarray(np.exp(-0.5 * ((np.asarray(at)[None] - centres[:, None]) / width) ** 2))


class FieldColumns:
    """The columns of fields: the changes of the cells and blocks by their bumps."""

    def __init__(self, evidence: Evidence) -> None:
        self._discs, self._blocks = evidence.discs, evidence.unocculted
        self._infos = evidence.image_info
        self._light = float(np.mean([disc.mean_expected for disc in evidence.discs]))
        readouts = np.array([1 / info.exposure_s for info in self._infos])
        self._readouts = readouts / readouts.mean()
        times = np.array([info.time_s for info in self._infos])
        self._times = 2 * (times - times.min()) / max(float(np.ptp(times)), 1e-9) - 1
        rows, columns = self._discs[0].boxes.shape[-2:]
        self._box_y, self._box_x = (_middles(count) for count in (rows, columns))
        self._box_px = evidence.box_px
        down = self._blocks.levels.shape[1] // self._blocks.across
        self._block_y, self._block_x = _middles(down), _middles(self._blocks.across)

    def of(self, field: Field) -> Directions:
        """The columns of a field."""
        cells = max(disc.residual.size for disc in self._discs)
        in_discs = []
        for disc in self._discs:
            change = self._in_disc(field, disc.boxes.astype(np.float64), disc.scene, disc.index)
            in_discs.append(np.pad(change, ((0, cells - change.shape[0]), (0, 0))))
        count = in_discs[0].shape[1]
        in_blocks = np.zeros((count, *self._blocks.levels.shape))
        if field.form in ("dark", "light_in_time", "dark_in_time", "gain_in_time"):
            for n in range(in_blocks.shape[1]):
                places = self._places(field, self._block_y, self._block_x, n)
                in_blocks[:, n] = places * self._strength(field, n)
                if field.form.startswith("gain"):
                    in_blocks[:, n] *= self._blocks.means[n] / self._light
        return Directions(np.array(in_discs), in_blocks, LIKELY)

    def shown(self, field: Field, coefficients: Vector, covariance: Matrix) -> FieldShape:
        """The shape of a field with these coefficients: a map of the detector, or a curve."""
        if field.stage == "optics":
            over_field = field.form == "kernel_over_field"
            sides = ("x", "y") if over_field else ("",)
            rings = self._rings if over_field else self._rings.repeat(len(_FACTORS), axis=0)
            if not over_field:
                rings[np.arange(len(rings)) % len(_FACTORS) > 0] = 0.0
            to_shape = np.asarray(np.kron(np.eye(len(sides)), rings.T) * KERNEL_LIKELY, dtype=np.float64)
            at = np.tile(2.0**self._octaves * self._box_px, len(sides))
            return _shape(field, ("radius_px",), at[:, None], to_shape, coefficients, covariance, "1/octave")
        unit = "" if field.form.startswith("gain") else "DN/s"
        size = 1.0 if not unit else self._light
        if field.form.endswith("_in_time"):
            now = bumps(self._times, self._width(field))
            to_shape = np.zeros((len(self._infos), coefficients.size))
            to_shape[:, ::3] = size * now.T  # the part that is the same at all places
            seconds = np.array([info.time_s for info in self._infos])
            return _shape(field, ("time_s",), seconds[:, None], to_shape, coefficients, covariance, unit)
        places = self._places(field, self._box_y, self._box_x, 0)
        x_px, y_px = ((one + 1) / 2 * one.size * self._box_px - 0.5 for one in (self._box_x, self._box_y))
        at = np.stack(np.meshgrid(x_px, y_px), axis=-1).reshape(-1, 2)
        return _shape(field, ("x_px", "y_px"), at, size * places.T, coefficients, covariance, unit)

    def _in_disc(self, field: Field, boxes: Matrix, scene: Matrix, n: int) -> Matrix:
        """The changes of the cells of one disc (cells, columns)."""
        of_light, of_gain = boxes
        if field.stage == "optics":
            return self._of_kernel(field, of_light, scene)
        shown = of_gain / self._light if field.form.startswith("gain") else of_light
        places = self._places(field, self._box_y, self._box_x, n)
        return np.asarray(shown.reshape(shown.shape[0], -1) @ places.T * self._strength(field, n))

    def _strength(self, field: Field, n: int) -> float:
        """The change of image n for one unit of a bump, DN/s."""
        if field.pointing is not None and self._infos[n].pointing != field.pointing:
            return 0.0
        return self._light * (self._readouts[n] if field.form.startswith("dark") else 1.0)

    def _places(self, field: Field, y: Vector, x: Vector, n: int) -> Matrix:
        """The bumps of a field of the detector at the places of a grid (columns, y * x)."""
        width = self._width(field)
        if field.form.endswith("_in_time"):
            ones = np.ones((y.size, x.size))
            planes = np.array([ones, ones * x, ones * y[:, None]]).reshape(3, -1)
            now = bumps(self._times[n : n + 1], width)[:, 0]
            return (now[:, None, None] * planes).reshape(-1, planes.shape[1])
        along_y, along_x = bumps(y, width), bumps(x, width)
        return np.einsum("ay,bx->abyx", along_y, along_x).reshape(-1, y.size * x.size)

    def _of_kernel(self, field: Field, of_light: Matrix, scene: Matrix) -> Matrix:
        if field.form == "kernel":
            return self._along_kernels(of_light, scene, self._kernels)
        rings = self._kernels[:: len(_FACTORS)]
        sides = [of_light * self._box_x, of_light * self._box_y[:, None]]
        return np.concatenate([self._along_kernels(side, scene, rings) for side in sides], axis=1)

    def _along_kernels(self, weights: Matrix, scene: Matrix, kernels: Matrix) -> Matrix:
        """The sums over the boxes of weights (cells, y, x) times the scene convolved with each kernel (cells, kernels)."""
        reach = kernels.shape[-1] // 2
        to_displacements = correlations(weights, np.pad(scene, reach), reach)
        return np.asarray(KERNEL_LIKELY * np.tensordot(to_displacements, kernels, axes=((1, 2), (1, 2))))

    @staticmethod
    def _width(field: Field) -> float:
        assert field.width is not None
        return field.width

    @cached_property
    def _octaves(self) -> Vector:
        """log2 of the radius of each bump of the optics, in boxes."""
        reach = max(self._box_y.size, self._box_x.size)
        return np.arange(np.log2(NEAREST_BOXES), np.log2(reach), OCTAVES)

    @cached_property
    def _rings(self) -> Matrix:
        """The light of each bump of the optics in an octave around each radius of `_octaves` (bumps, radii)."""
        apart = self._octaves[None] - self._octaves[:, None]
        return np.asarray(np.exp(-0.5 * (apart / OCTAVES) ** 2) / (OCTAVES * np.sqrt(2 * np.pi)))

    @cached_property
    def _kernels(self) -> Matrix:
        """The changes of the PSF on the boxes, each of sum 1 before its factor of the azimuth."""
        reach = max(self._box_y.size, self._box_x.size)
        d = np.arange(-reach + 1, reach)
        r, a = np.hypot(d[:, None], d[None, :]), np.arctan2(d[:, None], d[None, :])
        octave = np.log2(np.maximum(r, 0.5))
        kernels = []
        for centre in self._octaves:
            ring = np.exp(-0.5 * ((octave - centre) / OCTAVES) ** 2)
            kernels += [ring / ring.sum() * factor(a) for factor in _FACTORS]
        return np.array(kernels)


@dataclass(frozen=True, eq=False)
class FieldShape:
    """The shape of a field.

    axes: the names of the axes of `at` (points, axes): x and y on the detector, time, or radius in the PSF (for a kernel over
    the field the change in proportion to x, then that in proportion to y). values, sigma: (points,), in `unit`; for a gain
    relative, for the optics the share of the light in an octave of the radius.
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
