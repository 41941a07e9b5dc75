"""One deconvolution, from an image and its PSF to the product: pixels, planes, cards, history, warnings and details.

The worker, the Python functions and the commands all run `deconvolve`, so that they give the same product for the same
image, PSF and options. `write` writes it as a FITS file.
"""

from __future__ import annotations

from collections.abc import Callable, Hashable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from astropy.io.fits import Header
from numpy.typing import NDArray

from psfcore import software_version
from psfcore.deconvolve.assess.changes import bright_and_dark_change_pct
from psfcore.deconvolve.assess.quality import MEANINGS
from psfcore.deconvolve.conditions import Deconvolved, PreparedPsfs, Progress
from psfcore.deconvolve.declaration import check_stop
from psfcore.deconvolve.doubts import input_warnings
from psfcore.deconvolve.kernels import compiling_beside
from psfcore.deconvolve.memory import EXPECTED_RIM_PX, Demand, check_memory, product_bytes
from psfcore.deconvolve.summary import region_error
from psfcore.deconvolve.work import Assessed, BoxWork, Options, Work, box_work
from psfcore.fits.cards import optional_text
from psfcore.fits.channel import PsfOrigin, binning_factor, check_channel
from psfcore.fits.frame import frame_of
from psfcore.fits.header import known_instrument
from psfcore.fits.images import described, write_image
from psfcore.fits.observation import check_exposure_of_sun
from psfcore.fits.units import unit_label
from psfcore.image import Image, MaskBit
from psfcore.instruments.psf_statements import caveats, published_with_scatter, title
from psfcore.psf import REACH_GRID_PX, Psf
from psfcore.psf_sampling import with_scale

if TYPE_CHECKING:
    from psfcore.deconvolve.assess.error_planes import ErrorPlanes
    from psfcore.deconvolve.camera_noise import CameraNoise

BUILDING = "building the PSF"
DECONVOLVING = "deconvolving"  # the stage whose steps are the steps of the method

Cards = dict[str, tuple[str | int | float, str]]


@dataclass(frozen=True)
class UsedPsf:
    """The PSF of a deconvolution, as cards name it."""

    id: str
    name: str
    version: str
    status: str


@dataclass(frozen=True)
class Identities:
    """What a product file says about its origin.

    Attributes
    ----------
    product
        Id of the product; None: it was made without a request.
    input_sha256
        Hash of the file of the image; None: not known.
    algorithm_version
        Version of the method.
    filename
        Name of the product.
    """

    product: str | None
    input_sha256: str | None
    algorithm_version: int
    filename: str


@dataclass(frozen=True, kw_only=True)
class Product(Deconvolved):
    """A deconvolved image or box, with its inputs, its errors and its warnings.

    Attributes
    ----------
    image
        The input, with its mask.
    psf
        The PSF on the pixels of the image.
    errors
        Planes with the standard deviation of each pixel, if they were asked for.
    noise
        Noise of the camera, if errors were asked for.
    warnings
        Sentences by their codes, the most harmful first.
    """

    image: Image
    psf: Psf
    errors: ErrorPlanes | None
    noise: CameraNoise | None = None
    warnings: Mapping[str, str]
    work: Work | BoxWork = field(repr=False)

    @cached_property
    def assessed(self) -> Assessed:
        """The measured changes, and the plane QUALITY."""
        return self.work.assess(self, self.errors)

    @property
    def amplification(self) -> float | None:
        """Noise of the result divided by the noise of the input, if errors were asked for."""
        return None if self.errors is None else self.errors.amplification

    @property
    def planes(self) -> dict[str, NDArray[np.generic]]:
        """The planes of the product file by their names."""
        planes: dict[str, NDArray[np.generic]] = {"QUALITY": self.assessed.quality}
        if self.errors is not None:
            planes["ERROR"] = self.errors.error
            if self.errors.psf_error is not None:
                planes["PSF_ERROR"] = self.errors.psf_error
        return planes

    @property
    def name(self) -> str:
        """The telescope and the time of the image."""
        header = self.image.header
        seen_by = optional_text(header, "DETECTOR", "INSTRUME") or "image"
        date = optional_text(header, "DATE-BEG", "DATE-OBS", "DATE_OBS")
        return f"{seen_by}{f' {date}' if date else ''}"

    def title(self, psf: UsedPsf) -> str:
        """Name the telescope, the time and the PSF, for the title of a picture.

        Parameters
        ----------
        psf : UsedPsf
            The PSF as the cards of the result name it.

        Returns
        -------
        str
            One line.
        """
        return f"{self.name}   {title(psf.name, psf.version, psf.status)}"

    def details(
        self, used: UsedPsf | None = None, provenance: Mapping[str, object] | None = None
    ) -> dict[str, object]:
        """Describe how the image was deconvolved, and what changed.

        Parameters
        ----------
        used : UsedPsf, optional
            The PSF as the cards of the result name it. Default: as its file names it.
        provenance : mapping of str to object, optional
            How the PSF was made. Default: as its file says.

        Returns
        -------
        dict
            The steps, the measured changes and the warnings, as JSON values. A bright pixel is at or above the 99th
            percentile of the input; a dark pixel is at or below the first percentile.
        """
        image, box, saturation = self.image, self.of_box, self.image.saturation
        bright_change_pct, dark_change_pct = bright_and_dark_change_pct(
            image, self.pixels, threads=self.work.options.threads
        )
        psf = used or self.psf
        origin = (psf.name, self.psf.instrument, provenance or self.psf.provenance)
        return {
            "image": self.name,
            "psf": {
                "name": psf.name,
                "version": psf.version,
                "status": psf.status,
                "assumed": caveats(*origin),
                "published": published_with_scatter(*origin),
            },
            "steps_done": self.steps_done,
            "stopped_because": self.stopped_because,
            "last_step_change": self.last_change,
            "edges": self.edges,
            "edge_band_px": self.edge_band_px,
            "noise_amplification": self.noise_amplification if self.errors is None else self.amplification,
            "chi2_per_pixel": self.chi2_per_pixel,
            "noise": self.noise and self.noise.as_json(),
            # The bound of the error is in the unit of the image, as is the saturation level.
            "region": box
            and {
                "box": str(box.box),
                "rim_px": box.rim_px,
                "error": box.error,
                "error_pct": box.error_pct,
            },
            "flux_change_pct": self.flux_change_pct,
            "bright_change_pct": bright_change_pct,
            "dark_change_pct": dark_change_pct,
            "negative_pixels": self.negative_pixels,
            "masked_pixels": {
                str(bit.name).lower(): int(np.count_nonzero(image.mask & bit.value)) for bit in MaskBit
            },
            "saturation": saturation
            and {"level": saturation.level, "unit": image.unit, "found": saturation.found},
            "warnings": [{"code": code, "message": message} for code, message in self.warnings.items()],
            "changes": self.assessed.changes.as_json(),
        }


def deconvolve(
    image: Image,
    psf: Psf,
    options: Options,
    *,
    warnings: Mapping[str, str],
    possible_psfs: Callable[[], Sequence[Psf]] = lambda: (),
    begin: Callable[[str, int], Progress | None] = lambda stage, steps: None,
    check_plane: Callable[[tuple[int, int]], None] = lambda shape: None,
) -> Product:
    """Deconvolve an image, or the box of it that the options name.

    Raises DataError "no-noise-figures", "no-noise-model", and the errors of `box_work` and of the method.

    Parameters
    ----------
    psf
        The PSF on the pixels of the image.
    warnings
        The warnings of `input_warnings`, and others about the inputs.
    possible_psfs, begin
        Functions for the error planes and the progress, see `Work.errors`.
    check_plane
        Function that is called with the shape (ny, nx) of box and rim, which is known only after the image is read; it
        may raise.
    """
    # Measured noise is too uncertain to end an iteration.
    check_stop(options.parameters.get("stop"), noise_is_known=options.noise is not None)
    noise = None
    if options.error_draws:
        from psfcore.deconvolve.camera_noise import camera_noise  # most deconvolutions do not load SciPy

        noise = camera_noise(image, options.noise, binning=int(psf.provenance.get("binning", 1)))
    whole = Work(image, psf, replace(options, noise=noise or options.noise))
    work: Work | BoxWork = whole
    progress = begin(DECONVOLVING, int(options.parameters.get("steps") or 1))
    if options.region is not None:
        work = box_work(whole, options.region)
        check_plane(work.rim.shape)
        image = work.image
    result = work.run(progress=progress)
    errors = None
    if options.error_draws:
        errors = whole.errors(result, possible_psfs=possible_psfs, begin=begin)
    return Product(
        **vars(result), image=image, psf=psf, errors=errors, noise=noise, warnings=warnings, work=work
    )


@dataclass(frozen=True)
class PsfSource:
    """The PSF of a deconvolution, which is read or built when it is needed.

    Attributes
    ----------
    load
        Function of a header and a function for the progress: it reads the PSF, or builds it for an image with this
        header.
    possible_psfs
        Function of the PSF and a header that returns variants of the PSF within its errors, on the pixels of the image.
    key
        A value that is the same for the same PSF; None: the PSF belongs to the telescope in the header.
    built
        What the instrument file states about a PSF that must be built, if it may be of another channel. Such a PSF is
        compared with the image before it is built.
    kernel_shape
        Shape (ny, nx) of the kernel.
    field_terms
        Number of the terms of a PSF that changes over the field.
    plate_scale_arcsec
        Plate scale of a PSF whose file gives none.
    prepared
        The PSFs and engines that are kept between images.
    other_channel
        Whether the PSF may be of another channel than the image, see `check_channel`.
    seen_as
        Function that adds the instrument and the wavelength for the checks, if the file of the PSF does not name them.
    used
        The PSF as cards name it; None: as the PSF states.
    provenance
        Provenance of a PSF whose file does not state it.
    warnings
        Sentences about the PSF, by their codes.
    """

    load: Callable[[Header, Progress | None], Psf]
    possible_psfs: Callable[[Psf, Header], Sequence[Psf]]
    key: Hashable = None
    built: PsfOrigin | None = None
    kernel_shape: tuple[int, ...] = (REACH_GRID_PX, REACH_GRID_PX)
    field_terms: int = 0
    plate_scale_arcsec: float | None = None
    prepared: PreparedPsfs = field(default_factory=PreparedPsfs)
    other_channel: bool = False
    seen_as: Callable[[Psf], Psf] = lambda psf: psf
    used: UsedPsf | None = None
    provenance: Mapping[str, object] | None = None
    warnings: Mapping[str, str] = field(default_factory=dict)

    def on_pixels_of(
        self, header: Header, shape: tuple[int, int], load: Callable[[], Psf]
    ) -> tuple[Psf, Psf, str | None]:
        """The PSF as it is read or built, the PSF on the pixels of an image with this header, and the answer of
        `check_channel`.

        Parameters
        ----------
        shape
            Shape (ny, nx) of the image.
        load
            Function that calls `load` of this source.
        """
        of_telescope = known_instrument(header), frame_of(header).turn_to_build_deg
        key = (of_telescope if self.key is None else self.key, self.plate_scale_arcsec)

        def as_built() -> Psf:
            return with_scale(load(), self.plate_scale_arcsec)

        # A build takes a minute, so what the instrument file says is compared first.
        origin = self.built or self.seen_as(self.prepared.as_built(key, as_built))
        channel = check_channel(origin, header, other_channel=self.other_channel)
        if self.built is not None:
            binning_factor(with_scale(self.built, self.plate_scale_arcsec), header)
        whole = self.prepared.as_built(key, as_built)
        return whole, self.prepared.on_pixels_of(header, key, as_built, shape), channel


def read_and_deconvolve(
    read: Callable[[], Image],
    source: PsfSource,
    options: Options,
    *,
    shape: tuple[int, int] | None = None,
    free_bytes: int = 0,
    again: bool = False,
    clip: Callable[[Image], Image] = lambda image: image,
    begin: Callable[[str, int], Progress | None],
    say: Callable[[str, str], object] = lambda code, message: None,
) -> tuple[Product, Psf]:
    """Check an image and its PSF, and deconvolve the image in this process. Returns also the PSF as it was read or
    built.

    Raises DataError "too-much-memory", "plate-scale-known", "plate-scale-mismatch", "channel-mismatch" and the errors
    of `check_exposure_of_sun`, of the source and of `deconvolve`.

    Parameters
    ----------
    read
        Function that reads the image.
    shape
        Shape (ny, nx) of the image, if its header states it; then the job must fit into `free_bytes` of free memory.
    again
        Whether to deconvolve the image even if it is a product or a PSF.
    clip
        Function that changes the pixels after the warnings were found; the product contains the unchanged image.
    begin
        Function that is called when a stage begins, see `deconvolve`.
    say
        Function of a code and a message that is called for each warning before the work begins.
    """
    box = options.region

    def check_plane(plane: tuple[int, int]) -> None:
        if shape is None:
            return
        ny, nx = source.kernel_shape
        demand = Demand(
            options.method,
            plane,
            (ny, nx),
            edges=options.edges,
            margin_px=options.margin_px,
            draws=options.error_draws,
            terms=source.field_terms,
        )
        check_memory(plane, product_bytes(demand, shape[0] * shape[1]), free_bytes)

    def load() -> Psf:
        if (source.key is not None and source.built is None) or shape is None:
            return source.load(header, None)
        with compiling_beside(options.method, shape):
            return source.load(header, begin(BUILDING, 1))

    if shape is not None:
        check_plane(shape if box is None else box.wider(EXPECTED_RIM_PX, shape).shape)
    image = read()
    header = image.header
    if not again:
        check_exposure_of_sun(header)
    ny, nx = image.pixels.shape
    whole, fitted, channel = source.on_pixels_of(header, (ny, nx), load)
    warnings = {
        **source.warnings,
        **input_warnings(source.seen_as(fitted), image, options.method, channel=channel, edges=options.edges),
    }
    for code, message in warnings.items():
        say(code, message)
    product = deconvolve(
        clip(image),
        fitted,
        replace(options, engine_for=source.prepared.engine_for),
        warnings=warnings,
        possible_psfs=lambda: source.possible_psfs(whole, header),
        begin=begin,
        check_plane=check_plane,
    )
    return (product if box is not None else replace(product, image=image)), whole


def write(product: Product, path: Path, psf: UsedPsf, ids: Identities) -> None:
    """Write a product as a FITS file whose cards name the PSF as `psf` does."""
    own = described(
        product.image.header,
        filename=ids.filename,
        creator=f"heliopsf {software_version()}",
        sha256=ids.input_sha256,
    )
    # The order of the cards must not change, because equal requests must give equal bytes.
    cards: Cards = {} if ids.product is None else {"PRODID": (ids.product, "")}
    for key, card in deconvolution_cards(product, psf).items():
        if key == "SWHELIO":
            cards["DCNVALGV"] = (ids.algorithm_version, "algorithm version")
        cards[key] = card
        if key == "SWHELIO" and ids.input_sha256 is not None:
            cards["INPSHA"] = (ids.input_sha256, "")
    write_image(
        path,
        replace(product.image, header=own.header),
        pixels=product.pixels,
        cards=own.cards | cards,
        history=deconvolution_history(product, psf) + own.history,
        planes=product.planes,
        plane_bits={"QUALITY": MEANINGS},
    )


def draw_preview(product: Product, psf: UsedPsf, path: Path) -> None:
    """Draw the image before and after, and the change, into a PNG file."""
    from psfcore.drawing import plots  # matplotlib is loaded only if a picture is drawn

    before = product.image.pixels
    plots.preview_png(before, product.pixels, path, title=product.title(psf), unit=unit_label(product.image))


def draw_changes(product: Product, psf: UsedPsf, path: Path) -> None:
    """Draw difference, ratio and histograms into a PNG file."""
    from psfcore.deconvolve.assess.pictures import changes_png

    before, changes = product.image.pixels, product.assessed.changes
    changes_png(
        before, product.pixels, changes, path, title=product.title(psf), unit=unit_label(product.image)
    )


def deconvolution_cards(product: Product, psf: UsedPsf) -> Cards:
    """The cards that say how an image was deconvolved. Cards name the warnings by their codes; HISTORY has the
    sentences.
    """
    # A hash fills the whole card, so cards with a hash have no comment.
    cards: Cards = {
        "PSFID": (psf.id, ""),
        "PSFVERS": (psf.version, "PSF version"),
        "PSFNAME": (psf.name, "PSF name"),
        "PSFSTAT": (psf.status, "PSF status"),
        **(
            {"PSFDOI": (doi, "DOI of the PSF's publication")}
            if (doi := product.psf.provenance.get("doi"))
            else {}
        ),
        "DCNVMETH": (product.method, "deconvolution method"),
        "DCNVITER": (product.steps_done, "deconvolution steps done"),
        "DCNVSTOP": (
            product.stopped_because,
            "" if "chi2" in product.stopped_because else "why the iteration stopped",
        ),
        "DCNVEDGE": (product.edges, "assumed scene beyond the edges"),
        "DCNVBAND": (product.edge_band_px, "[px] width of band affected by DCNVEDGE"),
        "SWHELIO": (software_version(), "heliopsf version"),
    }
    if product.of_box is not None:
        cards["DCNVBOX"] = (str(product.of_box.box), "[px] box of the input, x0:x1,y0:y1 from 0")
        cards["DCNVRIM"] = (product.of_box.rim_px, "[px] width of the rim that was also used")
        cards["DCNVBERR"] = (product.of_box.error, "bound of the difference from whole image")
    saturation = product.image.saturation
    if saturation is not None and saturation.found is not None and saturation.level is not None:
        cards["DCNVSATL"] = (saturation.level, "saturation level, in the unit of the image")
        cards["DCNVSATF"] = (saturation.found, "where the saturation level was found")
    if product.amplification is not None:
        cards["DCNVAMPL"] = (product.amplification, "noise of result / noise of input")
    if product.noise is not None and product.noise.source != "given":
        cards["DCNVGAIN"] = (product.noise.photon_gain_dn, "[DN] photon gain")
        cards["DCNVREAD"] = (product.noise.read_noise_dn, "[DN] read noise, rms")
        cards["DCNVNOIS"] = (product.noise.source, "where DCNVGAIN and DCNVREAD are from")
    for number, code in enumerate(product.warnings, start=1):
        cards[f"DCNVWRN{number}"] = (code, "warning, see HISTORY")
    return cards


def deconvolution_history(product: Product, psf: UsedPsf) -> list[str]:
    """The lines of HISTORY that say how an image was deconvolved."""
    box, citation = product.of_box, product.psf.provenance.get("citation")
    return [
        f"heliopsf {software_version()}: {product.method}, {product.steps_done} steps, "
        f"edges {product.edges}, {title(psf.name, psf.version, psf.status)}",
        *([] if citation is None else [f"publication of the PSF: {citation}"]),
        *(
            []
            if box is None
            else [
                f"box {box.box} of the input alone, with a rim of {box.rim_px} px: {region_error(box.error_pct)}"
            ]
        ),
        *([] if product.noise is None or product.noise.source == "given" else [f"noise: {product.noise}"]),
        *(f"WARNING ({code}): {message}" for code, message in product.warnings.items()),
    ]
