"""Compare the times of the viewer in a browser with their goals.

The benchmark needs Chromium. No other program should run on the machine. Three times are measured:

- first page: the first product after the start. The service loads its numerical libraries, and the browser prepares its
  drawing.
- first sight and all pixels: a product of 2048 px. The service has not yet decoded any plane of this product. Both
  times begin with the navigation. "First sight" ends with the first frame after the overview was drawn, "all pixels"
  with the first frame after all pixels were drawn.
- a blink: the time from the key to the end of the drawing on the graphics card. Without a graphics card, Chromium draws
  with the processor.

The memory is measured for a product of 4096 px in a window of 390 px, after zooming to 100 % and moving: the resident
memory that the tab's process does not share with other processes (USS). The memory of the graphics process is also
printed.
"""

from __future__ import annotations

import statistics
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import psutil
from playwright.sync_api import Browser, Page, sync_playwright

from benchmarks.figures import tell
from benchmarks.timing import reference
from tests.chromium import VARIABLE, chromium
from tests.service.pages.browser.conftest import SOFTWARE_GL
from tests.service.pages.browser.products import made
from tests.whole.stack import Stack, embedded

BLINKS = 20
LARGE, SMALL = (1280, 900), (390, 844)  # windows, px
TIME_OF = "(name) => performance.getEntriesByName(name)[0]?.startTime ?? null"
BLINK_MS = """async () => {
  const canvas = document.getElementById("canvas"), gl = canvas.getContext("webgl2"), end = new Uint8Array(4);
  await new Promise(requestAnimationFrame);
  const start = performance.now();
  canvas.dispatchEvent(new KeyboardEvent("keydown", { key: "b" }));
  await new Promise(requestAnimationFrame);
  gl.readPixels(0, 0, 1, 1, gl.RGBA, gl.UNSIGNED_BYTE, end);
  return performance.now() - start;
}"""


def moment(page: Page, name: str) -> float:
    """The time at which the page recorded the event `name`, in seconds after the start of the navigation."""
    for _ in range(600):
        found = page.evaluate(TIME_OF, name)
        if found is not None:
            return float(found) / 1000
        page.wait_for_timeout(50)
    raise SystemExit(f"expected the viewer to show {name!r} within 30 s; it did not")


def own_mb(kind: str) -> float:
    """The unshared memory, MB, of the browser's process of this kind; the largest if there are several."""
    children = psutil.Process().children(recursive=True)
    found = [one for one in children if f"--type={kind}" in one.cmdline()]
    return max(one.memory_full_info().uss for one in found) / 1e6


def showing(
    browser: Browser, stack: Stack, folder: Path, size: int, window: tuple[int, int], **image: Any
) -> Page:
    """A new page that has begun to show a new product."""
    folder = folder / f"{size} {len(list(folder.iterdir()))}"
    folder.mkdir()
    product = made(stack.client, folder, (size, size), **image)
    page = browser.new_page(viewport={"width": window[0], "height": window[1]})
    page.goto("about:blank")
    page.goto(f"{stack.client.server}{product.page}#mode=blink")
    return page


def main() -> None:
    program = chromium()
    if program is None:
        raise SystemExit(
            f"expected Chromium on this machine; found none: install it, or set {VARIABLE} to the path of its program"
        )
    f_s = reference()
    with TemporaryDirectory(prefix="heliopsf-viewer-") as temporary, sync_playwright() as playwright:
        folder = Path(temporary)
        browser = playwright.chromium.launch(executable_path=program, args=list(SOFTWARE_GL))
        with embedded(folder) as site:
            page = showing(browser, site, folder, 2048, LARGE)
            print(f"first page after start: {moment(page, 'overview'):6.3f} s (no goal)", flush=True)
            page.close()
            page = showing(browser, site, folder, 2048, LARGE, OBJECT="second")
            tell("viewer: first sight, 2048 px", moment(page, "overview"), f_s)
            tell("viewer: all pixels, 2048 px", moment(page, "all pixels"), f_s)
            page.wait_for_load_state("networkidle")
            blinks = [page.evaluate(BLINK_MS) / 1000 for _ in range(BLINKS)]
            tell("viewer: a blink", statistics.median(blinks), f_s)
            print(f"the slowest blink: {max(blinks):6.3f} s of {BLINKS}", flush=True)
            page.close()
            page = showing(browser, site, folder, 4096, SMALL)
            moment(page, "overview")
            page.focus("#canvas")
            for key in ("1", "ArrowRight", "ArrowUp", "ArrowLeft", "-", "b", "b", "f", "1"):
                page.keyboard.press(key)
                page.wait_for_timeout(600)
            tell("viewer: memory of a tab, 4096 px", own_mb("renderer"))
            print(f"memory of the graphics process {own_mb('gpu-process'):.0f} MB")
        browser.close()


if __name__ == "__main__":
    main()
