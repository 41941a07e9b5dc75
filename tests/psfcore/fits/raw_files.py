"""Bytes of small FITS files, built card by card so that tests can make wrong files."""

from __future__ import annotations

import numpy as np


def block(*cards: str, data: bytes = b"") -> bytes:
    """A header of these cards and END, then data, each padded to 2880 bytes."""
    text = b"".join(card.ljust(80).encode() for card in (*cards, "END"))
    return text + b" " * (-len(text) % 2880) + data + b"\0" * (-len(data) % 2880)


def image_cards(nx: object = 32, ny: object = 16, bitpix: object = 16, *more: str) -> list[str]:
    first = ["SIMPLE  =                    T", f"BITPIX  = {bitpix:>20}", "NAXIS   =                    2"]
    return [*first, f"NAXIS1  = {nx:>20}", f"NAXIS2  = {ny:>20}", *more]


def good() -> bytes:
    return block(*image_cards(), data=bytes(32 * 16 * 2))


def compressed(codec: str = "RICE_1", **changes: object) -> bytes:
    """Headers of a tile-compressed image, followed by zero bytes that cannot be inflated."""
    values: dict[str, object] = {
        "BITPIX": 8, "NAXIS": 2, "NAXIS1": 8, "NAXIS2": 16, "PCOUNT": 100, "GCOUNT": 1, "TFIELDS": 1,
        "TTYPE1": "'COMPRESSED_DATA'", "TFORM1": "'1PB(50)'", "ZIMAGE": "T", "ZBITPIX": 16, "ZNAXIS": 2,
        "ZNAXIS1": 32, "ZNAXIS2": 16, "ZTILE1": 32, "ZTILE2": 1, "ZCMPTYPE": f"'{codec}'",
    }  # fmt: skip
    values.update(changes)
    cards = [f"{key:<8}= {value:>20}" for key, value in values.items()]
    primary = block("SIMPLE  =                    T", "BITPIX  =                    8", "NAXIS   = 0")
    return primary + block("XTENSION= 'BINTABLE'", *cards, data=bytes(8 * 16 + 100))


def empty_primary() -> bytes:
    return block(
        "SIMPLE  =                    T", "BITPIX  =                    8", "NAXIS   =                    0"
    )


def table() -> bytes:
    cards = ["BITPIX  = 8", "NAXIS   = 2", "NAXIS1  = 8", "NAXIS2  = 4", "PCOUNT  = 0", "GCOUNT  = 1"]
    return empty_primary() + block(
        "XTENSION= 'BINTABLE'", *cards, "TFIELDS = 1", "TFORM1  = '1D'", data=bytes(32)
    )


def cube(*axes: int) -> bytes:
    cards = ["SIMPLE  =                    T", "BITPIX  = 8", f"NAXIS   = {len(axes)}"]
    cards += [f"NAXIS{n} = {axis}" for n, axis in enumerate(axes, 1)]
    return block(*cards, data=bytes(int(np.prod(axes))))
