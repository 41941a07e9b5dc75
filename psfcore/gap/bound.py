"""The bound of a simulated case: what a Bayes observer can know about each true cause from such data.

The observer knows the noise and the true form of each cause, and has the forms of the library and the free fields as
rivals. Its data are simulated in the design of the case: images without noise give the change by a cause, and its cells
and blocks (`evidence.cells`, `unocculted_blocks`) get noise and a random brightness DRAWS times. For each draw, the
observer weighs no cause and every form alone (`closed_form`), and answers as `verdict.answer` does, at the level LEVEL.

    python -m psfcore.gap.bound FOLDER FILE.json

FOLDER/without_effects and FOLDER/effect_0, ... are transits of noise-free images (DN, fractions allowed), with the
noise figures of real ones; FOLDER/causes.json names the cause and the right families of each. FILE.json (gap-bound/1)
states for each cause its noncentrality (the chi2 of its change that a refit of the PSF leaves), and the probability
that the observer detects a gap, and that its answer is the truth alone at the levels of the name, the family and the
stage. It is a separate program, so that the code that simulated the transit and the gap library share nothing.
"""

from __future__ import annotations

import json
import sys
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.special import logsumexp

from psfcore.build import known_diffraction
from psfcore.errors import DataError
from psfcore.files import write_whole
from psfcore.fits.blocks import LIMITS
from psfcore.gap.effect import Change, Effect, EffectParameter
from psfcore.gap.evidence.closed_form import ClosedForm
from psfcore.gap.evidence.columns import FieldColumns
from psfcore.gap.evidence.linear_model import LinearModel
from psfcore.gap.evidence.responses import gather
from psfcore.gap.evidence.tree import FAMILIES
from psfcore.gap.library.registry import LIBRARY
from psfcore.gap.verdict.answer import NONE, ONE, Labels, causes_of, label_of, prior_of, sums
from psfcore.scatter.inversion import invert
from psfcore.transit.folder import read_transit
from psfcore.transit.transit import Transit

SCHEMA = "gap-bound/1"
DRAWS, LEVEL = 100, 0.9


@dataclass(frozen=True)
class TrueCause:
    """A true cause.

    Attributes
    ----------
    name
        Name of the cause in the library; None if the cause is withheld.
    families
        The right families, the main one first.
    """

    transit: Transit
    name: str | None
    families: tuple[str, ...]


@dataclass(frozen=True)
class Bound:
    """What an observer can know of one cause: see the module."""

    noncentrality: float
    detected: float
    name: float
    family: float
    stage: float


def bounds(without: Transit, causes: Sequence[TrueCause], seed: int = 1) -> tuple[Bound, ...]:
    """The bound of every cause alone.

    Raises the errors of `invert`.

    Parameters
    ----------
    without
        The noise-free images without any cause.
    """
    solution = invert(without)
    true = [_true_effect(number, cause, without) for number, cause in enumerate(causes)]
    evidence = gather(solution, (*LIBRARY, *true))
    model = LinearModel(evidence, floor=0.0)
    columns = FieldColumns(evidence)
    own = [effect.name for effect in true]
    rng = np.random.default_rng(seed)
    return tuple(_bound(model, columns, own, number, cause, rng) for number, cause in enumerate(causes))


def _true_effect(number: int, cause: TrueCause, without: Transit) -> Effect:
    """The true change by a cause, as an effect whose parameter is 1."""

    def change(n: int, images: object) -> NDArray[np.float32]:
        return cause.transit.frames[n].pixels - without.frames[n].pixels

    return Effect(
        f"true_{number}",
        FAMILIES[cause.families[0]].stage,
        (EffectParameter("strength", "", 1.0),),
        "",
        "",
        (),
        lambda view: [Change(change)],
        family=cause.families[0],
    )


def _bound(
    model: LinearModel,
    columns: FieldColumns,
    own: Sequence[str],
    number: int,
    cause: TrueCause,
    rng: np.random.Generator,
) -> Bound:
    evidence, blocks = model.evidence, model.evidence.unocculted
    if own[number] not in evidence.columns:
        return Bound(0.0, 0.0, 0.0, 0.0, 0.0)
    (column,) = evidence.columns[own[number]]
    mean = np.concatenate([disc.jacobian[column] for disc in model.discs])
    discs = mean[:, None] + rng.standard_normal((mean.size, DRAWS))
    noise = np.sqrt(blocks.variance)[..., None] * rng.standard_normal((*blocks.levels.shape, DRAWS))
    bright = blocks.gain_width * rng.standard_normal((len(blocks.levels), 1, DRAWS))
    levels = blocks.errors[column][..., None] + noise + blocks.means[..., None] * bright
    closed = ClosedForm(model, columns, draws=(discs, levels))
    # The observer knows the true form: it has the name of the library and one scale, at which its strength
    # is likely. So the form of the library is no rival.
    known = [
        replace(form, effect=cause.name, scales=(1.0,)) if form.effect == own[number] else form
        for form in closed.forms
        if form.effect == own[number] or form.effect not in (*own, cause.name) or form.effect is None
    ]
    prior = prior_of(known)
    weights = np.array([np.log(ONE * prior[form]) + closed.of_form(form)[0] for form in known])
    whole = np.concatenate([np.full((1, DRAWS), np.log(NONE)), weights])
    labels: list[Labels] = [frozenset(), *(frozenset([label_of(form)]) for form in known)]
    right = {"name": 0, "family": 0, "stage": 0}
    detected, stages = 0, {FAMILIES[family].stage for family in cause.families}
    for draw in np.exp(whole - logsumexp(whole, axis=0)).T:
        told = causes_of(sums(zip(labels, draw.tolist(), strict=True)), LEVEL)
        if not told:
            continue
        detected += 1
        alternatives = told[0].alternatives
        families = all(one.family.name in cause.families for one in alternatives)
        right["name"] += families and [one.effect for one in alternatives] == [cause.name]
        right["family"] += families
        right["stage"] += all(one.stage in stages for one in alternatives)
    noncentrality = float(closed.normal(np.array([column]))[0, 0])
    return Bound(noncentrality, detected / DRAWS, *(count / DRAWS for count in right.values()))


def main(arguments: Sequence[str]) -> int:
    """Run the program. Returns the exit status."""
    if len(arguments) != 2:
        print(f"expected two arguments, a folder and a JSON file; got {len(arguments)}", file=sys.stderr)
        return 2
    folder, file = (Path(one) for one in arguments)
    try:
        listed = json.loads((folder / "causes.json").read_text("utf-8"))["causes"]
        causes = [
            TrueCause(_read(folder / one["folder"]), one["name"], tuple(one["families"])) for one in listed
        ]
        found = bounds(_read(folder / "without_effects"), causes)
    except DataError as error:
        print(f"{error.code}: {error.message}", file=sys.stderr)
        return 1
    content = {"schema": SCHEMA, "causes": [vars(one) for one in found]}
    write_whole(file, json.dumps(content, allow_nan=False))
    return 0


def _read(folder: Path) -> Transit:
    return read_transit(folder, LIMITS, diffraction=lambda name, _: known_diffraction(name, threads=1))


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
