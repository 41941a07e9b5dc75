"""What heliopsf says of a PSF: its title and version, what is assumed in it, the scattered light that it leaves in an
image, and which published PSFs there are. Commands, pages, JSON and the library all call these functions.

Hofmeister et al. (2024), Revised point-spread functions for AIA, arXiv:2410.08967, abstract: 10 % to 35 % of the light
of AIA is scattered diffusely, depending on the channel.

In these functions, `name` and `instrument` are those of the PSF, and `provenance` says how it was made. A PSF that was
read from a file may have no provenance; if it has the name of a shipped instrument file, it was built from this file.
This module imports no numerical library, so that the web process can import it.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping, Sequence
from typing import TypeVar

from psfcore.instruments.files import instrument_names, instrument_path, telescope_of
from psfcore.instruments.model import Instrument, load_instrument
from psfcore.instruments.published import PUBLISHED, published_for

Curve = TypeVar("Curve")
DRAFT = "draft"
# The light that a telescope scatters diffusely, for shipped instrument files without scatter. The files themselves do
# not contain it, because their text is part of the ids of PSFs.
_DIFFUSE_LIGHT = {"SDO/AIA": "10 to 35 % of all light, Hofmeister et al. 2024"}
_BASES = ("mount_basis", "mesh_basis", "scatter_basis")
_ENTRY = re.compile(rf"^({'|'.join((*_BASES, 'component'))}): (\w+)$", re.MULTILINE)
_STATUS = re.compile(r'^status = "draft" +# (.+)$', re.MULTILINE)


def version_text(version: str, status: str, identity: str | None = None) -> str:
    """The version of a PSF that is built from an instrument file with this version and status.

    Parameters
    ----------
    identity
        Identity of the recipe of the PSF; None: the PSF has no recipe.
    """
    draft = f"-{DRAFT}" if status == DRAFT else ""
    return f"{version}{draft}{'' if identity is None else f'+{identity[:8]}'}"


def title(name: str, version: str, status: str | None) -> str:
    """A PSF with its version and status, such as "PSF aia_171 1.0.0 (certified)".

    Parameters
    ----------
    status
        The status; None if the PSF does not exist yet, or if a status that changes must not be told.
    """
    return " ".join(filter(None, ("PSF", name, version, status and f"({status})")))


def bases_of(instrument: Instrument) -> dict[str, str]:
    """Where the parts of an instrument description come from, as the provenance of its PSF says it. No "mesh_basis":
    no number of its meshes is assumed. No "scatter_basis": it has no scatter.
    """
    bases = {"mount_basis": "none" if instrument.mount is None else instrument.mount.basis}
    if any(mesh.basis == "assumed" for mesh in instrument.meshes):
        bases["mesh_basis"] = "assumed"
    return bases | ({} if instrument.scatter is None else {"scatter_basis": instrument.scatter.basis})


def assumptions(name: str, instrument: str | None, provenance: Mapping[str, object]) -> list[str]:
    """What of a PSF is assumed or inferred. A draft of a shipped instrument file says so beside its status."""
    provenance = _stated(provenance)
    if _is_shipped(name, instrument, provenance):
        status = _STATUS.search(instrument_path(name).read_text("utf-8"))
        return [] if status is None else [status[1].replace(" below", "")]
    mount = ["mount of the filter assumed"] if provenance.get("mount_basis") == "assumed" else []
    mesh = ["mesh of the filter assumed"] if provenance.get("mesh_basis") == "assumed" else []
    scatter = ["scatter inferred"] if provenance.get("scatter_basis") == "inferred" else []
    return mount + mesh + scatter


def mesh_is_assumed(name: str, instrument: str | None, provenance: Mapping[str, object]) -> bool:
    """Whether a PSF was built from an instrument file that assumes a part of its meshes."""
    return _bases(name, instrument, _stated(provenance)).get("mesh_basis") == "assumed"


def scatter_left(
    name: str, instrument: str | None, provenance: Mapping[str, object], *, convolved: bool = False
) -> str | None:
    """What a deconvolution with a PSF without diffuse scatter leaves in the image, or what a convolution lacks; None:
    the PSF contains scatter, or it was not built from an instrument file.
    """
    provenance = _stated(provenance)
    bases = _bases(name, instrument, provenance)
    whole = provenance.get("component") in (None, "SCATTER")
    if "mount_basis" not in bases or ("scatter_basis" in bases and whole):
        return None
    share = _DIFFUSE_LIGHT.get(telescope_of(name)) if name in instrument_names() else None
    where = "is missing in the convolved image" if convolved else "stays in the image"
    return f"the diffusely scattered light {where} ({share or 'its share is not known'})"


def published_with_scatter(name: str, instrument: str | None, provenance: Mapping[str, object]) -> list[str]:
    """The names of the published PSFs that contain the scattered light that a deconvolution with this PSF leaves."""
    if name not in instrument_names() or scatter_left(name, instrument, provenance) is None:
        return []
    return [one.name for one in PUBLISHED.values() if one.instrument == name and "scatter" in one.contains]


def offer(published: Sequence[str]) -> str:
    """How to use one of the published PSFs of these names, which contain the scattered light that a PSF leaves."""
    return (
        f"the published PSF {' or '.join(published)} contains this light: `heliopsf psf get {published[0]}` brings it, "
        "--psf published uses it"
    )


def caveats(
    name: str, instrument: str | None, provenance: Mapping[str, object], *, convolved: bool = False
) -> list[str]:
    """What makes a result of a PSF uncertain: that it is only a component, what is assumed in it, and the scattered
    light that it leaves, or with `convolved` the scattered light that a convolved image lacks.
    """
    component = _stated(provenance).get("component")
    left = scatter_left(name, instrument, provenance, convolved=convolved)
    only = [] if component is None else [f"only the component {component}, not the whole PSF"]
    return [*only, *assumptions(name, instrument, provenance), *([] if left is None else [left])]


def remarks(name: str, instrument: str | None, provenance: Mapping[str, object], status: str) -> list[str]:
    """What a reader must know of a PSF: what a draft is, and the caveats."""
    draft = [f"{DRAFT} means that nobody has certified this PSF"] if status == DRAFT else []
    return draft + caveats(name, instrument, provenance)


def published_text(telescope: str, wavelength_angstrom: float | None) -> str | None:
    """The published PSFs of a telescope for images at this wavelength, and how to get one; None: there are none."""
    found = published_for(telescope, wavelength_angstrom)
    if not found:
        return None
    named = ", ".join(f"{one.name} ({one.channel})" for one in found)
    return f"Published PSFs of {telescope}: {named}; `heliopsf psf get NAME` brings one as a file"


def curves_once(
    curves: Mapping[str, Curve], same: Callable[[Curve, Curve], bool]
) -> dict[tuple[str, ...], Curve]:
    """The curves that a figure of a PSF shows, each with its names: curves that are the same hide each other, and
    become one.
    """
    once: dict[tuple[str, ...], Curve] = {}
    for name, curve in curves.items():
        names = next((names for names, other in once.items() if same(curve, other)), ())
        once.pop(names, None)
        once[(*names, name)] = curve
    return once


def _stated(provenance: Mapping[str, object]) -> Mapping[str, object]:
    """The provenance with what its history says. The provenance of a PSF that was read from a file has the lines of
    HISTORY in place of most entries.
    """
    history = provenance.get("history")
    lines = history if isinstance(history, list) else []
    return dict(_ENTRY.findall("\n".join(map(str, lines)))) | dict(provenance)


def _bases(name: str, instrument: str | None, provenance: Mapping[str, object]) -> Mapping[str, object]:
    return bases_of(load_instrument(name)) if _is_shipped(name, instrument, provenance) else provenance


def _is_shipped(name: str, instrument: str | None, provenance: Mapping[str, object]) -> bool:
    """Whether a PSF was built from the shipped file of its name, and not from a changed copy of this file."""
    if name != instrument or name not in instrument_names():
        return False
    own = {key: provenance[key] for key in _BASES if key in provenance}
    return not own or own == bases_of(load_instrument(name))
