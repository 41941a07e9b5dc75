"""The report of a fit as JSON, and its summary in one sentence."""

from __future__ import annotations

from typing import Any

from psfcore.json_values import json_attributes
from psfcore.scatter.as_published import Published
from psfcore.scatter.fit import Curve, ShellWeightFits, TransitFit
from psfcore.scatter.shapes import stretch_of
from psfcore.scatter.validation.cross_validation import LIMITS, limits_json

SCHEMA = "psf-fit/1"


def fit_json(fit: TransitFit) -> dict[str, Any]:
    """The fit as JSON: parameters and curves with errors, every image, the alternative fits, and the limits."""
    inversion = fit.inversion
    values, sigma = inversion.values, fit.value_sigma
    out: dict[str, Any] = {
        "schema": SCHEMA,
        "sentence": fit_sentence(fit),
        "shape": inversion.shape.name,
        "parameters": inversion.shape.described(values, sigma),
        "coordinates": {
            "scales": [p.scale for p in inversion.shape.parameters],
            "values": inversion.coordinates.tolist(),
            "covariance": fit.covariance.tolist(),
        },
        "curve": _curve_json(fit.curve),
        "diffuse_curve": _curve_json(fit.diffuse_curve),
        "chi2_per_pixel": inversion.chi2_per_pixel,
        "overdispersion": fit.overdispersion,
        "converged": inversion.converged,
        "rounds": [
            {
                "parameters": r.values,
                **json_attributes(r, "frames", "curve_pct", "moved_points", "chi2_per_pixel"),
            }
            for r in inversion.rounds
        ],
        "frames": [
            {
                "file": f.file,
                "fov": f.pointing,
                "x": f.found.place.x_px,
                "y": f.found.place.y_px,
                "r": f.found.place.radius_px,
                "x_sigma": f.found.sigma_x_px,
                "y_sigma": f.found.sigma_y_px,
                "neighbours": f.found.neighbours,
                "dark_pixels": int(f.dark[0].size),
                "observed_dn_s": f.observed,
                "expected_dn_s": f.expected,
                "noise_dn_s": f.noise,
                "residual_pct": f.residual_pct,
            }
            for f in inversion.frames
        ],
        "left_out": inversion.left_out,
        "limits": list(fit.limits),
        "first_guess": fit.first_guess.to_json(),
        "inputs_sha256": fit.transit.sha256,
    }
    if "stretch_p" in values:
        stretch, angle = stretch_of(values)
        out["stretch"] = {"stretch": stretch, "angle_deg": angle}
    out["shapes"] = [
        {
            "name": s.name,
            "added": {name: {"value": v, "sigma": e} for name, (v, e) in s.added.items()},
            "delta_chi2": s.gain,
            "delta_chi2_held_out": s.held_out_gain,
        }
        for s in fit.shapes
    ]
    if fit.free is not None:
        out["free_shells"] = _free_json(fit.free)
    if fit.published is not None:
        out["as_published"] = _published_json(fit)
    return out


def fit_sentence(fit: TransitFit) -> str:
    """A summary of the fit in one sentence."""
    values, sigma, curve = fit.inversion.values, fit.value_sigma, fit.curve
    at = {r: (c, s) for r, c, s in zip(curve.radii_px, curve.pct, curve.sigma, strict=True)}
    beyond = ", ".join(f"{at[r][0]:.2f} ± {at[r][1]:.2f} % beyond {r:g} px" for r in (10.0, 100.0))
    return (
        f"{100 * values['total']:.2f} ± {100 * sigma['total']:.2f} % of the light is scattered diffusely; with "
        f"diffraction, {at[0.5][0]:.2f} ± {at[0.5][1]:.2f} % of the light lands outside its pixel, {beyond} "
        f"({len(fit.inversion.frames)} images, chi2 per pixel {fit.inversion.chi2_per_pixel:.3f})."
    )


def _curve_json(curve: Curve) -> dict[str, list[float]]:
    return {
        "radii_px": curve.radii_px.tolist(),
        "light_beyond_pct": curve.pct.tolist(),
        "sigma": curve.sigma.tolist(),
    }


def _free_json(free: ShellWeightFits) -> dict[str, Any]:
    return {
        "edges_px": list(free.segments.edges_px),
        "weight": limits_json(free.weights_pct(LIMITS)),
        "diffuse_light_beyond_inner_edge_pct": limits_json(free.beyond_pct(LIMITS)),
    }


def _published_json(fit: TransitFit) -> dict[str, Any]:
    published = fit.published
    assert published is not None
    here = dict(zip(fit.curve.radii_px, fit.curve.pct, strict=True))

    def one(p: Published) -> dict[str, Any]:
        return {
            **json_attributes(p, "a", "b_px", "c", "total", "radii_px"),
            "counted_on_grid_px": p.grid_px,
            "lines": p.equations,
            "light_beyond_pct": p.curve_pct.tolist(),
            "minus_default_points": [c - here[r] for r, c in zip(p.radii_px, p.curve_pct, strict=True)],
            "rounds": [{"fit": fit, "curve_pct": curve.tolist()} for fit, curve in p.rounds],
        }

    return {
        "whole": one(published) | {"spread_of_draws": published.spread},
        "one_bias_mended": {
            name: one(p) | {"minus_published_points": (p.curve_pct - published.curve_pct).tolist()}
            for name, p in fit.published_alone.items()
            if p.radii_px.size == published.radii_px.size
        },
    }
