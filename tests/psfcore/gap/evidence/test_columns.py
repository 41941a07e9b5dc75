"""Columns of fields, compared with changes of all pixels; fields as effects; their shapes; a spot at its place."""

from __future__ import annotations

from collections import Counter

import numpy as np
import pytest
from scipy.ndimage import convolve
from scipy.signal import fftconvolve

from psfcore.gap.evidence.cells import disc_cells
from psfcore.gap.evidence.columns import (
    AROUND,
    KERNEL_LIKELY,
    NEAREST_BOXES,
    OCTAVES,
    FieldColumns,
    with_effect,
)
from psfcore.gap.evidence.linear_model import FLOOR, LinearModel
from psfcore.gap.evidence.responses import Evidence
from psfcore.gap.evidence.tree import Field, fields_of
from psfcore.gap.evidence.unocculted_blocks import blocks
from psfcore.gap.verdict.answer import answer_of
from psfcore.gap.view import View
from psfcore.scatter.reconstruction import Solution
from tests.psfcore.gap.linear_models import noise_of, with_left, with_residuals

# Fields, and the relative errors of their columns in blocks, where bumps count as constant; None: not shown by blocks.
FIELDS = {
    Field("light_place", "light", "place", 0.4): None,
    Field("light_time", "light", "time", 0.4): 1e-6,
    Field("light_pointing", "light", "pointing", 0.8, 2): None,
    Field("offset_place_time", "offset", "place_time", 0.8): 0.03,
    Field("gain_place_time", "gain", "place_time", 0.4): 0.25,
    Field("gain_kind", "gain", "kind"): 0.05,
    Field("psf", "kernel", "constant"): None,
    Field("psf_time", "ring", "time"): 0.01,
    Field("psf_place_time", "tilted_kernel", "time"): 0.01,
    Field("psf_place", "scatter", "place", 0.8): None,
}


def middles(count: int) -> np.ndarray:
    return (2 * np.arange(count) + 1) / count - 1


def bumps(at: np.ndarray, width: float) -> np.ndarray:
    centres = np.linspace(-1, 1, int(np.ceil(2 / 1.2 / width)) + 1)
    return np.exp(-0.5 * ((at - centres[:, None]) / width) ** 2)


def weights(evidence: Evidence, field: Field, n: int) -> np.ndarray:
    """The modulation of a field in image n."""
    infos = evidence.image_info
    if field.modulation == "kind":
        kinds = [(one.exposure_s, one.gain_mode) for one in infos]
        return np.array([float(kinds[n] == one) for one in dict.fromkeys(kinds)])
    if field.modulation == "pointing":
        return np.array([float(infos[n].pointing == field.pointing)])
    if "time" not in field.modulation:
        return np.ones(1)
    times = np.array([one.time_s for one in infos])
    at = 2 * (times[n] - times.min()) / np.ptp(times) - 1
    width = field.width if field.modulation == "time" else 0.8
    return bumps(np.array([at]), width or 0.8)[:, 0]


def on_detector(forms: np.ndarray, shape: tuple[int, ...], width: float | None) -> np.ndarray:
    """The sum of bumps, or of 1, x and y, with these coefficients (.., y, x)."""
    y, x = (middles(count) for count in shape)
    if width is None:
        return np.asarray(forms[0] + forms[1] * x + forms[2] * y[:, None])
    of_y, of_x = bumps(y, width), bumps(x, width)
    return np.einsum("ab...,ay,bx->...yx", forms.reshape(len(of_y), len(of_x), -1), of_y, of_x)


def change(
    evidence: Evidence,
    field: Field,
    coefficients: np.ndarray,
    n: int,
    expected: np.ndarray,
    scene: np.ndarray,
) -> np.ndarray:
    """The change of all pixels of image n."""
    weight, shape = weights(evidence, field, n), expected.shape
    forms = coefficients.reshape(-1, weight.size) @ weight
    light = float(np.mean([disc.mean_expected for disc in evidence.discs]))
    readouts = np.array([1 / info.exposure_s for info in evidence.image_info])
    width = None if field.modulation in ("time", "kind") else field.width
    if field.operator in ("light", "offset", "gain"):
        size = {"light": light, "offset": light * readouts[n] / readouts.mean(), "gain": expected}[
            field.operator
        ]
        return np.asarray(size * on_detector(forms, shape, width).reshape(shape))
    d = np.arange(-max(shape) + 1, max(shape))
    r, a = np.hypot(d[:, None], d), np.arctan2(d[:, None], d)
    octave = np.log2(np.maximum(r / evidence.box_px, 0.5))
    centres = np.arange(np.log2(NEAREST_BOXES), np.log2(max(shape) / evidence.box_px), OCTAVES)
    rings = [np.exp(-0.5 * ((octave - one) / OCTAVES) ** 2) for one in centres]
    rings = [KERNEL_LIKELY * one / one.sum() for one in rings]
    if field.operator == "scatter":
        chosen = [rings[k] for k in np.linspace(1, len(rings) - 2, 3).round().astype(int)]
        lights = on_detector(forms.reshape(-1, 3), shape, width) * scene
        return sum(fftconvolve(one, ring, mode="same") for one, ring in zip(lights, chosen, strict=True))
    boxes = scene.reshape(shape[0] // 2, 2, shape[1] // 2, 2).mean(axis=(1, 3))
    around = convolve(boxes, np.array([[0, 1, 0], [1, -4, 1], [0, 1, 0]]) / 4, mode="nearest")
    wider = KERNEL_LIKELY * around.repeat(2, axis=0).repeat(2, axis=1)
    if field.operator == "kernel":
        turns = (np.ones_like(a), np.cos(a), np.sin(a), np.cos(2 * a), np.sin(2 * a))
        kernels = [ring * turn for ring in rings for turn in turns]
        kernel = np.tensordot(forms[:-1], kernels, axes=1)
        return np.asarray(fftconvolve(scene, kernel, mode="same") + forms[-1] * wider)
    if field.operator == "ring":
        kernel = np.tensordot(forms[:-1], rings, axes=1)
        return np.asarray(fftconvolve(scene, kernel, mode="same") + forms[-1] * wider)
    sums = [
        fftconvolve(scene, np.tensordot(one, rings, axes=1), mode="same")
        for one in forms.reshape(-1, len(rings))
    ]
    y, x = (middles(count) for count in shape)
    return np.asarray(sums[0] * x + sums[1] * y[:, None])


def without_inner_rings(field: Field, coefficients: np.ndarray, columns: FieldColumns) -> np.ndarray:
    """The coefficients; 0 for the innermost rings of the PSF, which boxes cannot resolve."""
    rings = columns.octaves.size
    inner = {"kernel": range(15), "ring": range(3), "tilted_kernel": [*range(3), *range(rings, rings + 3)]}
    forms = {"kernel": 5 * rings + 1, "ring": rings + 1, "tilted_kernel": 2 * rings}.get(field.operator, 1)
    out = coefficients.copy().reshape(forms, -1)
    out[list(inner.get(field.operator, ()))] = 0.0
    return out.ravel()


@pytest.mark.parametrize("field", list(FIELDS), ids=lambda field: f"{field.operator} {field.modulation}")
def test_columns_change_cells_and_blocks_as_their_pixels_do(
    solution: Solution, evidence: Evidence, columns: FieldColumns, field: Field
) -> None:
    in_blocks = FIELDS[field]
    drawn = np.random.default_rng(4).normal(size=columns.count(field))
    coefficients = without_inner_rings(field, drawn, columns)
    view, k = View(solution), 4
    n = evidence.discs[k].index
    scene = solution.optics.field(view.occulted_scenes[n]).astype(np.float64)
    cells, sensitivity = disc_cells(solution, n)
    moved = change(evidence, field, coefficients, n, view.expected[n], scene)
    direct = np.einsum("cyx,yx->c", sensitivity.astype(np.float64), moved)
    seen = columns.discs(field)[k, : cells.pixels.size] @ coefficients
    assert np.linalg.norm(seen - direct) < 0.05 * np.linalg.norm(direct)
    found = columns.all_blocks(field)[n] @ coefficients
    if in_blocks is None:
        assert not found.any(), "the images of a pointing all contain this change"
        return
    means, mean = view.pointing_means[n], view.pointing_scene(n).astype(np.float64)
    direct = blocks(change(evidence, field, coefficients, n, means, mean))
    assert np.linalg.norm(found - direct) < in_blocks * np.linalg.norm(direct)


def test_light_beside_the_field_and_at_the_edge_of_the_occulter(
    solution: Solution, evidence: Evidence, columns: FieldColumns
) -> None:
    first = evidence.image_info[0].pointing
    field = Field("outside", "outside", "pointing", None, first)
    # The middle bump below the field.
    (below,) = columns.effect(field, [4], [1.0]).changes(None)  # type: ignore[arg-type]
    images = [np.zeros((160, 160), np.float32)] * len(evidence.image_info)
    light = below.change(0, images)
    assert np.argmax(light.mean(axis=1)) == 0 and (light > 0).all()
    other = next(n for n, info in enumerate(evidence.image_info) if info.pointing != first)
    assert (
        not below.change(other, images).any() and not columns.discs(field)[evidence.images.index(other)].any()
    )
    # At the edge of a disc: patterns in units of its light, and of a tenth of the scene around it.
    disc, info = evidence.discs[4], evidence.image_info[evidence.discs[4].index]
    scene = solution.optics.field(View(solution).occulted_scenes[disc.index])
    y, x = np.indices(scene.shape)
    r = np.hypot(y - info.y_px, x - info.x_px) / np.sqrt(disc.pixels.sum() / np.pi)
    around = float(scene[(r > AROUND[0]) & (r < AROUND[1])].mean())
    patterns = np.vstack([np.ones(disc.residual.size), disc.patterns]).T
    edge = columns.discs(Field("edge", "edge", "constant"))[4, : disc.residual.size]
    np.testing.assert_allclose(edge[:, :6], disc.mean_expected * patterns)
    np.testing.assert_allclose(edge[:, 6:], 0.1 * around * patterns, rtol=0.03)


def test_a_field_as_an_effect_changes_what_its_columns_change(
    solution: Solution, evidence: Evidence, columns: FieldColumns
) -> None:
    view, k = View(solution), 4
    n = evidence.discs[k].index
    cells, sensitivity = disc_cells(solution, n)
    for field in (*list(FIELDS)[2:5], *list(FIELDS)[6:]):
        part = [0, columns.count(field) // 2]
        effect = columns.effect(field, part, [0.1, 0.2])
        assert [one.likely for one in effect.parameters] == [0.1, 0.2] and effect.family == field.family
        some = [one.change(n, view.expected) for one in effect.changes(view)]
        direct = np.einsum("cyx,kyx->ck", sensitivity, some)
        of_columns = columns.discs(field)[k, : cells.pixels.size][:, part]
        np.testing.assert_allclose(of_columns, direct, atol=1e-3 * np.abs(direct).max())
        assert all(one.unocculted is field.in_blocks for one in effect.changes(view))
        larger = with_effect(
            evidence, effect, columns.discs(field)[..., part], columns.all_blocks(field)[..., part]
        )
        own = larger.columns[effect.name]
        assert larger.effects[-1] is effect and own == (evidence.size, evidence.size + 1)
        np.testing.assert_allclose(larger.discs[k].jacobian[list(own)], of_columns.T)
        np.testing.assert_array_equal(
            larger.unocculted.errors[own[1]], columns.all_blocks(field)[..., part[1]]
        )


def test_the_shape_of_a_field_is_its_map_or_curve(evidence: Evidence, columns: FieldColumns) -> None:
    rng, light = np.random.default_rng(2), float(np.mean([disc.mean_expected for disc in evidence.discs]))
    field = Field("light_place", "light", "place", 0.4)
    values = rng.normal(size=columns.count(field))
    whole = list(range(values.size))
    shape = columns.shape(field, whole, values, 0.01 * np.eye(values.size))
    assert (shape.axes, shape.unit) == (("x_px", "y_px"), "DN/s")
    planted = light * on_detector(values, (160, 160), 0.4)[0]
    in_boxes = planted.reshape(80, 2, 80, 2).mean(axis=(1, 3)).ravel()
    np.testing.assert_allclose(shape.values, in_boxes, atol=0.01 * np.abs(planted).max())
    assert shape.at[81] == pytest.approx([2.5, 2.5])
    squares = on_detector(np.eye(values.size), (80, 80), 0.4) ** 2
    np.testing.assert_allclose(shape.sigma, 0.1 * light * np.sqrt(squares.sum(axis=0).ravel()), rtol=1e-9)
    assert shape.clearest == np.argmax(np.abs(shape.values) / shape.sigma)
    # A curve in time: what all places share.
    field = Field("gain_time", "gain", "time", 0.4)
    values = rng.normal(size=columns.count(field))
    shape = columns.shape(field, list(range(values.size)), values, np.eye(values.size))
    planted = [
        values.reshape(3, -1)[0] @ weights(evidence, field, n) for n in range(len(evidence.image_info))
    ]
    assert (shape.axes, shape.unit) == (("time_s",), "")
    assert shape.values == pytest.approx(planted)
    assert shape.at[:, 0].tolist() == [info.time_s for info in evidence.image_info]
    # A ring of the PSF holds its light, a share of the whole.
    field = Field("psf", "kernel", "constant")
    ring = 5 * 4
    shape = columns.shape(field, [ring], np.ones(1), np.eye(1))
    assert shape.axes == ("radius_px",) and shape.values.sum() * OCTAVES == pytest.approx(
        KERNEL_LIKELY, rel=0.01
    )
    assert np.log2(shape.at[shape.values.argmax(), 0] / evidence.box_px) == pytest.approx(columns.octaves[4])
    assert columns.shape(Field("edge", "edge", "constant"), [0], np.ones(1), np.eye(1)).axes == ()


def test_squares_are_neighbouring_bumps(columns: FieldColumns) -> None:
    spots = Field("light_place", "light", "place", 0.1)
    side = round(columns.count(spots) ** 0.5)
    squares = columns.squares(spots)
    assert len(squares) == (side - 1) ** 2
    assert squares[0].tolist() == [0, 1, side, side + 1]
    assert set(Counter(np.concatenate(squares).tolist()).values()) == {1, 2, 4}
    for field in fields_of((1, 2), exposures=True, kinds=True):
        on_grid = field.modulation in ("place", "pointing") and field.operator != "outside"
        assert bool(columns.squares(field)) is (on_grid and field.width != 0.8), field


def test_a_spot_of_light_is_another_form_of_added_light_at_its_place(evidence: Evidence) -> None:
    down, across = evidence.discs[0].boxes.shape[-2:]
    place = evidence.image_info[evidence.discs[4].index]
    x_px, y_px = ((np.arange(n) + 0.5) * evidence.box_px - 0.5 for n in (across, down))
    away = np.hypot(y_px[:, None] - place.y_px, x_px[None, :] - place.x_px)
    light = float(np.mean([disc.mean_expected for disc in evidence.discs]))
    spot = 0.5 * light * np.exp(-0.5 * (away / (0.1 * across * evidence.box_px)) ** 2)
    rng = np.random.default_rng(3)
    model = with_left(
        LinearModel(with_residuals(evidence, {}).evidence, FLOOR),
        lambda disc: np.einsum("cyx,yx->c", disc.boxes[0], spot) + noise_of(disc, rng),
    )
    answer = answer_of(model, 0.9)
    ((first,),) = (cause.alternatives for cause in answer.causes)
    assert (first.family.name, first.effect, answer.verdict) == ("light_place", None, "unknown")
    variant = answer.variant(("light_place", None))
    assert variant is not None and variant.form.field is not None
    values, covariance = answer.closed.fitted([variant])
    shape = answer.closed.columns.shape(variant.form.field, variant.part.tolist(), values, covariance)
    k = shape.clearest
    assert np.hypot(*(shape.at[k] - (place.x_px, place.y_px))) < 0.15 * across * evidence.box_px
    assert shape.values[k] == pytest.approx(spot.max(), rel=0.5) and shape.sigma[k] < shape.values[k] / 3
    assert answer.none < 1e-6
