"""A synthetic EUV scene of the Sun, with realistic contrasts and spatial scales.

All lengths are in units of the field's longer edge ("field edges" below), so that a scene looks the same at any size.
The default scene shows quiet Sun, two active regions with bright moss and thin loops, a dark coronal hole, a filament
and a limb. The quiet Sun is lognormal and has structure on many scales. The brightness of the corona decreases with
height. A layout chooses the limb, the corona, the active regions and the filament, and their positions. A margin
extends the scene beyond the field. `drawn_scene` gives the scene of a pointing of a transit, and `scene_from_image`
takes it from an image. `observe` convolves a scene with a PSF and adds photon noise and read noise.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from astropy.io import fits
from scipy.ndimage import gaussian_filter, zoom

from psfcore.arrays import Kernel, Plane
from psfcore.convolution.convolver import Convolver
from psfcore.errors import DataError
from psfcore.fits.images import write_image
from psfcore.image import Image
from psfcore.instruments.psf_statements import title
from psfcore.noise import Noise
from psfcore.psf import Psf
from psfcore.simulate.plan import CAMERA, DISC, EAST, WEST, Plan

QUIET_DN_PER_S = 420.0
SKY_DN_PER_S = 12.0
_BRIGHT_POINTS = 60  # number of bright points in a field
DEMO_EXPOSURE_S = 1.4
_DEMO_DISTANCE_M = 5.19e10
_SOLAR_RADIUS_M = 6.957e8
_ARCSEC_PER_RADIAN = 206264.80624709636


@dataclass(frozen=True)
class _Region:
    """An active region: centre and size in field edges, brightness of its moss, number of its loop bundles."""

    x: float
    y: float
    size: float
    moss_dn_per_s: float
    bundles: int


@dataclass(frozen=True)
class _Bundle:
    """Parallel loops. All lengths are in field edges.

    Attributes
    ----------
    x, y
        Position of the middle between the footpoints.
    span
        Half the distance between the footpoints.
    rise
        Height of the loops.
    lean
        Tilt of the loops, radians.
    light
        Brightness relative to the moss of the region.
    """

    x: float
    y: float
    span: float
    rise: float
    lean: float
    light: float


_REGIONS = (_Region(0.78, 0.24, 0.13, 2300.0, 34), _Region(0.44, 0.31, 0.075, 1800.0, 16))


@dataclass(frozen=True)
class Layout:
    """The parts of a scene; lengths in field edges.

    Attributes
    ----------
    limb_centre, limb_radius
        (x, y) and radius of the solar disc.
    corona_dn_per_s
        Brightness of the corona at the limb.
    corona_height
        Scale height of the corona.
    sky_dn_per_s
        Background that is added everywhere.
    regions
        The active regions.
    filament
        Whether there is a filament.
    """

    limb_centre: tuple[float, float] = (1.52, 0.30)
    limb_radius: float = 1.33
    corona_dn_per_s: float = 900.0
    corona_height: float = 0.22
    sky_dn_per_s: float = SKY_DN_PER_S
    regions: tuple[_Region, ...] = _REGIONS
    filament: bool = True


LIMB_AND_REGIONS = Layout()
_LIMB = Layout(
    limb_centre=(2.10, 0.45),
    corona_dn_per_s=420.0,
    corona_height=0.075,
    sky_dn_per_s=4.0,
    regions=(),
    filament=False,
)
_DISC = Layout(limb_centre=(0.5, 0.5))
_LAYOUTS = {EAST: _LIMB, DISC: _DISC, WEST: _LIMB}


@dataclass(frozen=True)
class _Canvas:
    """The array of a scene: its shape with margins, the longer edge of the field, the margin on each side; all in
    px.
    """

    shape: tuple[int, int]
    edge: int
    margin: int

    @property
    def fields(self) -> float:
        """The area of the array divided by the area of the field."""
        inner = (self.shape[0] - 2 * self.margin) * (self.shape[1] - 2 * self.margin)
        return self.shape[0] * self.shape[1] / inner

    def coordinates(self) -> tuple[Plane, Plane]:
        """X and y of each pixel in field edges."""
        y, x = np.mgrid[: self.shape[0], : self.shape[1]]
        return (x - self.margin) / self.edge, (y - self.margin) / self.edge


def solar_scene(
    shape: tuple[int, int], seed: int, *, layout: Layout = LIMB_AND_REGIONS, margin_px: int = 0
) -> Plane:
    """True intensities [y, x] in DN/s, positive. Equal arguments give equal scenes.

    The result is margin_px larger than the field on each side; the Sun continues beyond the field.

    Parameters
    ----------
    shape
        Shape (ny, nx) of the field.
    """
    rng = np.random.default_rng(seed)
    canvas = _Canvas((shape[0] + 2 * margin_px, shape[1] + 2 * margin_px), max(shape), margin_px)
    x, y = canvas.coordinates()
    distance = np.hypot(x - layout.limb_centre[0], y - layout.limb_centre[1])
    height = layout.limb_radius - distance  # positive inside the solar disc
    on_disc = 1 / (1 + np.exp(np.minimum(-height / 0.0015, 700.0)))
    quiet = QUIET_DN_PER_S * _texture(canvas, rng) * _large_scale(x, y)
    brightening = 1 + 1.3 * np.exp(-np.abs(height) / 0.02)
    scene = on_disc * quiet * brightening + (1 - on_disc) * _corona(x, y, height, layout, rng)
    scene += _bright_points(canvas, rng) * on_disc
    for region in layout.regions:
        scene += _moss(x, y, region, canvas, rng) + _loops(canvas, region, rng)
    if layout.filament:
        scene = scene * (1 - 0.85 * _filament(x, y))
    return np.asarray(scene + layout.sky_dn_per_s)


def drawn_scene(plan: Plan, pointing: int, seed: int) -> Plane:
    """The synthetic scene of a pointing, with margins: [y, x] in DN/s.

    Along each axis, a detector pixel contains plan.oversampling scene pixels. A west limb is a mirrored east limb made
    with another seed. Equal plans and seeds give equal scenes.
    """
    view = plan.views[pointing - 1]
    edge = plan.size_px * plan.oversampling
    own = int(np.random.SeedSequence([seed, pointing]).generate_state(1)[0])
    margin = plan.margin_px * plan.oversampling
    scene = solar_scene((edge, edge), own, layout=_LAYOUTS[view], margin_px=margin)
    return np.ascontiguousarray(plan.brightness * (scene[:, ::-1] if view == WEST else scene))


def scene_from_image(image: Plane, plan: Plan) -> Plane:
    """A scene of the same shape as drawn_scene returns, made from the pixels of an image [y, x] in DN/s.

    If the image is larger than the scene, its middle is used. If the image is smaller, it is enlarged by bilinear
    interpolation until its shorter edge equals the edge of the scene; the values in DN/s keep their level. Pixels that
    are negative or not finite become 0. Raises DataError "bad-scene".
    """
    if image.ndim != 2 or min(image.shape) < 2:
        raise DataError(
            "bad-scene", f"expected a scene image with two axes of at least 2 px; got shape {image.shape}"
        )
    light = np.maximum(np.nan_to_num(image.astype(np.float64), nan=0.0, posinf=0.0, neginf=0.0), 0.0)
    if light.max() <= 0:
        raise DataError(
            "bad-scene",
            "expected a scene image with at least one positive pixel; all pixels of this image are 0, negative or not "
            "finite: give another image",
        )
    edge = (plan.size_px + 2 * plan.margin_px) * plan.oversampling
    if min(light.shape) < edge:
        factor = edge / min(light.shape)
        light = np.maximum(zoom(light, [max(edge, round(n * factor)) / n for n in light.shape], order=1), 0.0)
    top, left = (light.shape[0] - edge) // 2, (light.shape[1] - edge) // 2
    return np.ascontiguousarray(plan.brightness * light[top : top + edge, left : left + edge])


def _octaves(canvas: _Canvas, rng: np.random.Generator, *, slope: float, coarsest: float) -> Plane:
    """Gaussian noise with structure on many scales: mean 0, rms 1.

    The noise is a sum of smooth random planes. Each plane has half the scale of the previous one, down to one pixel.
    The amplitude of a plane is proportional to its scale to the power `slope`.

    Parameters
    ----------
    coarsest
        Largest scale, in field edges.
    """
    shape, edge = canvas.shape, canvas.edge
    total = np.zeros(shape)
    scale = coarsest * edge
    while scale >= 1:
        coarse = tuple(int(np.ceil(n / scale)) + 3 for n in shape)
        plane = zoom(rng.standard_normal(coarse), scale, order=3 if scale > 1 else 1)
        first = tuple(int(rng.integers(0, max(1, p - n))) for p, n in zip(plane.shape, shape, strict=True))
        cut = plane[first[0] : first[0] + shape[0], first[1] : first[1] + shape[1]]
        total += (scale / edge) ** slope * cut
        scale /= 2
    return np.asarray((total - total.mean()) / total.std())


def _texture(canvas: _Canvas, rng: np.random.Generator) -> Plane:
    """Network and cells of the quiet Sun: the brightness is lognormal, with a mean of about 1."""
    fine = _octaves(canvas, rng, slope=0.45, coarsest=0.10)
    ridges = 1 - np.minimum(np.abs(_octaves(canvas, rng, slope=0.9, coarsest=0.07)), 1)
    return np.exp(0.5 * fine - 0.13) * (0.75 + 0.5 * ridges**2)


def _large_scale(x: Plane, y: Plane) -> Plane:
    """A factor on the quiet Sun: a coronal hole (about a tenth) at the top right, and a bright belt at the active
    regions.
    """
    hole = np.exp(-((((x - 0.80) / 0.19) ** 2 + ((y - 0.80 + 0.3 * (x - 0.8)) / 0.17) ** 2) ** 2))
    belt = 1 + 0.9 * np.exp(-(((y - 0.27) / 0.20) ** 2))
    return (1 - 0.88 * hole) * belt


def _corona(x: Plane, y: Plane, height: Plane, layout: Layout, rng: np.random.Generator) -> Plane:
    """The corona beyond the limb: its brightness decreases with height and varies in radial streaks."""
    angle = np.arctan2(y - layout.limb_centre[1], layout.limb_centre[0] - x)
    bins = np.linspace(-0.9, 0.9, 4000)
    rays = gaussian_filter(rng.standard_normal(bins.size), 12) * 5
    rays += gaussian_filter(rng.standard_normal(bins.size), 60) * 14
    rays += gaussian_filter(rng.standard_normal(bins.size), 250) * 24
    streaks = np.exp(0.32 * np.interp(angle, bins, rays))
    steepness = 1.2 + 1.5 * np.maximum(y - 0.5, 0)
    falloff = np.exp(-steepness * np.maximum(-height, 0) / layout.corona_height)
    return np.asarray(layout.corona_dn_per_s * falloff * streaks)


def _moss(x: Plane, y: Plane, region: _Region, canvas: _Canvas, rng: np.random.Generator) -> Plane:
    """Small bright patches at the footpoints of loops, and the diffuse light of the region."""
    r = np.hypot(x - region.x, (y - region.y) * 1.5) / region.size
    patches = np.exp(1.1 * _octaves(canvas, rng, slope=0.5, coarsest=0.05) - 1.0)
    outline = np.exp(-((r + 0.35 * _octaves(canvas, rng, slope=1.1, coarsest=0.2)) ** 2))
    haze = 0.16 * np.exp(-(r**2) / 5)
    return np.asarray(region.moss_dn_per_s * (0.5 * patches * outline + haze))


def _loops(canvas: _Canvas, region: _Region, rng: np.random.Generator) -> Plane:
    """Bundles of thin arcs with common footpoints; most strands are about one pixel wide."""
    shape, edge = canvas.shape, canvas.edge
    layers = [np.zeros(shape) for _ in range(3)]
    for _ in range(region.bundles):
        bundle = _draw_bundle(region, rng)
        for _ in range(int(rng.integers(6, 16))):
            x, y, light = _strand(bundle, edge, rng)
            column = np.rint(x * edge).astype(int) + canvas.margin
            row = np.rint(y * edge).astype(int) + canvas.margin
            seen = (column >= 0) & (column < shape[1]) & (row >= 0) & (row < shape[0])
            np.add.at(layers[int(rng.choice(3, p=[0.4, 0.3, 0.3]))], (row[seen], column[seen]), light[seen])
    widths_px = [max(0.7, width * edge) for width in (0.0004, 0.0011, 0.0035)]
    strands = [gaussian_filter(layer, width) for layer, width in zip(layers, widths_px, strict=True)]
    return np.asarray(region.moss_dn_per_s * sum(strands))


def _draw_bundle(region: _Region, rng: np.random.Generator) -> _Bundle:
    """A random bundle. Long bundles are rarer, fainter, and nearer to the edge of the region."""
    reach = rng.random() ** 2
    span = region.size * (0.18 + 1.1 * reach)
    return _Bundle(
        x=region.x + region.size * rng.normal(0, 0.35) * (1 + reach),
        y=region.y + region.size * rng.normal(0, 0.35),
        span=span,
        rise=span * rng.uniform(0.5, 1.7),
        lean=rng.normal(-0.1, 0.4),
        light=rng.lognormal(0, 0.5) * (0.35 - 0.22 * reach),
    )


def _strand(bundle: _Bundle, edge: int, rng: np.random.Generator) -> tuple[Plane, Plane, Plane]:
    """X and y (field edges) and brightness of points along one strand, about three points per pixel."""
    span = bundle.span * rng.normal(1, 0.05)
    rise = bundle.rise * rng.normal(1, 0.13)
    t = np.linspace(0, np.pi, max(16, int(3 * (2 * span + 2 * rise) * edge)))
    along, up = span * np.cos(t), rise * np.sin(t)
    lean = bundle.lean + rng.normal(0, 0.03)
    x = bundle.x + along * np.cos(lean) - up * np.sin(lean + 0.3) + rng.normal(0, 0.03) * bundle.span
    y = bundle.y + along * np.sin(lean) + up * np.cos(lean + 0.3) + rng.normal(0, 0.03) * bundle.span
    # Brightest at the footpoints, and irregular along the strand.
    filling = np.exp(0.7 * np.interp(t, np.linspace(0, np.pi, 9), rng.standard_normal(9)))
    light = bundle.light * rng.lognormal(0, 0.7) * (0.12 + 0.88 * np.abs(np.cos(t)) ** 2) * filling
    return x, y, np.asarray(0.4 * light)


def _bright_points(canvas: _Canvas, rng: np.random.Generator) -> Plane:
    """Compact brightenings at random positions."""
    shape, edge = canvas.shape, canvas.edge
    plane = np.zeros(shape)
    count = round(_BRIGHT_POINTS * canvas.fields)
    rows, columns = rng.integers(0, shape[0], count), rng.integers(0, shape[1], count)
    np.add.at(plane, (rows, columns), rng.lognormal(8.6, 0.7, count))
    return gaussian_filter(plane, max(0.8, 0.0009 * edge)) + 0.5 * gaussian_filter(plane, 0.003 * edge)


def _filament(x: Plane, y: Plane) -> Plane:
    """The depth, 0 to 1, of a dark winding channel across the solar disc."""
    spine = 0.52 + 0.035 * np.sin(9 * x) + 0.018 * np.sin(23 * x + 1)
    ends = np.exp(-(((x - 0.62) / 0.15) ** 4))
    return np.asarray(ends * np.exp(-(((y - spine) / 0.013) ** 2)))


def seen_through(kernel: Kernel, scene: Plane, *, threads: int = 1) -> Plane:
    """A scene [y, x] convolved with a kernel, on the pixels of the scene, which is dark outside them."""
    field = (scene.shape[0], scene.shape[1])
    return np.asarray(Convolver(kernel, field, dtype=np.float64, threads=threads).apply(scene), np.float64)


def observe(
    scene: Plane,
    psf: Psf,
    *,
    exposure_s: float,
    photon_gain_dn: float,
    read_noise_dn: float,
    seed: int,
    threads: int = 1,
) -> Plane:
    """Convolve `scene` [y, x] with the PSF, then add photon noise and read noise; both arrays are in DN/s.

    The scene is assumed dark outside its array. If photon_gain_dn and read_noise_dn are 0, the image is noise-free.
    """
    seen = seen_through(psf.kernel, scene, threads=threads)
    if photon_gain_dn == read_noise_dn == 0:
        return np.maximum(seen, 0.0)  # rounding in the transforms makes some dark pixels slightly negative
    noise = Noise(photon_gain_dn, read_noise_dn)
    return noise.observe(seen, exposure_s, np.random.default_rng(seed))


def demo_image(path: str | Path, psf: Psf, *, size: int = 1024, seed: int = 1) -> None:
    """Write a simulated image of (size, size) px with the header of an HRI_EUV level 2 file, marked as simulated."""
    scene = solar_scene((size, size), seed)
    pixels = observe(
        scene,
        psf,
        exposure_s=DEMO_EXPOSURE_S,
        photon_gain_dn=CAMERA.photon_gain_dn,
        read_noise_dn=CAMERA.read_noise_dn,
        seed=seed,
    )
    mask = np.zeros(pixels.shape, dtype=np.uint8)
    image = Image(pixels, mask, _demo_header(size, psf), "DN/s", DEMO_EXPOSURE_S)
    history = [f"simulated scene, seed {seed}, convolved with {title(psf.name, psf.version, None)}"]
    write_image(path, image, cards={}, history=history)


def _demo_header(size: int, psf: Psf) -> fits.Header:
    """The keywords of EUI level 2; ORIGIN, CREATOR and COMMENT say that the image is simulated."""
    header = fits.Header()
    scale = psf.plate_scale_arcsec or 0.492
    radius_arcsec = float(np.arcsin(_SOLAR_RADIUS_M / _DEMO_DISTANCE_M) * _ARCSEC_PER_RADIAN)
    first_1, first_2 = 641 + (2048 - size) // 2, 577 + (2048 - size) // 2
    cards: list[tuple[str, str | float | int, str]] = [
        ("DATE-OBS", "2022-04-01T10:30:05.920", "[UTC] start of exposure, made up"),
        ("DATE-BEG", "2022-04-01T10:30:05.920", "[UTC] start of exposure, made up"),
        ("DATE-AVG", "2022-04-01T10:30:06.620", "[UTC] middle of exposure, made up"),
        ("TIMESYS", "UTC", "time scale"),
        ("LEVEL", "L2", "the level that this image imitates"),
        ("ORIGIN", "SIMULATED by heliopsf", "not an observation"),
        ("CREATOR", "psfcore.simulate", "not an observation"),
        ("IMGTYPE", "simulated image", "type of image"),
        ("OBSRVTRY", "Solar Orbiter", "satellite whose instrument is imitated"),
        ("TELESCOP", "SOLO/EUI/HRI_EUV", "telescope imitated"),
        ("INSTRUME", "EUI", "instrument imitated"),
        ("DETECTOR", "HRI_EUV", "detector imitated"),
        ("XPOSURE", DEMO_EXPOSURE_S, "[s] exposure time"),
        ("FILTER", "Aluminium_174_2", "filter imitated"),
        ("WAVELNTH", 174, "[Angstrom] characteristic wavelength"),
        ("WAVEUNIT", "Angstrom", "unit of WAVELNTH"),
        ("BTYPE", "Flux", "type of data"),
        ("BUNIT", "DN/s", "unit of the pixels"),
        ("GAINCOMB", "combined", "gain mode imitated"),
        ("PXBEG1", first_1, "first pixel read along axis 1"),
        ("PXEND1", first_1 + size - 1, "last pixel read along axis 1"),
        ("PXBEG2", first_2, "first pixel read along axis 2"),
        ("PXEND2", first_2 + size - 1, "last pixel read along axis 2"),
        ("NBIN1", 1, "binning along axis 1"),
        ("NBIN2", 1, "binning along axis 2"),
        ("WCSNAME", "Helioprojective-cartesian", "name of coordinate system"),
        ("CTYPE1", "HPLN-TAN", "helioprojective longitude"),
        ("CTYPE2", "HPLT-TAN", "helioprojective latitude"),
        ("CUNIT1", "arcsec", "unit along axis 1"),
        ("CUNIT2", "arcsec", "unit along axis 2"),
        ("PC1_1", 1.0, "rotation matrix"),
        ("PC1_2", 0.0, "rotation matrix"),
        ("PC2_1", 0.0, "rotation matrix"),
        ("PC2_2", 1.0, "rotation matrix"),
        ("CDELT1", scale, "[arcsec] pixel scale along axis 1"),
        ("CDELT2", scale, "[arcsec] pixel scale along axis 2"),
        ("CROTA", 0.0, "[deg] rotation"),
        ("CRVAL1", -radius_arcsec + 0.33 * size * scale, "[arcsec] value at CRPIX1"),
        ("CRVAL2", 0.2 * size * scale, "[arcsec] value at CRPIX2"),
        ("CRPIX1", size / 2 + 0.5, "[pixel] reference pixel"),
        ("CRPIX2", size / 2 + 0.5, "[pixel] reference pixel"),
        ("LONPOLE", 180.0, "[deg] native longitude of the pole"),
        ("RSUN_ARC", radius_arcsec, "[arcsec] apparent solar radius"),
        ("RSUN_OBS", radius_arcsec, "[arcsec] apparent solar radius"),
        ("RSUN_REF", _SOLAR_RADIUS_M, "[m] solar radius assumed"),
        ("DSUN_OBS", _DEMO_DISTANCE_M, "[m] distance from the Sun"),
        ("HGLN_OBS", 103.955, "[deg] Stonyhurst longitude of the observer"),
        ("HGLT_OBS", 2.311, "[deg] Stonyhurst latitude of the observer"),
    ]
    header.extend(cards)
    header.add_comment("SIMULATED: an invented scene, not an observation of the Sun")
    return header
