"""``psfcore.noise.Noise`` in JSON. This module imports no numerical library, so the web process can check requests."""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated

from pydantic import BaseModel, ConfigDict, Field

if TYPE_CHECKING:
    from psfcore.noise import Noise

# Strict: the text "12.5" and the value true are refused, because they are not numbers.
Figure = Annotated[float, Field(strict=True, ge=0, allow_inf_nan=False)]


class NoiseFigures(BaseModel):
    """Variance of a pixel in DN^2 = photon_gain_dn * signal in DN + read_noise_dn^2."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    photon_gain_dn: Figure = Field(description="DN per detected photon")
    read_noise_dn: Figure = Field(description="read noise, DN rms")

    def noise(self) -> Noise:
        """The noise model with these figures. Raises DataError "bad-noise" if both are zero."""
        from psfcore.noise import Noise

        return Noise(self.photon_gain_dn, self.read_noise_dn)
