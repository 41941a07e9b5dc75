"""How a method of deconvolution declares itself: its parameters, its assumption about edges, and the memory that it
needs.

Requests, options of commands, forms of pages and estimates are made from these objects. This module loads no numerical
library, because the web process uses it too.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from numbers import Real
from typing import Any, Literal

from psfcore.errors import DataError

KnownScene = Literal["zero", "symmetric"]  # beyond the edges
Edges = Literal[KnownScene, "extended", "periodic"]
WITHOUT_MARGIN: tuple[Edges, ...] = ("zero", "periodic")
Stop = Literal["fixed", "discrepancy"]
Value = int | float
MOST_STEPS = 1000  # far beyond the point from which steps fit the noise


@dataclass(frozen=True)
class Parameter:
    """A number that a method takes, from ``least`` to ``most``.

    Attributes
    ----------
    about
        The meaning of the number, for a description.
    """

    name: str
    default: Value
    least: Value
    most: Value
    about: str | None = None

    @property
    def type(self) -> type[Value]:
        """Int or float, that of the default."""
        return type(self.default)

    @property
    def values(self) -> tuple[Value, ...]:
        """All values, if these are two whole numbers: a choice rather than a range."""
        two = self.type is int and self.most == self.least + 1
        return (self.least, self.most) if two else ()

    def checked(self, value: Any) -> Any:
        """The value. Raises DataError "bad-NAME" if it is no number of this type, or outside the limits."""
        number = isinstance(value, Real) and (self.type is float or float(value).is_integer())
        if not number or not self.least <= value <= self.most:
            expected = (
                f"{'a whole number' if self.type is int else 'a number'} from {self.least} to {self.most}"
            )
            raise DataError(f"bad-{self.name}", f"{self.name}: expected {expected}; got {value!r:.40}")
        return value


def steps(default: int, about: str | None = None) -> Parameter:
    """The number of steps, a parameter of every method."""
    return Parameter("steps", default, 1, MOST_STEPS, about)


@dataclass(frozen=True)
class Method:
    """A method of deconvolution, except its iteration.

    `python -m benchmarks.growth memory` measures margin_of_psf, plane_bytes and transform_bytes for estimates. None:
    these numbers were not measured, and the largest figure of all methods counts.

    Attributes
    ----------
    use
        A text: its first sentence says for which images the method is good, the others what users must know about it.
    algorithm_version
        Version of the algorithm, which must be raised when the same parameters give another result.
    edges
        The default assumption about the scene beyond the edges.
    margin_share
        Largest share of its light that a pixel at the edge may get from beyond the margin;
        `psfcore.deconvolve.edges.margin_for` computes the default width of the margin from this share.
    may_be_negative
        Whether results can be negative.
    keeps_flux
        Whether the steps conserve the flux of the plane, and so compensate for light that leaves it
        (`psfcore.deconvolve.work`).
    margin_of_psf
        Default margin divided by half the width of the PSF.
    plane_bytes, transform_bytes
        The memory of a plane and of a transform, bytes: see Eq. (1) of `psfcore.deconvolve.memory`.
    """

    name: str
    use: str
    edges: Edges
    margin_share: float
    parameters: tuple[Parameter, ...]
    algorithm_version: int = 1
    may_be_negative: bool = False
    keeps_flux: bool = False
    margin_of_psf: float | None = None
    plane_bytes: float | None = None
    transform_bytes: float | None = None

    def complete(self, given: Mapping[str, Any]) -> dict[str, Any]:
        """The value of each parameter: the given one, or its default.

        Raises DataError "unknown-parameter", and "bad-NAME" for a value outside its limits.
        """
        known = {one.name: one for one in self.parameters}
        for name in given:
            if name not in known:
                names = ", ".join((*known, "stop"))
                raise DataError(
                    "unknown-parameter", f"expected parameters of {self.name}, {names}; got {name!r}"
                )
        return {name: one.checked(given.get(name, one.default)) for name, one in known.items()}


def check_stop(stop: str | None, *, noise_is_known: bool) -> None:
    """Raise DataError "no-noise-model" if a stopping rule needs the noise of the camera, which is not known."""
    if stop == "discrepancy" and not noise_is_known:
        raise DataError(
            "no-noise-model",
            "expected photon gain and read noise of the camera, because the stopping rule discrepancy needs them; got "
            "neither: give both (--noise, in a request noise), or use the stopping rule fixed",
        )
