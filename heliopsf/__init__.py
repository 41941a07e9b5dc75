"""heliopsf for Python programs: point-spread functions (PSFs) of solar EUV telescopes, and deconvolution.

    >>> import heliopsf, sunpy.map
    >>> image = sunpy.map.Map("image.fits")
    >>> sharp = heliopsf.deconvolve(image)                           # a Map; the PSF is that of the telescope
    >>> psf = heliopsf.psf_for(image)                                # the PSF itself
    >>> with heliopsf.Client("http://127.0.0.1:8765") as client:     # on a service
    ...     client.deconvolve("image.fits", "deconvolved.fits")

The functions compute in this process. ``Client`` sends requests to a service. The service keeps products, versions and
lineage. ``import heliopsf`` is fast, because each name is imported when it is first used. A name that needs packages of an
extra (``pip install 'heliopsf[service]'``) raises ``MissingExtra``, which names the extra.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from heliopsf.images import deconvolve, psf_for
    from heliopsf.outputs import Deconvolution
    from heliopsf.psfs import Psf, build_psf, interpolate_psf, read_psf
    from heliopsf.transits import GapDiagnosis, ScatterFit, diagnose_gap, fit_scatter
    from psfcore.errors import DataError, DataWarning, MissingExtra
    from service.client.errors import ServiceError
    from service.client.http import Client

__all__ = [
    "Client",
    "DataError",
    "DataWarning",
    "Deconvolution",
    "GapDiagnosis",
    "MissingExtra",
    "Psf",
    "ScatterFit",
    "ServiceError",
    "build_psf",
    "deconvolve",
    "diagnose_gap",
    "fit_scatter",
    "interpolate_psf",
    "psf_for",
    "read_psf",
]

_MODULES = {
    "Client": "service.client.http",
    "DataError": "psfcore.errors",
    "DataWarning": "psfcore.errors",
    "Deconvolution": "heliopsf.outputs",
    "GapDiagnosis": "heliopsf.transits",
    "MissingExtra": "psfcore.errors",
    "Psf": "heliopsf.psfs",
    "ScatterFit": "heliopsf.transits",
    "ServiceError": "service.client.errors",
    "build_psf": "heliopsf.psfs",
    "deconvolve": "heliopsf.images",
    "diagnose_gap": "heliopsf.transits",
    "fit_scatter": "heliopsf.transits",
    "interpolate_psf": "heliopsf.psfs",
    "psf_for": "heliopsf.images",
    "read_psf": "heliopsf.psfs",
}


def __getattr__(name: str) -> Any:
    if name not in _MODULES:
        raise AttributeError(f"module 'heliopsf' has no attribute {name!r}")
    from psfcore.errors import module_of_extra

    found = getattr(module_of_extra(_MODULES[name]), name)
    globals()[name] = found
    return found


def __dir__() -> list[str]:
    return __all__
