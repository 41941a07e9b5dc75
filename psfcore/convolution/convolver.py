"""Linear convolution through SciPy's Fourier transforms. No other file of psfcore calls the transforms of a library.

The scene is zero outside the field, and the result is cut to the field:

    (H x)[j] = sum over o of h[o] x[j - o],      Eq. (1)    where j and j - o lie in the field
    (H^T y)[i] = sum over o of h[o] y[i + o]     Eq. (2)

A Fourier transform is periodic: light that leaves the plane on one side enters it again on the other side ("wraps").
The paper (Hofmeister et al. 2024) pads image and PSF by half the image's width on all sides, so that no light wraps.
However, wrapped light does no harm if it falls only into pixels that are cut off afterwards. Therefore the size of the
field plus the largest offset is enough as the length of the transform. The result is the same (the tests compare both),
and the transform is shorter: 3072 px for a field and a PSF of 2048 px.

| symbol | name |
|---|---|
| h, o | psf_kernel, offset from its centre [n // 2, n // 2] |
| N | field_shape |
| L | transform length per axis, at least N + max abs(o) with abs(o) < N |
"""

from __future__ import annotations

import numpy as np
import scipy.fft
from numpy.typing import DTypeLike, NDArray

from psfcore.convolution.offsets import needed_kernel
from psfcore.errors import DataError

Field = NDArray[np.floating]


class Convolver:
    """Convolution with one PSF, cut to one field, and the adjoint of this operator.

    Raises DataError "field-shape" if an array has another shape.

    Parameters
    ----------
    psf_kernel
        Weights [y, x], centre at [ny // 2, nx // 2].
    field_shape
        Shape (ny, nx) of the arrays to convolve.
    dtype
        Type of the numbers in transforms and results: float32 or float64.
    threads
        Number of threads for the transforms.
    """

    def __init__(
        self,
        psf_kernel: NDArray[np.floating],
        field_shape: tuple[int, int],
        *,
        dtype: DTypeLike = np.float32,
        threads: int = 1,
    ) -> None:
        self.field_shape = field_shape
        self.dtype = np.dtype(dtype)
        self.threads = threads
        kernel, first = needed_kernel(psf_kernel, field_shape)
        self.length = tuple(
            _length(size, low, low + count - 1)
            for size, low, count in zip(field_shape, first, kernel.shape, strict=True)
        )
        corner = np.zeros(self.length, dtype=self.dtype)
        corner[: kernel.shape[0], : kernel.shape[1]] = kernel
        corner = np.roll(corner, first, axis=(0, 1))
        self._transfer = scipy.fft.rfft2(corner, workers=threads)

    def apply(self, x: Field) -> Field:
        """The field [y, x] convolved with the PSF, H x of Eq. (1)."""
        spectrum = self._forward(x)
        spectrum *= self._transfer
        return self._inverse(spectrum)

    def adjoint(self, y: Field) -> Field:
        """The field [y, x] correlated with the PSF, H^T y of Eq. (2)."""
        spectrum = self._forward(y)
        # Compute spectrum * conj(transfer) without a temporary array for the conjugate.
        np.conjugate(spectrum, out=spectrum)
        spectrum *= self._transfer
        np.conjugate(spectrum, out=spectrum)
        return self._inverse(spectrum)

    def _forward(self, x: Field) -> NDArray[np.complexfloating]:
        """Transform along x, then along y. Along x only the rows of the field are needed: the padding rows are zero."""
        if x.shape != self.field_shape:
            raise DataError("field-shape", f"expected a field of {self.field_shape}; got {x.shape}")
        rows = scipy.fft.rfft(np.asarray(x, dtype=self.dtype), n=self.length[1], axis=1, workers=self.threads)
        return np.asarray(
            scipy.fft.fft(rows, n=self.length[0], axis=0, workers=self.threads, overwrite_x=True)
        )

    def _inverse(self, spectrum: NDArray[np.complexfloating]) -> Field:
        ny, nx = self.field_shape
        columns = scipy.fft.ifft(spectrum, axis=0, workers=self.threads, overwrite_x=True)[:ny]
        rows = scipy.fft.irfft(columns, n=self.length[1], axis=1, workers=self.threads, overwrite_x=True)
        return np.ascontiguousarray(rows[:, :nx])


def _length(field_size: int, lowest: int, highest: int) -> int:
    """Shortest length of a fast transform for which no wrapped light reaches the field."""
    return int(scipy.fft.next_fast_len(field_size + max(-lowest, highest, 0), real=True))


def linear_convolve(
    a: NDArray[np.float64],
    b_kernel: NDArray[np.float64],
    out_shape: tuple[int, int],
    *,
    threads: int = 1,
) -> NDArray[np.float64]:
    """Convolve two kernels linearly, in float64. The centre of each kernel is at [ny // 2, nx // 2].

    a may be a stack of kernels (..., ny, nx). The last two axes of the result have the shape `out_shape`, and its
    centre is at [ny // 2, nx // 2] too. Light outside is cut off.
    """
    length = tuple(
        int(scipy.fft.next_fast_len(p + q - 1, real=True))
        for p, q in zip(a.shape[-2:], b_kernel.shape, strict=True)
    )
    product = scipy.fft.rfft2(a, s=length, workers=threads) * scipy.fft.rfft2(
        b_kernel, s=length, workers=threads
    )
    full = scipy.fft.irfft2(product, s=length, workers=threads)
    out = np.zeros((*a.shape[:-2], *out_shape), dtype=np.float64)
    source: list[slice] = []
    target: list[slice] = []
    for p, q, n in zip(a.shape[-2:], b_kernel.shape, out_shape, strict=True):
        shift = p // 2 + q // 2 - n // 2
        source.append(slice(max(shift, 0), min(shift + n, p + q - 1)))
        target.append(slice(max(-shift, 0), max(-shift, 0) + source[-1].stop - source[-1].start))
    out[..., target[0], target[1]] = full[..., source[0], source[1]]
    return out


def correlations(
    planes: NDArray[np.floating], scene: NDArray[np.floating], reach_px: int
) -> NDArray[np.floating]:
    """Correlate planes with a scene: for each displacement d, sum plane(x) scene(x - d) over all pixels x.

    d runs from -reach_px to reach_px along each axis. The result has the shape (k, 2 reach_px + 1, 2 reach_px + 1); d =
    0 is in the middle.

    Parameters
    ----------
    planes
        The planes (k, ny, nx).
    scene
        The scene (ny + 2 reach_px, nx + 2 reach_px); its inner (ny, nx) pixels are the pixels of the planes.
    """
    length = tuple(int(scipy.fft.next_fast_len(n, real=True)) for n in scene.shape)
    wide = scipy.fft.rfft2(planes, s=length)
    wide *= scipy.fft.rfft2(scene, s=length).conj()
    # Index i of a plane is index i + reach of the scene, so the sums are shifted back by reach_px.
    back = scipy.fft.irfft2(wide, s=length)
    at = np.arange(-2 * reach_px, 1)
    return np.asarray(back[:, at[:, None], at[None, :]])


class ChirpTransform:
    """Fourier sum from one centred grid to another, with arbitrary steps, computed by convolution (Bluestein 1970).

        F[k] = sum over n of f[n] exp(-2 pi i r n' k'),  n' = n - (N - 1) / 2,  k' = k - (K - 1) / 2
        n' k' = (n'^2 + k'^2 - (k' - n')^2) / 2

    The second line turns the sum into a convolution with a chirp, exp(i pi r n^2).
    r: `ratio`, the phase for n' = k' = 1 in units of 2 pi; it is 1 / N for an FFT.
    N, K: `samples`, `out_samples`. The grids are not periodic: the sum is evaluated exactly as written.
    """

    def __init__(self, ratio: float, samples: int, out_samples: int) -> None:
        self.samples = samples
        self.out_samples = out_samples
        self._length = int(scipy.fft.next_fast_len(samples + out_samples - 1))
        self._before = _chirp(-ratio, np.arange(samples) - (samples - 1) / 2)
        self._after = _chirp(-ratio, np.arange(out_samples) - (out_samples - 1) / 2)
        kernel = np.zeros(self._length, dtype=np.complex128)
        shift = (samples - out_samples) / 2
        kernel[:out_samples] = _chirp(ratio, np.arange(out_samples) + shift)
        kernel[self._length - samples + 1 :] = _chirp(ratio, np.arange(1 - samples, 0) + shift)
        self._transfer = scipy.fft.fft(kernel, overwrite_x=True)

    def apply(self, f: NDArray[np.complexfloating]) -> NDArray[np.complex128]:
        """The transform F, (out_samples,), of a field f, (samples,). Raises DataError "field-shape"."""
        if f.shape != (self.samples,):
            raise DataError("field-shape", f"expected a field of {(self.samples,)}; got {f.shape}")
        spectrum = scipy.fft.fft(f * self._before, n=self._length, overwrite_x=True)
        spectrum *= self._transfer
        sums = scipy.fft.ifft(spectrum, overwrite_x=True)[: self.out_samples]
        return np.asarray(sums * self._after)


def _chirp(ratio: float, n: NDArray[np.floating]) -> NDArray[np.complex128]:
    return np.asarray(np.exp(1j * np.pi * ratio * n**2))


def transform_axis(a: NDArray[np.complex64], *, axis: int, threads: int = 1) -> NDArray[np.complex64]:
    """Fourier transform along one axis. The function may overwrite `a`."""
    return np.asarray(scipy.fft.fft(a, axis=axis, workers=threads, overwrite_x=True))
