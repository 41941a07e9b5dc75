"""heliopsf for Python programs: point-spread functions (PSFs) of solar EUV telescopes, and deconvolution.

    >>> import heliopsf, sunpy.map
    >>> image = sunpy.map.Map("image.fits")
    >>> sharp = heliopsf.deconvolve(image)                           # a Map; the PSF is that of the telescope
    >>> psf = heliopsf.psf_for(image)                                # the PSF itself
    >>> with heliopsf.Client("http://127.0.0.1:8765") as client:     # on a service
    ...     client.deconvolve("image.fits", "deconvolved.fits")

The functions compute in this process. ``Client`` sends requests to a service. The service keeps products, versions and
lineage. ``import heliopsf`` is fast, because each name is imported when it is first used. A name that needs packages of
an extra (``pip install 'heliopsf[service]'``) raises ``MissingExtra``, which names the extra.
"""

from __future__ import annotations

from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from heliopsf.images import convolve as convolve
    from heliopsf.images import deconvolve as deconvolve
    from heliopsf.images import psf_for as psf_for
    from heliopsf.outputs import Convolution as Convolution
    from heliopsf.outputs import Deconvolution as Deconvolution
    from heliopsf.parameters import Options as Options
    from heliopsf.psfs import Psf as Psf
    from heliopsf.psfs import build_psf as build_psf
    from heliopsf.psfs import interpolate_psf as interpolate_psf
    from heliopsf.psfs import read_psf as read_psf
    from heliopsf.transits import GapDiagnosis as GapDiagnosis
    from heliopsf.transits import ScatterFit as ScatterFit
    from heliopsf.transits import diagnose_gap as diagnose_gap
    from heliopsf.transits import fit_scatter as fit_scatter
    from psfcore.errors import DataError as DataError
    from psfcore.errors import DataWarning as DataWarning
    from psfcore.errors import MissingExtra as MissingExtra
    from service.client.errors import ServiceError as ServiceError
    from service.client.http import Client as Client

    __version__: str

# The names of each module.
_MODULES = {
    "heliopsf.images": "convolve deconvolve psf_for",
    "heliopsf.outputs": "Convolution Deconvolution",
    "heliopsf.parameters": "Options",
    "heliopsf.psfs": "Psf build_psf interpolate_psf read_psf",
    "heliopsf.transits": "GapDiagnosis ScatterFit diagnose_gap fit_scatter",
    "psfcore.errors": "DataError DataWarning MissingExtra",
    "service.client.errors": "ServiceError",
    "service.client.http": "Client",
}
_PACKAGES = ("psfcore", "service", "workers")  # installed beside this one
_MODULE_OF = {name: module for module, names in _MODULES.items() for name in names.split()}
__all__ = sorted(_MODULE_OF)  # noqa: PLE0605  # a list


def _check_packages() -> None:
    """Raise ImportError if a file or folder of the user hides a package of heliopsf."""
    installed = Path(__file__).resolve().parents[1]
    for name in _PACKAGES:
        spec = find_spec(name)
        origin = None if spec is None else spec.origin
        if origin is None or Path(origin).resolve().parents[1] != installed:
            raise ImportError(
                f"expected heliopsf's own package {name!r} in {installed}; Python finds {origin or 'none'}: rename "
                "your file or folder of this name, or start Python in another folder"
            )


def __getattr__(name: str) -> object:
    if name == "__version__":
        from psfcore import software_version

        return software_version()
    if name not in _MODULE_OF:
        raise AttributeError(f"module 'heliopsf' has no attribute {name!r}")
    _check_packages()
    from psfcore.errors import module_of_extra

    value = getattr(module_of_extra(_MODULE_OF[name]), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return [*__all__, "__version__"]
