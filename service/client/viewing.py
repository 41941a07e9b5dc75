"""The client's requests about the contents of images and products: pixels, headers, thumbnails."""

from __future__ import annotations

from abc import ABC, abstractmethod
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

if TYPE_CHECKING:
    import httpx
    import numpy as np
    from numpy.typing import NDArray


class Viewing(ABC):
    """The requests about the contents of stored files. Every method raises ``service.client.errors.ServiceError``."""

    @abstractmethod
    def download(self, address: str, path: str | Path, *, overwrite: bool = False) -> None:
        """Write the file at an address of the service to ``path``; an existing file only if ``overwrite`` is true."""

    @abstractmethod
    def _answer(self, method: str, address: str, **options: Any) -> httpx.Response:
        """The answer to a request."""

    def pixels(
        self,
        of: Literal["image", "product"],
        identity: str,
        plane: Literal["image", "error", "quality"] = "image",
        *,
        x: int = 0,
        y: int = 0,
        width: int | None = None,
        height: int | None = None,
        step: int = 1,
    ) -> NDArray[np.float32]:
        """The pixels [y, x] of an uploaded image or of a plane of a product, in the unit of the file; NaN: no value.

        x, y, width, height: the window, px, counted from 0; default: the whole plane. step: n gives one number for each block of
        n x n px: the mean of its finite pixels, for "quality" the bitwise OR. Raises ``ServiceError`` "window-outside"
        and "no-such-plane".
        """
        import numpy as np  # only a caller of this method needs it

        window = {"x": x, "y": y, "width": width, "height": height, "step": step}
        query = {"plane": plane} | {name: value for name, value in window.items() if value is not None}
        answer = self._answer("GET", f"/v1/{of}s/{identity}/pixels", params=query)
        ny, nx = map(int, answer.headers["x-pixels-shape"].split(","))
        return np.frombuffer(answer.content, dtype="<f4").astype(np.float32).reshape(ny, nx)

    def image_header(self, image_id: str) -> list[dict[str, Any]]:
        """The header of each HDU of an uploaded image: ``index``, ``name``, and ``cards`` as [keyword, value, comment]."""
        return self._header(f"/v1/images/{image_id}")

    def product_header(self, product_id: str) -> list[dict[str, Any]]:
        """The header of each HDU of a product, as ``image_header`` gives them."""
        return self._header(f"/v1/products/{product_id}")

    def thumbnail(self, product_id: str, output: str | Path, *, overwrite: bool = False) -> None:
        """Write the small picture of a product (PNG, at most 192 px). Raises ``ServiceError`` "no-thumbnail"."""
        self.download(f"/v1/products/{product_id}/thumbnail", output, overwrite=overwrite)

    def _header(self, address: str) -> list[dict[str, Any]]:
        listed: list[dict[str, Any]] = self._answer("GET", f"{address}/header").json()
        return listed
