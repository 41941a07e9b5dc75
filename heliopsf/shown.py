"""How results show themselves at a prompt and in a notebook: two lines, and their picture."""

from __future__ import annotations

import base64
from html import escape
from typing import TYPE_CHECKING

from psfcore.errors import MissingExtra, module_of_extra

if TYPE_CHECKING:
    from matplotlib.figure import Figure


class Shown:
    """A result with ``lines()`` and a picture, ``quicklook()``."""

    def lines(self) -> list[str]:
        """The result in two lines."""
        raise NotImplementedError

    def quicklook(self) -> Figure:
        """The picture. Needs the extra "plot"."""
        raise NotImplementedError

    def __repr__(self) -> str:
        return "\n".join(self.lines())

    def _repr_html_(self) -> str:
        text = "<br>".join(map(escape, self.lines()))
        try:
            png: bytes = module_of_extra("psfcore.drawing.plots").png_of(self.quicklook())
        except MissingExtra as missing:
            return f"<p>{text}<br>{escape(str(missing))}</p>"
        data = base64.b64encode(png).decode("ascii")
        return f'<p>{text}</p><img style="max-width: 100%" alt="" src="data:image/png;base64,{data}">'
