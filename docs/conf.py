"""The documentation site, which `make docs` builds. Neither the build nor the pages need a network."""

from __future__ import annotations

import inspect
import os
import re
import sys
from html import escape
from importlib.metadata import version as version_of
from itertools import pairwise
from pathlib import Path
from typing import Any

import ziamath
from docutils import nodes
from sphinx.application import Sphinx
from sphinx.writers.html5 import HTML5Translator

BUILD = Path(__file__).parent / "_build"
# The PSFs that the tutorials build are kept here, not in the user's cache.
os.environ["HELIOPSF_CACHE_DIR"] = str(BUILD / "psfs")
# A tutorial runs the command heliopsf of this environment.
os.environ["PATH"] = os.pathsep.join([str(Path(sys.executable).parent), os.environ.get("PATH", "")])

project = "heliopsf"
author = "The heliopsf developers"
version = release = version_of("heliopsf")
extensions = ["myst_parser", "sphinx.ext.autodoc", "sphinx.ext.napoleon", "sphinx_gallery.gen_gallery"]
exclude_patterns = ["_build", "tutorials"]
default_role = "py:obj"  # `name` in docstrings
myst_heading_anchors = 3

autodoc_typehints = "none"  # the docstrings say what each parameter is
autodoc_member_order = "bysource"
autodoc_preserve_defaults = True
napoleon_google_docstring = False  # public docstrings have the sections of numpydoc
napoleon_use_ivar = True  # attributes as a list
napoleon_use_rtype = False  # the type of a result beside its text

html_theme = "pydata_sphinx_theme"
html_title = f"heliopsf {release}"
html_static_path = ["site.css"]
html_css_files = ["site.css"]
html_copy_source = False
html_show_sphinx = False
html_math_renderer = "svg"
ziamath.config.svg2 = False  # a formula shares no shapes with another one
html_theme_options = {
    "logo": {"text": "heliopsf"},
    "navbar_align": "left",
    "footer_start": [],
    "footer_end": [],
    "show_toc_level": 2,
    # Pages with wide tables have no list of their sections.
    "secondary_sidebar_items": {"**": ["page-toc"], "aia": [], "instruments": [], "settings": []},
}

sphinx_gallery_conf = {
    "examples_dirs": "tutorials",
    "gallery_dirs": "_gallery",
    "filename_pattern": r"\.py$",  # all tutorials run
    "run_stale_examples": True,  # also those whose text did not change: heliopsf may have changed
    "within_subsection_order": "FileNameSortKey",
    "doc_module": ("heliopsf", "psfcore"),
    "backreferences_dir": None,
    "write_computation_times": False,
    "reference_url": {"heliopsf": None, "psfcore": None},
    "capture_repr": (),
    "show_signature": False,
    "download_all_examples": False,
    "image_srcset": ["2x"],
    "reset_modules": ("matplotlib",),
}

NAMED = re.compile(r"(?:^|(?<=[.)] ))(\w+(?:, \w+)*)(?:\(view\))?: ")


def parameters_as_list(
    app: Sphinx, what: str, name: str, documented: Any, options: Any, lines: list[str]
) -> None:
    """Show the parameters of a docstring, `name: text` or `name, name: text`, as a list."""
    if what not in ("function", "method", "class", "exception"):
        return
    try:
        known = set(inspect.signature(documented).parameters)
    except ValueError:  # a class without a signature
        return
    paragraphs = []
    for paragraph in "\n".join(lines).split("\n\n"):
        text, raises, errors = " ".join(paragraph.split("\n")).partition(" Raises ")
        named = [found for found in NAMED.finditer(text) if known.issuperset(found[1].split(", "))]
        if not named or named[0].start() > 0:
            paragraphs.append(paragraph)
            continue
        for found, after in pairwise([*named, None]):
            end = len(text) if after is None else after.start()
            paragraphs.append(f"- **{found[1]}**: {text[found.end() : end].strip()}")
        if raises:
            paragraphs.append(f"Raises {errors}")
    lines[:] = "\n\n".join(paragraphs).split("\n")


def formula(latex: str, *, inline: bool) -> str:
    """A formula as a picture (SVG), which needs neither a script nor a font of the reader."""
    drawn = ziamath.Latex(latex, size=17, color="currentColor", inline=inline)
    shift = f' style="vertical-align: {drawn.getyofst():.1f}px"' if inline else ""
    return drawn.svg().replace("<svg ", f'<svg role="img" aria-label="{escape(latex)}"{shift} ', 1)


def inline_formula(writer: HTML5Translator, node: nodes.math) -> None:
    """Write a formula in a sentence."""
    writer.body.append(formula(node.astext(), inline=True))
    raise nodes.SkipNode


def displayed_formula(writer: HTML5Translator, node: nodes.math_block) -> None:
    """Write a formula on a line of its own."""
    writer.body.append(f'<div class="formula">{formula(node.astext(), inline=False)}</div>')
    raise nodes.SkipNode


def setup(app: Sphinx) -> None:
    """Register the two changes to what Sphinx does."""
    app.connect("autodoc-process-docstring", parameters_as_list)
    app.add_html_math_renderer("svg", (inline_formula, None), (displayed_formula, None))
