"""Fields: their columns are the changes of the cells that they describe, and a cause outside the library is found as one."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.signal import fftconvolve

from psfcore.gap.evidence.cells import DiscCells, disc_cells
from psfcore.gap.evidence.evidence import Evidence
from psfcore.gap.evidence.fields import (
    KERNEL_LIKELY,
    LIKELY,
    NEAREST_BOXES,
    OCTAVES,
    Field,
    FieldColumns,
    bumps,
    fields_of,
    with_field,
)
from psfcore.gap.verdict.posterior import UNKNOWN, posterior
from psfcore.gap.verdict.unknown import bounds, unknown_fields
from psfcore.gap.view import View
from psfcore.scatter.reconstruction import Solution
from tests.psfcore.gap.linear_models import noise_of, with_left, with_residuals


def middles(count: int) -> np.ndarray:
    return (2 * np.arange(count) + 1) / count - 1


@pytest.mark.parametrize("form", ["light", "dark", "gain"])
def test_a_bump_changes_the_cells_as_its_pixels_do(solution: Solution, evidence: Evidence, form: str) -> None:
    found, light = FieldColumns(evidence).of(Field("detector", form, 0.4)), mean_light(evidence)
    ny, nx = solution.transit.shape
    planes = np.einsum("ay,bx->abyx", bumps(middles(ny), 0.4), bumps(middles(nx), 0.4)).reshape(-1, ny * nx)
    readouts = np.array([1 / info.exposure_s for info in evidence.image_info])
    for k in (0, 4):
        disc = evidence.discs[k]
        size = light * {"dark": readouts[disc.index] / readouts.mean()}.get(form, 1.0)
        change = View(solution).expected[disc.index].ravel() if form == "gain" else size
        cells, sensitivity = disc_cells(solution, disc.index)
        direct = sensitivity.reshape(cells.pixels.size, -1).astype(np.float64) @ (planes * change).T
        seen = found.discs[k, : cells.pixels.size]
        # In a box the bump counts as constant; the expected image varies there, at the limb by much.
        least = 0.06 if form == "gain" else 0.02
        np.testing.assert_allclose(seen, direct, atol=least * np.abs(direct).max())


def test_a_ring_changes_the_cells_as_a_convolution_does(solution: Solution, evidence: Evidence) -> None:
    found = FieldColumns(evidence).of(Field("optics", "kernel"))
    disc, edge, third = evidence.discs[0], evidence.box_px, 4
    ny, nx = solution.transit.shape
    scene = solution.optics.field(View(solution).occulted_scene(disc.index)).astype(np.float64)
    d = np.arange(-max(ny, nx) + 1, max(ny, nx))
    r = np.hypot(d[:, None], d[None, :]) / edge
    ring = np.exp(-0.5 * ((np.log2(np.maximum(r, 0.5)) - np.log2(NEAREST_BOXES)) / OCTAVES - third) ** 2)
    change = fftconvolve(scene, ring / ring.sum(), mode="same")
    cells, sensitivity = disc_cells(solution, disc.index)
    direct = KERNEL_LIKELY * np.einsum("cyx,yx->c", sensitivity.astype(np.float64), change)
    seen = found.discs[0, : cells.pixels.size, 5 * third]
    np.testing.assert_allclose(seen, direct, atol=0.05 * np.abs(direct).max())


def test_in_the_blocks_a_field_in_time_changes_what_it_changes_in_the_discs(evidence: Evidence) -> None:
    light, gain = (
        FieldColumns(evidence).of(Field("time", f"{form}_in_time", 0.8)) for form in ("light", "gain")
    )
    assert light.width == gain.width == LIKELY
    uniform = light.unocculted[0]
    assert np.allclose(uniform, uniform[:, :1]), "light is the same in every block"
    np.testing.assert_allclose(
        gain.unocculted[0] * mean_light(evidence), uniform * evidence.unocculted.means, rtol=1e-12
    )
    static = FieldColumns(evidence).of(Field("detector", "light", 0.8))
    assert not static.unocculted.any() and static.discs.any()


def mean_light(evidence: Evidence) -> float:
    return float(np.mean([disc.mean_expected for disc in evidence.discs]))


def test_a_spot_of_light_is_an_unknown_cause_at_its_place(evidence: Evidence) -> None:
    down, across = evidence.discs[0].boxes.shape[-2:]
    place = evidence.image_info[evidence.discs[4].index]
    x_px, y_px = ((np.arange(n) + 0.5) * evidence.box_px - 0.5 for n in (across, down))
    away = np.hypot(y_px[:, None] - place.y_px, x_px[None, :] - place.x_px)
    spot = 0.5 * mean_light(evidence) * np.exp(-0.5 * (away / (0.1 * across * evidence.box_px)) ** 2)
    rng = np.random.default_rng(3)

    def residual(disc: DiscCells) -> np.ndarray:
        return np.einsum("cyx,yx->c", disc.boxes[0], spot) + noise_of(disc, rng)

    model = replace(with_left(with_residuals(evidence, {}), residual), scale_error=0.1)
    columns = FieldColumns(model.evidence)
    found = posterior(model, columns)
    assert next(iter(found.probabilities())) == UNKNOWN
    best = unknown_fields(model, columns, found)[0]
    assert (best.field.stage, best.field.form, best.beside) == (
        "detector",
        "light",
        (),
    ) and best.probability > 0.5
    k = best.shape.clearest
    assert np.hypot(*(best.shape.at[k] - (place.x_px, place.y_px))) < 0.15 * across * evidence.box_px
    assert best.strength is not None
    value, sigma = best.strength
    assert value == pytest.approx(spot.max(), rel=0.5) and sigma < value / 3
    assert sum(found.fields().values()) == pytest.approx(1.0)
    # No effect of the library makes this spot, and the bound of the light is above it.
    distances = [distance for _, distance in best.resembles]
    assert distances == sorted(distances) and distances[0] > 3.0
    assert bounds(model, columns, [best.field])[best.field][0] > value
    nothing = replace(with_residuals(evidence, {}), scale_error=0.1)
    assert bounds(nothing, columns, [best.field])[best.field][0] < value / 2


def test_light_beside_the_field_lights_its_own_pointing_most_near_that_side(evidence: Evidence) -> None:
    columns = FieldColumns(evidence)
    first = evidence.image_info[0].pointing
    field = Field("scene", "outside", None, first)
    below = columns.planes(field, 0)[4]  # the middle bump below the field
    assert np.argmax(below.mean(axis=1)) == 0 and (below > 0).all()
    other = next(n for n, info in enumerate(evidence.image_info) if info.pointing != first)
    assert not columns.planes(field, other).any()


def test_a_field_takes_the_place_of_the_effect_with_its_name(evidence: Evidence) -> None:
    columns, gain = FieldColumns(evidence), Field("detector", "gain", 0.8)
    names = [effect.name for effect in evidence.effects]
    name = names[0]
    new = with_field(evidence, columns.effect(gain, name), columns.of(gain))
    assert [effect.name for effect in new.effects] == names and new.effects[0].exact
    assert list(new.columns[name]) == list(range(evidence.size, new.size))
    other = with_field(evidence, columns.effect(gain, UNKNOWN[0]), columns.of(gain))
    assert [effect.name for effect in other.effects] == [*names, *UNKNOWN]


def test_data_have_only_the_fields_that_they_can_show(
    evidence: Evidence,
) -> None:
    lost = evidence.discs[0].index
    columns = FieldColumns(replace(evidence, discs=evidence.discs[1:]))
    assert not columns.planes(Field("optics", "kernel"), lost).any()
    assert columns.planes(Field("optics", "kernel"), evidence.discs[1].index).any()
    one = tuple(replace(info, pointing=1, exposure_s=1.0) for info in evidence.image_info)
    forms = {field.form for field in fields_of(replace(evidence, image_info=one))}
    assert "dark" not in forms and "light_in_pointing" not in forms
    assert {"light", "gain", "kernel", "light_in_time"} <= forms
