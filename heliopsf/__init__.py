"""heliopsf for Python programs: point-spread functions (PSFs) of solar EUV telescopes, and deconvolution.

    >>> import heliopsf
    >>> psf = heliopsf.build_psf("hri_euv")                          # in this process
    >>> result = heliopsf.deconvolve("image.fits", psf)
    >>> with heliopsf.Client("http://127.0.0.1:8765") as client:     # on a service
    ...     client.deconvolve("image.fits", "deconvolved.fits")

The functions compute in this process. ``Client`` sends requests to a service. The service keeps products, versions and
lineage. ``import heliopsf`` is fast, because each name is imported when it is first used.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from heliopsf.images import deconvolve
    from heliopsf.psfs import build_psf, read_psf
    from heliopsf.transits import diagnose_gap, fit_scatter
    from psfcore.errors import DataError
    from service.client.errors import ServiceError
    from service.client.http import Client

__all__ = [
    "Client",
    "DataError",
    "ServiceError",
    "build_psf",
    "deconvolve",
    "diagnose_gap",
    "fit_scatter",
    "read_psf",
]

_MODULES = {
    "Client": "service.client.http",
    "DataError": "psfcore.errors",
    "ServiceError": "service.client.errors",
    "build_psf": "heliopsf.psfs",
    "deconvolve": "heliopsf.images",
    "diagnose_gap": "heliopsf.transits",
    "fit_scatter": "heliopsf.transits",
    "read_psf": "heliopsf.psfs",
}


def __getattr__(name: str) -> Any:
    if name not in _MODULES:
        raise AttributeError(f"module 'heliopsf' has no attribute {name!r}")
    found = getattr(import_module(_MODULES[name]), name)
    globals()[name] = found
    return found


def __dir__() -> list[str]:
    return __all__
