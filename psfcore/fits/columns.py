"""Read the columns of a binary table from its header, before the table is read.

Source: FITS standard 4.0 (Pence et al. 2010; IAU FITS working group 2018), section 7.3. astropy makes an object for each
column that TFIELDS declares, and reserves the memory that the cards TFORMn declare for each row, even if the file is
shorter. Therefore this module limits TFIELDS and compares the columns with the size of a row. It reads no data, so the
web process can import it.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from typing import TYPE_CHECKING

from psfcore.errors import HeaderError
from psfcore.fits.cards import card_count, card_text

if TYPE_CHECKING:
    from astropy.io.fits import Header

MOST_COLUMNS = 999  # section 7.2.1: the largest TFIELDS
ITEM_BYTES = {
    "L": 1,
    "B": 1,
    "A": 1,
    "I": 2,
    "J": 4,
    "E": 4,
    "K": 8,
    "D": 8,
    "C": 8,
    "M": 16,
    "P": 8,
    "Q": 16,
}
_FORM = re.compile(r"(\d{0,9})([LXBIJKAEDCMPQ])([LXBIJKAEDCM]?)(\(\d{1,18}\))?")


@dataclass(frozen=True)
class Column:
    """A column: its name in capitals, and its format (table 18 of the standard).

    repeat: items in a row. form: the letter of the type. item: for P and Q, the letter of the type in the heap.
    """

    name: str
    repeat: int
    form: str
    item: str

    @property
    def row_bytes(self) -> int:
        """Bytes of this column in one row."""
        return -(-self.repeat // 8) if self.form == "X" else self.repeat * ITEM_BYTES[self.form]

    @property
    def in_heap(self) -> bool:
        """Whether a row holds descriptors (length, offset) of data in the heap."""
        return self.form in "PQ"

    def __str__(self) -> str:
        return f"{self.name:.40} {self.repeat}{self.form}{self.item}"


def check_counts(header: Header) -> None:
    """Raise HeaderError "bad-card" if TFIELDS or ZNAXIS of an HDU is larger than the standard allows."""
    for key in ("TFIELDS", "ZNAXIS"):
        card_count(header, key, largest=MOST_COLUMNS, default=0)


def read_columns(header: Header) -> list[Column]:
    """The columns of a binary table.

    Raises HeaderError "bad-card" if a format cannot be read, if two columns have one name, or if the columns do not need
    exactly the NAXIS1 bytes of a row.
    """
    columns: list[Column] = []
    names: set[str] = set()
    for number in range(1, card_count(header, "TFIELDS", largest=MOST_COLUMNS) + 1):
        name = (card_text(header, f"TTYPE{number}") or f"column {number}").upper()
        text = card_text(header, f"TFORM{number}")
        form = None if text is None else _FORM.fullmatch(text.upper())
        if form is None or (form[2] in "PQ") != bool(form[3]):
            raise HeaderError("bad-card", f"expected TFORM{number} to be a binary format; got {text!r:.40}")
        if name in names:
            raise HeaderError(
                "bad-card", f"expected each column once; got {name:.40} again as column {number}"
            )
        names.add(name)
        columns.append(Column(name, int(form[1] or 1), form[2], form[3]))
    row_bytes = sum(column.row_bytes for column in columns)
    card_count(header, "NAXIS1", smallest=row_bytes, largest=row_bytes)
    return columns
