"""Check that a stream of RICE_1 holds all pixels of its tile, without decoding their values.

Sources: FITS standard 4.0, section 10.4.1; R. L. White, fits_rdecomp in cfitsio (ricecomp.c), which astropy uses as its
decoder. The decoder compares its position with the end of the stream only once per block. Within a block it may read
past the end, and it skips zero bytes until it finds a byte that is not zero, even beyond the stream. If this module
accepts a stream, the decoder never reads past its end.

    stream = first pixel (B bytes), then blocks of N pixels: FS (3, 4 or 5 bits for B = 1, 2, 4), then
        FS = 0: all differences are 0, no bits                                                            Eq. (1)
        FS = largest + 1: each difference in 8 B bits                                                     Eq. (2)
        otherwise: each difference as zeros, a one, then FS - 1 bits                                      Eq. (3)

| symbol | name |
|---|---|
| B | bytepix |
| N | blocksize |
| FS | code of the block |
"""

from __future__ import annotations

import numpy as np

from psfcore.compiled import compiled

_CODE_BITS = {1: 3, 2: 4, 4: 5}
_LARGEST_CODE = {1: 6, 2: 14, 4: 25}


def rice_is_complete(stream: bytes, pixels: int, bytepix: int, blocksize: int) -> bool:
    """Whether a stream holds at least `pixels` pixels of `bytepix` bytes (1, 2 or 4) in blocks of `blocksize`."""
    content = np.frombuffer(stream, dtype=np.uint8)
    bits = _bits_used(content, pixels, 8 * bytepix, blocksize, _CODE_BITS[bytepix], _LARGEST_CODE[bytepix])
    # The decoder reads one byte after the first pixel even if no pixel needs it.
    return 0 <= bits <= 8 * content.size and content.size > bytepix


@compiled()
def _bits_used(content, pixels, pixel_bits, blocksize, code_bits, largest_code):  # type: ignore[no-untyped-def]
    """The number of bits of the stream that its pixels need; -1 if the stream ends too early."""
    total = 8 * len(content)
    at = pixel_bits
    for first in range(0, pixels, blocksize):
        if at + code_bits > total:
            return -1
        code = 0
        for _ in range(code_bits):
            code = 2 * code + ((content[at >> 3] >> (7 - (at & 7))) & 1)
            at += 1
        count = min(blocksize, pixels - first)
        if code == largest_code + 1:
            at += count * pixel_bits  # Eq. (2)
        elif code > 0:
            for _ in range(count):  # Eq. (3)
                while at < total and not (content[at >> 3] >> (7 - (at & 7))) & 1:
                    at += 8 if at & 7 == 0 and content[at >> 3] == 0 else 1
                at += code  # the bit 1, and then code - 1 bits
                if at > total:
                    return -1
        if at > total:
            return -1
    return at
