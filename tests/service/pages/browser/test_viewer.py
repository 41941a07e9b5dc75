"""The viewer in a browser: its canvas against NumPy, its readout against the files and astropy."""

from __future__ import annotations

import base64
import json
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any
from urllib.parse import parse_qs, urlsplit

import numpy as np
import pytest
from astropy.io import fits
from astropy.wcs import WCS
from numpy.typing import NDArray
from playwright.sync_api import Page, Response, expect

from psfcore.drawing.thumbnail import NO_DATA, euv_levels, rgb
from tests.service.pages.browser.conftest import Site, Watch
from tests.service.pages.browser.products import COORDINATES, Looked, made

LOW, HIGH = 10.0, 1500.0
SHAPE = (301, 397)

FORWARD = {
    "linear": lambda t: t,
    "sqrt": np.sqrt,
    "asinh": lambda t: np.arcsinh(t / 0.1) / np.arcsinh(10.0),
    "log": lambda t: np.log1p(1000 * t) / np.log1p(1000.0),
}


@pytest.fixture
def page(page: Page) -> Page:
    """A small window: the browser of the tests draws in software."""
    page.set_viewport_size({"width": 800, "height": 600})
    return page


@pytest.fixture(scope="module")
def looked(site: Site, tmp_path_factory: pytest.TempPathFactory) -> Looked:
    """A product with a plane ERROR, coordinates, and pixels without a value."""
    return made(site.client, tmp_path_factory.mktemp("looked"), SHAPE, errors=True, **COORDINATES)


def opened(page: Page, product: Looked, **view: Any) -> None:
    """Open the page of a product with a view, and wait until all pixels are shown."""
    page.goto("about:blank")
    page.goto(f"{product.page}#{'&'.join(f'{name}={value}' for name, value in view.items())}")
    expect(page.locator("#zoom")).to_contain_text("%")
    page.wait_for_load_state("networkidle")
    page.locator("#canvas").evaluate(
        "(canvas) => canvas.scrollIntoView({block: 'center'})"
    )  # the mouse reaches it
    drawn(page)


def drawn(page: Page) -> None:
    """Wait until the last change is on the canvas."""
    page.evaluate("new Promise((done) => requestAnimationFrame(() => requestAnimationFrame(done)))")


def canvas(page: Page) -> NDArray[np.uint8]:
    """Red, green, blue and opacity of the canvas [y, x, 4], row 0 at the bottom."""
    drawn(page)
    width, height, text = page.evaluate(
        """() => {
          const canvas = document.getElementById("canvas"), gl = canvas.getContext("webgl2");
          const pixels = new Uint8Array(4 * canvas.width * canvas.height);
          gl.readPixels(0, 0, canvas.width, canvas.height, gl.RGBA, gl.UNSIGNED_BYTE, pixels);
          let text = "";
          for (let i = 0; i < pixels.length; i += 8192) text += String.fromCharCode(...pixels.subarray(i, i + 8192));
          return [canvas.width, canvas.height, btoa(text)];
        }"""
    )
    return np.frombuffer(base64.b64decode(text), dtype=np.uint8).reshape(height, width, 4)


def canvas_once(page: Page, drawn_as_wanted: Callable[[NDArray[np.uint8]], bool]) -> NDArray[np.uint8]:
    """The canvas when it shows what is wanted; after ten seconds, what it shows then. A tile is decoded and drawn after
    it arrived."""
    for _ in range(100):
        seen = canvas(page)
        if drawn_as_wanted(seen):
            break
        page.wait_for_timeout(100)
    return seen


def levels(values: NDArray[Any], stretch: str, low: float = LOW, high: float = HIGH) -> NDArray[np.intp]:
    """The level of each value, by the stretch's own formula in double precision."""
    shares = np.clip((values.astype(np.float64) - low) / (high - low), 0, 1)
    return np.floor(255 * FORWARD[stretch](shares) + 0.5).astype(np.intp)


def expected(values: NDArray[Any], stretch: str) -> NDArray[np.uint8]:
    """The colours of the EUV map [y, x, 3]."""
    known = np.isfinite(values)
    colours = euv_levels()[levels(np.where(known, values, LOW), stretch)]
    colours[~known] = rgb(NO_DATA)
    return colours


def enlarged(
    plane: NDArray[Any], shape: tuple[int, ...], centre: tuple[float, float], zoom: int
) -> tuple[NDArray[Any], NDArray[np.bool_]]:
    """What a canvas [y, x] shows of a plane at a whole zoom, and where it shows the plane."""
    rows, columns = (
        np.floor(c + (np.arange(size) + 0.5 - size / 2) / zoom).astype(int)
        for c, size in zip(centre, shape, strict=True)
    )
    inside = np.outer((rows >= 0) & (rows < plane.shape[0]), (columns >= 0) & (columns < plane.shape[1]))
    return plane[np.ix_(rows.clip(0, plane.shape[0] - 1), columns.clip(0, plane.shape[1] - 1))], inside


def reduced(plane: NDArray[np.float32], shape: tuple[int, ...]) -> tuple[NDArray[Any], NDArray[np.bool_]]:
    """What a canvas [y, x] shows of a plane when all of it fits: means of the finite pixels whose centres lie in a
    pixel of the canvas. The sums are of single precision, in the order of the rows, as the card adds them."""
    zoom = min(shape[0] / plane.shape[0], shape[1] / plane.shape[1])
    edges = [
        np.clip(np.ceil(size / 2 + (np.arange(n + 1) - n / 2) / zoom - 0.5).astype(int), 0, size)
        for size, n in zip(plane.shape, shape, strict=True)
    ]
    shown = np.full(shape, np.nan, dtype=np.float32)
    inside = np.outer(np.diff(edges[0]) > 0, np.diff(edges[1]) > 0)
    for row, column in zip(*np.nonzero(inside), strict=True):
        part = plane[edges[0][row] : edges[0][row + 1], edges[1][column] : edges[1][column + 1]]
        finite = part[np.isfinite(part)]
        if finite.size:
            total = np.float32(0)
            for value in finite:
                total += value
            shown[row, column] = total / np.float32(finite.size)
    return shown, inside


@pytest.mark.parametrize("zoom", [1, 8])
def test_the_canvas_equals_numpy_at_every_stretch(page: Page, looked: Looked, zoom: int) -> None:
    # The patch without values is in sight at both zooms.
    centre = (30.0, 45.0) if zoom == 8 else (150.0, 200.0)
    opened(page, looked, mode="blink", zoom=zoom, x=centre[1], y=centre[0], low=LOW, high=HIGH)
    for stretch in FORWARD:
        page.select_option("#stretch", stretch)
        for name, plane in (("after", looked.after), ("before", looked.before)):
            if page.locator("#tag-left").text_content() != name:
                page.locator("#blink").click()
            seen = canvas(page)
            values, inside = enlarged(plane, seen.shape[:2], centre, zoom)
            assert np.isnan(values[inside]).any()
            np.testing.assert_array_equal(
                seen[inside][:, :3], expected(values, stretch)[inside], f"{stretch}, {name}"
            )
            assert (seen[inside][:, 3] == 255).all()
            assert (seen[~inside] == 0).all()


def test_the_whole_image_is_averaged_over_the_pixels_that_a_point_covers(page: Page, looked: Looked) -> None:
    page.set_viewport_size({"width": 700, "height": 300})
    opened(page, looked, mode="blink", stretch="linear", low=LOW, high=HIGH)
    values, inside = reduced(looked.after, canvas(page).shape[:2])
    assert inside.any() and inside.shape[0] < looked.after.shape[0]
    for stretch in ("linear", "log"):
        page.select_option("#stretch", stretch)
        np.testing.assert_array_equal(canvas(page)[inside][:, :3], expected(values, stretch)[inside])


def test_all_pixels_of_both_images_give_the_limits(page: Page, looked: Looked) -> None:
    opened(page, looked)
    both = np.concatenate([looked.before.ravel(), looked.after.ravel()])
    low, high = np.nanpercentile(both.astype(np.float64), [0.1, 99.9])
    assert float(page.input_value("#low")) == np.float32(low)
    assert float(page.input_value("#high")) == np.float32(high)
    page.fill("#percent-high", "50")
    page.keyboard.press("Enter")
    page.keyboard.press("Tab")
    assert float(page.input_value("#high")) == np.float32(np.nanpercentile(both.astype(np.float64), 50))


def test_the_divider_moves_by_keyboard_and_by_drag(page: Page, looked: Looked) -> None:
    opened(page, looked)
    first = canvas(page)
    page.focus("#divider")
    page.keyboard.press("Home")
    assert page.input_value("#divider") == "0"
    left = canvas(page)
    assert (left != first).any()
    page.keyboard.press("End")
    assert page.input_value("#divider") == "1"
    page.locator("#canvas").scroll_into_view_if_needed()
    box = page.locator("#canvas").bounding_box()
    assert box is not None
    page.mouse.move(box["x"] + box["width"] - 2, box["y"] + 50)
    page.mouse.down()
    page.mouse.move(box["x"] + box["width"] / 4, box["y"] + 60, steps=3)
    page.mouse.up()
    assert float(page.input_value("#divider")) == pytest.approx(0.25, abs=0.01)


def test_each_mode_shows_its_part_of_both_images(page: Page, looked: Looked) -> None:
    opened(
        page, looked, mode="slider", zoom=1, x=200, y=150, stretch="sqrt", low=LOW, high=HIGH, divider=0.25
    )
    seen = canvas(page)
    cut = round(0.25 * seen.shape[1])
    before, inside = enlarged(looked.before, seen.shape[:2], (150, 200), 1)
    after, _ = enlarged(looked.after, seen.shape[:2], (150, 200), 1)
    wanted = np.concatenate([before[:, :cut], after[:, cut:]], axis=1)
    np.testing.assert_array_equal(seen[inside][:, :3], expected(wanted, "sqrt")[inside])

    opened(page, looked, mode="side", zoom=1, x=200, y=150, stretch="sqrt", low=LOW, high=HIGH)
    seen = canvas(page)
    half = seen.shape[1] // 2
    for part, plane in ((seen[:, :half], looked.before), (seen[:, -half:], looked.after)):
        values, inside = enlarged(plane, part.shape[:2], (150, 200), 1)
        np.testing.assert_array_equal(part[inside][:, :3], expected(values, "sqrt")[inside])
    opened(page, looked, mode="change", zoom=1, x=200, y=150, change=40)
    seen = canvas(page)
    before, inside = enlarged(looked.before, seen.shape[:2], (150, 200), 1)
    after, _ = enlarged(looked.after, seen.shape[:2], (150, 200), 1)
    inside &= np.isfinite(before)
    change = 100 * (after[inside].astype(np.float64) - before[inside]) / before[inside]
    colours = table(page, "change")
    # The card divides in single precision: at a limit between two levels it may take the other one.
    exact = 255 * (np.clip(change / 40, -1, 1) + 1) / 2 + 0.5
    clear = np.abs(exact - np.round(exact)) > 1e-4
    assert clear.mean() > 0.99
    np.testing.assert_array_equal(seen[inside][clear][:, :3], colours[np.floor(exact).astype(int)][clear])


def table(page: Page, name: str) -> NDArray[np.uint8]:
    """The colours of a map [256, 3], as the scripts make them."""
    found = script(page, "stretch.js", f"[...module.colourTable({json.dumps(name)})]")
    return np.array(found, dtype=np.uint8).reshape(256, 4)[:, :3]


def script(page: Page, name: str, expression: str) -> Any:
    """The value of an expression on the module of a script."""
    source = page.locator('script[src*="viewer.js"]').get_attribute("src")
    assert source is not None
    return page.evaluate(
        f"async () => {{ const module = await import({json.dumps(source.replace('viewer.js', name))}); return "
        f"{expression}; }}"
    )


def said(page: Page, name: str) -> str:
    text = page.locator(f'[data-value="{name}"]').text_content()
    assert text is not None
    return text


def test_the_cursor_reads_the_values_of_the_files(page: Page, looked: Looked) -> None:
    opened(page, looked, zoom=4, x=60.5, y=40.5)
    error = fits.getdata(looked.file, "ERROR")
    quality = fits.getdata(looked.file, "QUALITY")
    wcs = WCS(fits.getheader(looked.file))
    page.focus("#canvas")
    for keys in ["Shift+ArrowRight"] * 3 + ["Shift+ArrowUp"] * 2:
        page.keyboard.press(keys)
    x, y = 63, 42  # counted from 0
    assert said(page, "pixel") == f"{x + 1}, {y + 1}"
    assert np.float32(said(page, "before").removesuffix(" DN/s")) == looked.before[y, x]
    assert np.float32(said(page, "after").removesuffix(" DN/s")) == looked.after[y, x]
    expect(page.locator('[data-value="error"]')).to_contain_text("DN/s")
    assert np.float32(said(page, "error").removesuffix(" DN/s")) == error[y, x]
    assert quality[y, x] == 0 and said(page, "quality") == "0: good"
    change = 100 * (float(looked.after[y, x]) / float(looked.before[y, x]) - 1)
    assert float(said(page, "change").replace("−", "-").removesuffix(" %")) == pytest.approx(change, rel=1e-3)
    place = np.array([float(part.strip().removesuffix("″")) for part in said(page, "sky").split(",")])
    np.testing.assert_allclose(place, arcsec(wcs, x + 1, y + 1), atol=6e-4)  # three digits are shown
    expect(page.locator("#spoken")).to_contain_text(f"pixel {x + 1}, {y + 1}")
    expect(page.locator("#cross")).to_be_visible()


def test_the_mouse_reads_the_pixel_under_it(page: Page, looked: Looked) -> None:
    opened(page, looked, zoom=8, x=35, y=25)
    box = page.locator("#canvas").bounding_box()
    assert box is not None
    page.mouse.move(box["x"] + box["width"] / 2 + 8 * 20 + 3, box["y"] + box["height"] / 2 + 8 * 10 + 3)
    x, y = 55, 14
    assert said(page, "pixel") == f"{x + 1}, {y + 1}"
    assert np.float32(said(page, "after").removesuffix(" DN/s")) == looked.after[y, x]
    page.mouse.move(box["x"] + box["width"] / 2, box["y"] + box["height"] / 2 + 8 * 2)
    assert np.isnan(looked.before[22, 35])
    assert said(page, "before") == "no value (NaN)"
    expect(page.locator('[data-value="quality"]')).to_contain_text("NONFINITE (input not finite, no result)")


def arcsec(wcs: WCS, x: float, y: float) -> NDArray[np.float64]:
    """Coordinates by astropy, arcsec; the longitude between -180 and 180 degrees."""
    longitude, latitude = wcs.all_pix2world(x, y, 1)
    return 3600 * np.array([(longitude + 180) % 360 - 180, latitude])


def test_coordinates_equal_those_of_astropy(page: Page, looked: Looked) -> None:
    matrix = {"PC1_1": 0.8, "PC1_2": -0.61, "PC2_1": 0.59, "PC2_2": 0.81}
    whole_matrix = {"CD1_1": 4.1, "CD1_2": 0.3, "CD2_1": -0.2, "CD2_2": 4.2}
    degrees = {"CUNIT1": "deg", "CUNIT2": "deg", "CDELT1": 0.001, "CDELT2": 0.001}
    page.goto(looked.page)
    places = [[1, 1], [400, 1], [17.25, 301.5], [2048, 2048]]
    for name, changes in {
        "CROTA2": {},
        "PC": {"CROTA2": None, **matrix},
        "CD": {"CROTA2": None, "CDELT1": None, "CDELT2": None, **whole_matrix},
        "degrees": {**degrees, "CRVAL1": 12.0, "CRVAL2": -30.0},
        "LONPOLE": {"LONPOLE": 150.0},
    }.items():
        cards = {card: value for card, value in (COORDINATES | changes).items() if value is not None}
        header = fits.Header(cards)
        described = json.dumps([list(card) for card in header.items()])
        pairs = script(
            page,
            "planes.js",
            f"{places}.map((place) => module.coordinates(new Map({described})).of(...place))",
        )
        right = [arcsec(WCS(header), *place) for place in places]
        np.testing.assert_allclose(pairs, right, atol=1e-7, rtol=0, err_msg=name)


def test_a_product_without_error_or_coordinates_says_so(page: Page, site: Site, tmp_path: Path) -> None:
    opened(page, made(site.client, tmp_path, (64, 80)))
    page.focus("#canvas")
    page.keyboard.press("Shift+ArrowLeft")
    expect(page.locator('[data-value="error"]')).to_have_text("no ERROR plane")
    expect(page.locator('[data-value="sky"]')).to_have_text("The header has no coordinates.")
    expect(page.locator("#error")).to_be_disabled()
    expect(page.locator("#no-error")).to_be_visible()
    expect(page.locator('[data-value="quality"]')).to_have_text("0: good")


def test_a_blink_is_one_copy_on_the_card(page: Page, looked: Looked) -> None:
    opened(page, looked, mode="blink")
    page.evaluate(
        """() => {
          const gl = document.getElementById("canvas").getContext("webgl2");
          window.calls = { copies: 0, draws: 0, textures: 0 };
          const copy = gl.blitFramebuffer.bind(gl), draw = gl.drawArrays.bind(gl), upload = gl.texImage2D.bind(gl);
          gl.blitFramebuffer = (...given) => { window.calls.copies += 1; copy(...given); };
          gl.drawArrays = (...given) => { window.calls.draws += 1; draw(...given); };
          gl.texImage2D = (...given) => { window.calls.textures += 1; upload(...given); };
        }"""
    )
    page.focus("#canvas")
    after = canvas(page)
    page.keyboard.press("b")
    before = canvas(page)
    assert (before != after).any()
    assert page.locator("#tag-left").text_content() == "before"
    page.keyboard.press("b")
    np.testing.assert_array_equal(canvas(page), after)
    assert page.evaluate("window.calls") == {"copies": 2, "draws": 0, "textures": 0}


def still(page: Page) -> np.ndarray:
    """The canvas when nothing loads any more and two looks at it show the same."""
    page.wait_for_load_state("networkidle")
    seen = canvas(page)
    for _ in range(20):
        page.wait_for_timeout(300)
        before, seen = seen, canvas(page)
        if np.array_equal(before, seen):
            return seen
    raise AssertionError("the canvas still changes after six seconds")


def test_the_address_restores_the_view(page: Page, looked: Looked) -> None:
    opened(page, looked)
    page.select_option("#mode", "blink")
    page.select_option("#stretch", "log")
    page.select_option("#map", "sea")
    page.focus("#canvas")
    for key in ("1", "+", "ArrowRight", "ArrowUp", "b"):
        page.keyboard.press(key)
    page.check("#quality")
    expect(page).to_have_url(re.compile("shown=before.*quality=1"))
    seen, address = still(page), page.url
    page.goto("about:blank")
    page.goto(address)
    np.testing.assert_array_equal(still(page), seen)
    assert page.input_value("#stretch") == "log" and page.is_checked("#quality")


def test_an_address_with_nonsense_shows_the_plain_view(page: Page, looked: Looked) -> None:
    opened(page, looked)
    plain = canvas(page)
    opened(page, looked, mode="evil", zoom=-3, stretch="%3Cb%3E", low=5, high=1, x="NaN", divider=9)
    page.locator("#divider").fill("0.5")
    np.testing.assert_array_equal(canvas(page), plain)


def test_marks_lie_over_the_pixels_that_they_mark(page: Page, looked: Looked) -> None:
    view = {"mode": "blink", "zoom": 1, "x": 200, "y": 150, "stretch": "sqrt", "low": LOW, "high": HIGH}
    opened(page, looked, **view)
    plain = canvas(page)
    for mark, plane in (
        ({"quality": 1}, fits.getdata(looked.file, "QUALITY") != 0),
        (
            {"error": 25},
            100 * fits.getdata(looked.file, "ERROR").astype(np.float64)
            > 25 * np.abs(looked.after.astype(np.float64)),
        ),
    ):
        opened(page, looked, **view, **mark)
        marked, inside = enlarged(plane, plain.shape[:2], (150, 200), 1)
        differs = (canvas(page) != plain).any(axis=2)
        assert 0 < marked[inside].sum() < marked[inside].size
        np.testing.assert_array_equal(differs[inside], marked[inside])


def test_wheel_double_click_and_keys_zoom(page: Page, looked: Looked) -> None:
    opened(page, looked, zoom=4, x=100, y=100)
    box = page.locator("#canvas").bounding_box()
    assert box is not None
    page.mouse.move(box["x"] + 200, box["y"] + 200)
    held = said(page, "pixel")
    page.mouse.wheel(0, -300)
    drawn(page)
    assert page.locator("#zoom").text_content() != "400 %"
    page.mouse.move(box["x"] + 201, box["y"] + 200)
    page.mouse.move(box["x"] + 200, box["y"] + 200)
    assert said(page, "pixel") == held
    page.mouse.dblclick(box["x"] + 200, box["y"] + 200)
    expect(page.locator("#zoom")).to_have_text("100 %")
    page.focus("#canvas")
    page.keyboard.press("+")
    expect(page.locator("#zoom")).to_have_text("200 %")
    page.keyboard.press("-")
    page.keyboard.press("-")
    expect(page.locator("#zoom")).to_have_text("50 %")
    page.keyboard.press("f")
    expect(page.locator("#zoom")).not_to_have_text("50 %")


def test_a_narrow_window_loads_what_is_in_view(page: Page, site: Site, tmp_path: Path) -> None:
    wide = made(site.client, tmp_path, (800, 1000))
    page.set_viewport_size({"width": 390, "height": 800})
    opened(page, wide, mode="blink", stretch="sqrt", low=LOW, high=HIGH)
    page.focus("#canvas")
    ny, nx = wide.after.shape
    parts: list[tuple[int, int]] = []

    def add_part(answer: Response) -> None:
        """Add the shape of a part of the product at full resolution. A slow page also loads parts for the first zooms,
        and then may need no smaller one.
        """
        asked = parse_qs(urlsplit(answer.url).query)
        if "/products/" in answer.url and asked.get("step") == ["1"]:
            rows, columns = map(int, answer.headers["x-pixels-shape"].split(","))
            parts.append((rows, columns))

    page.on("response", add_part)
    for key in ("1", "+", "+", "+"):
        page.keyboard.press(key)
    values, inside = enlarged(wide.after, canvas(page).shape[:2], (ny / 2, nx / 2), 8)
    wanted = expected(values, "sqrt")[inside]
    seen = canvas_once(page, lambda picture: np.array_equal(picture[inside][:, :3], wanted))
    np.testing.assert_array_equal(seen[inside][:, :3], wanted)
    assert parts and all(rows * columns < ny * nx / 2 for rows, columns in parts)
    address = page.url
    page.goto("about:blank")
    page.goto(address)  # the same part is loaded at once
    again = canvas_once(page, lambda picture: np.array_equal(picture, seen))
    np.testing.assert_array_equal(again, seen)


def test_the_picture_comes_back_after_the_card_was_lost(page: Page, looked: Looked, watch: Watch) -> None:
    watch.allowed.append("CONTEXT_LOST_WEBGL")
    opened(page, looked)
    seen = canvas(page)
    page.evaluate(
        """() => {
          window.card = document.getElementById("canvas").getContext("webgl2").getExtension("WEBGL_lose_context");
          window.card.loseContext();
        }"""
    )
    expect(page.locator("#viewer-said")).to_contain_text("The browser has lost access to the graphics card")
    page.evaluate("window.card.restoreContext()")
    expect(page.locator("#viewer-said")).to_be_hidden()
    np.testing.assert_array_equal(canvas(page), seen)


def test_without_webgl_the_picture_of_the_service_is_shown(page: Page, looked: Looked) -> None:
    page.add_init_script("HTMLCanvasElement.prototype.getContext = () => null")
    page.goto(looked.page)
    expect(page.locator("#viewer-said")).to_contain_text("expected WebGL2; this browser has none")
    expect(page.locator("#viewer img")).to_be_visible()
    expect(page.locator("#viewer-body")).to_be_hidden()
