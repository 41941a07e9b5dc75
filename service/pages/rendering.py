"""Makes pages from templates, and the page of an error.

A page may load scripts and styles from this service alone, and no script may turn text into markup
(``require-trusted-types-for``). Therefore templates hold no inline scripts or styles, and scripts build elements.

A file in ``templates`` has the templates of one subject, one after the other. A line ``{# --- NAME --- #}`` begins each
of them.
"""

from __future__ import annotations

import operator
import re
from collections.abc import Mapping, Sequence
from datetime import UTC, datetime
from functools import cache
from importlib.resources import files

from fastapi import Request, Response
from fastapi.responses import HTMLResponse
from jinja2 import DictLoader, Environment, StrictUndefined
from markupsafe import Markup

from psfcore.instruments.psf_statements import curves_once
from service.http.callers import Caller
from service.http.state import state_of
from service.pages import assets
from service.pages.forms import number_field
from service.pages.sentences import of_error, plain, remarks_of
from workers.settings import software_version

POLICY = (
    "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self' blob:; connect-src 'self'; "
    "form-action 'self'; frame-ancestors 'none'; base-uri 'none'; require-trusted-types-for 'script'"
)
SHORT = 12  # letters of an id that a page shows
PLAIN_BELOW = 1e6  # larger numbers are shown with a power of ten
FINE_TO_PX = 10.0  # up to this radius a table shows every radius
RATIO = 1.05  # farther out: the least ratio of two successive radii
TITLES = {
    403: "This key does not allow that",
    404: "There is nothing here",
    410: "The file is lost",
    413: "This is too large",
    415: "The service cannot read this file",
    421: "This host name is not served",
    429: "Too many requests",
    431: "The cookies of this site are too long",
    503: "The service cannot answer now",
    507: "The disk of the service is full",
}
TITLES_OF_CODES = {
    "cross-site": "This request came from another site",
    "form-token-missing": "This form is too old",
}
# Other pages of this address would be refused too.
WITHOUT_LINKS = {421}
# The image was stored before these errors, or its page still shows it.
KEPT = "Nothing is lost: your earlier uploads are kept, and you need not send them again."


def page(
    request: Request,
    template: str,
    *,
    status: int = 200,
    headers: Mapping[str, str] | None = None,
    **shown: object,
) -> HTMLResponse:
    """A page: the template of this name with the variables in ``shown``."""
    caller: Caller | None = getattr(request.state, "caller", None)
    token: str = getattr(request.state, "form_token", "")
    field = Markup('<input type="hidden" name="form_token" value="{}">').format(token) if token else ""
    state = getattr(request.app.state, "heliopsf", None)
    text = (
        _environment()
        .get_template(template)
        .render(
            caller=caller,
            keys_used=state is not None and state_of(request).access.keys,
            form_token=field,
            here=request.url.path,
            **shown,
        )
    )
    # A page may contain private data of its reader.
    said = {
        "Content-Security-Policy": POLICY,
        "Cache-Control": "no-store",
        "Vary": "Cookie",
        # Without this policy, browsers would send forms with "Origin: null", and the guard would refuse them.
        "Referrer-Policy": "same-origin",
        **(headers or {}),
    }
    return HTMLResponse(text, status_code=status, headers=said)


def once(curves: Mapping[str, Sequence[float]]) -> dict[str, Sequence[float]]:
    """Each curve of a PSF once, with all its names."""
    return {", ".join(names): numbers for names, numbers in curves_once(curves, operator.eq).items()}


def templates() -> dict[str, str]:
    """The sources of all templates, by their names. A file holds those of one subject; the line {# --- NAME --- #}
    begins each.
    """
    found: dict[str, str] = {}
    for file in files(__package__).joinpath("templates").iterdir():
        before, *parts = re.split(r"^\{# --- (\S+) --- #\}\n", file.read_text("utf-8"), flags=re.MULTILINE)
        names = parts[::2]
        if before or len({*found, *names}) < len(found) + len(names):
            raise ValueError(f"expected only templates, each with a name of its own, in {file.name}")
        found |= zip(names, map(str.strip, parts[1::2]), strict=True)
    return found


@cache
def _environment() -> Environment:
    made = Environment(
        loader=DictLoader(templates()),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    made.globals |= {
        "asset": assets.address,
        "remarks": remarks_of,
        "number_field": number_field,
        "version": software_version(),
    }
    made.filters |= {
        "short": short,
        "date": date,
        "dense": dense,
        "once": once,
        "differing": differing,
        "size": size,
        "duration": duration,
        "number": number,
        "percent": percent,
        "counted": counted,
        "sentence": plain,
    }
    return made


def short(identity: str) -> str:
    """The beginning of an id."""
    return identity[:SHORT]


def date(seconds: float | None) -> Markup | str:
    """Date and time in UTC, as a `<time>` element, from seconds since 1970; "-" for None."""
    if seconds is None:
        return "-"
    moment = datetime.fromtimestamp(seconds, UTC)
    return Markup('<time datetime="{}">{}</time>').format(
        moment.isoformat(timespec="seconds"), moment.strftime("%Y-%m-%d %H:%M:%S UTC")
    )


def size(count: float) -> str:
    """A number of bytes."""
    for unit in ("B", "kB", "MB"):
        if count < 1000:
            return f"{count:.3g} {unit}"
        count /= 1000
    return f"{count:.3g} GB"


def duration(seconds: float | None) -> str:
    """A time span."""
    if seconds is None:
        return "unknown"
    if seconds < 1:
        return "less than 1 s"
    if seconds < 100:
        return f"{seconds:.0f} s"
    if seconds < 6000:
        return f"{seconds / 60:.0f} min"
    return f"{seconds / 3600:.1f} h"


def number(value: float | None, digits: int = 4) -> str:
    """A number with ``digits`` significant digits; below a million without a power of ten."""
    if value is None:
        return "-"
    said = f"{value:.{digits}g}"
    return f"{float(said):.0f}" if "e+" in said and abs(value) < PLAIN_BELOW else said


def counted(count: int, thing: str) -> str:
    """A number of things, such as "1 image" or "3 images"."""
    return f"{count} {thing}{'' if count == 1 else 's'}"


def percent(value: float | None) -> str:
    """A change in percent, with its sign."""
    return "-" if value is None else f"{value:+.3g}\N{NO-BREAK SPACE}%"


def dense(radii: Sequence[float]) -> list[int]:
    """The places of the radii that a table shows: all near the centre; farther out, radii in ratios of at least
    ``RATIO``.
    """
    chosen: list[int] = []
    for place, radius in enumerate(radii):
        last = place in (0, len(radii) - 1)
        if last or radius <= FINE_TO_PX or radius >= radii[chosen[-1]] * RATIO:
            chosen.append(place)
    return chosen


def flat(values: Mapping[str, object]) -> dict[str, str]:
    """Nested values as texts. A name contains all levels, separated by dots."""
    texts: dict[str, str] = {}
    for key, value in values.items():
        if isinstance(value, list) and value and all(isinstance(item, Mapping) for item in value):
            levels = {f"{key} {item.get('name', place)}": item for place, item in enumerate(value, start=1)}
        else:
            levels = {key: value}
        for name, one in levels.items():
            if isinstance(one, Mapping):
                texts |= {f"{name}.{inner}": text for inner, text in flat(one).items()}
            elif one is not None:
                texts[name] = str(one)
    return texts


def differing(one: Mapping[str, object], other: Mapping[str, object]) -> list[tuple[str, str, str]]:
    """The values that differ, which may be nested: the name, and the value of each ("-": it has none)."""
    first, second = flat(one), flat(other)
    rows = [(name, first.get(name, "-"), second.get(name, "-")) for name in {**first, **second}]
    return [row for row in rows if row[1] != row[2]]


# --- the page of an error ---------------------------------------------------------------------------------


def problem_page(
    request: Request, status: int, code: str, detail: str, fields: Mapping[str, object]
) -> Response:
    """The page of an error."""
    usual = "The service failed" if status >= 500 else "The service cannot do that"
    title = TITLES_OF_CODES.get(code) or TITLES.get(status) or usual
    kept = KEPT if status in (429, 500, 503, 507) else ""
    return page(
        request,
        "problem.html",
        status=status,
        told_status=status,
        title=title,
        detail=_told(request, code, detail, fields),
        code=code,
        kept=kept,
        linked=status not in WITHOUT_LINKS,
    )


def _told(request: Request, code: str, detail: str, fields: Mapping[str, object]) -> str:
    if code == "http-404":
        return f"Nothing is at {request.url.path}. Choose a page above."
    errors = fields.get("errors")
    if isinstance(errors, list) and any(str(one["at"]).startswith("path/") for one in errors):
        return f"{request.url.path} is not the address of a page. Copy the whole address, or choose a page above."
    return of_error(code, detail, fields)
