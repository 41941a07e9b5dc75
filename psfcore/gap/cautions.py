"""The cautions of a diagnosis: sentences on everything in the data that weakens the verdict."""

from __future__ import annotations

from psfcore.gap.evidence.evidence import Evidence
from psfcore.gap.evidence.measured_noise import MeasuredNoise
from psfcore.gap.library.scene import MOST_POINTINGS
from psfcore.gap.verdict.verdict import LEAST_IMAGES
from psfcore.scatter.reconstruction import Solution


def cautions_of(solution: Solution, noise: MeasuredNoise | None, evidence: Evidence) -> tuple[str, ...]:
    """Sentences on everything in these data that weakens the verdict."""
    out = []
    if noise is None:
        out.append(
            "The stated noise could not be checked. Either too few consecutive images have the same pointing, gain mode and "
            "exposure, or their differences do not look like noise."
        )
    elif not noise.agrees:
        out.append(
            f"The variance of the noise in the images is {noise.ratio:.2f} times the stated variance. The measured noise was used: "
            f"{noise.noise.photon_gain_dn:.2f} DN per photon, read noise {noise.noise.read_noise_dn:.2f} DN."
        )
    left_out = [f"{name}: {why}" for name, why in solution.inversion.left_out.items()]
    if left_out:
        out.append(f"{len(left_out)} images were not used. Examples: {'; '.join(left_out[:3])}")
    infos = [evidence.image_info[disc.index] for disc in evidence.discs]
    unmatched = [info.file for info in infos if not info.described]
    if unmatched:
        out.append(
            f"In {len(unmatched)} images ({', '.join(unmatched[:3])}{', …' if len(unmatched) > 3 else ''}) the scene around the "
            "occulter differs from the scene in the neighbouring images, or no neighbouring image shows it. The fitted position of the "
            "occulter may be wrong in these images, and the wrong position may cause the residuals in their discs."
        )
    if len(infos) < LEAST_IMAGES:
        out.append(
            f"With only {len(infos)} images, no image can be held out. Closure and the gap on held-out images are therefore missing."
        )
    aimed = len({info.pointing for info in evidence.image_info})
    if aimed > MOST_POINTINGS:
        out.append(
            f"Light from outside the field was tested only in the first {MOST_POINTINGS} of the {aimed} pointings."
        )
    if aimed == 1:
        out.append(
            "All images have the same pointing: effects that differ between pointings cannot be detected, and no pointing can be held out."
        )
    if len({info.exposure_s for info in evidence.image_info}) == 1:
        out.append(
            "All images have the same exposure time: an error of every readout (in DN) and an error of the rate (in DN/s) look the same."
        )
    return tuple(out)


def caution_of_closure(label: str, gap_pct: float, error_pct: float) -> tuple[str, ...]:
    """A sentence if the closure by some effects says little, because their parameters are too uncertain without the held-out images.

    label: the effects. gap_pct: the gap in held-out images, %. error_pct: the error of their prediction, %, rms.
    """
    if error_pct <= gap_pct:
        return ()
    return (
        f"The closure by {label} says little: without the held-out images, its parameters are so uncertain that they predict the "
        f"discs of these images only to {error_pct:.1f} %, and the gap is {gap_pct:.1f} %. More images, or longer exposures, would help.",
    )
