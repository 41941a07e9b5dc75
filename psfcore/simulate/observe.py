"""A simulated observation: a known scene, convolved with a PSF, with photon noise and read noise added."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from astropy.io import fits
from numpy.typing import NDArray

from psfcore.convolution.convolver import Convolver
from psfcore.fits.images import write_image
from psfcore.image import Image
from psfcore.noise import Noise
from psfcore.psf import Psf
from psfcore.simulate.scene import solar_scene

DEMO_EXPOSURE_S = 1.4
DEMO_PHOTON_GAIN_DN = 6.0
DEMO_READ_NOISE_DN = 2.0
_DEMO_DISTANCE_M = 5.19e10
_SOLAR_RADIUS_M = 6.957e8
_ARCSEC_PER_RADIAN = 206264.80624709636


def observe(
    scene: NDArray[np.float64],
    psf: Psf,
    *,
    exposure_s: float,
    photon_gain_dn: float,
    read_noise_dn: float,
    seed: int,
    threads: int = 1,
) -> NDArray[np.float64]:
    """Convolve `scene` [y, x] with the PSF, then add photon noise and read noise; both arrays are in DN/s.

    The scene is assumed dark outside its array. If photon_gain_dn and read_noise_dn are 0, the image is noise-free.
    """
    field = (scene.shape[0], scene.shape[1])
    seen = Convolver(psf.kernel, field, dtype=np.float64, threads=threads).apply(scene)
    if photon_gain_dn == read_noise_dn == 0:
        return np.maximum(seen, 0.0)  # rounding in the transforms makes some dark pixels slightly negative
    noise = Noise(photon_gain_dn, read_noise_dn)
    return noise.observe(np.asarray(seen), exposure_s, np.random.default_rng(seed))


def demo_image(path: str | Path, psf: Psf, *, size: int = 1024, seed: int = 1) -> None:
    """Write a simulated image of (size, size) px with the header of an HRI_EUV level 2 file, marked as simulated."""
    scene = solar_scene((size, size), seed)
    pixels = observe(
        scene,
        psf,
        exposure_s=DEMO_EXPOSURE_S,
        photon_gain_dn=DEMO_PHOTON_GAIN_DN,
        read_noise_dn=DEMO_READ_NOISE_DN,
        seed=seed,
    )
    mask = np.zeros(pixels.shape, dtype=np.uint8)
    image = Image(pixels, mask, _demo_header(size, psf), "DN/s", DEMO_EXPOSURE_S)
    history = [f"simulated scene, seed {seed}, convolved with PSF {psf.name} {psf.version}"]
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
