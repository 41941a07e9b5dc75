"""Added effects: read from a file or a module, checked, and every error reported to their author."""

from __future__ import annotations

import hashlib
import re
import sys
from pathlib import Path
from textwrap import dedent

import numpy as np
import pytest

from psfcore import gap
from psfcore.errors import DataError
from psfcore.gap.effect import Effect
from psfcore.gap.effect_sources import sha256_of_source
from psfcore.gap.evidence.responses import gather
from psfcore.gap.library.registry import LIBRARY, added_effects, library_with
from tests.gap_files import EDGE_GLOW as GLOW
from tests.psfcore.gap.small_gaps import solution, view

DOCUMENTATION = Path(__file__).parents[4] / "docs" / "gap.md"


def source_in(folder: Path, text: str = GLOW, name: str = "mine.py") -> str:
    path = folder / name
    path.write_text(dedent(text))
    return str(path)


def one_of(source: str) -> Effect:
    (added,) = added_effects([source])
    return added.effects[0]


def test_the_effects_of_a_file_follow_the_library_and_have_its_hash(tmp_path: Path) -> None:
    source = source_in(tmp_path)
    (added,) = added_effects([source])
    assert [effect.name for effect in library_with([added])] == [*(e.name for e in LIBRARY), "edge_glow"]
    assert added.source == source
    assert added.sha256 == hashlib.sha256(Path(source).read_bytes()).hexdigest() == sha256_of_source(source)
    assert library_with([]) == LIBRARY
    # The discs show the effect, strongest at the right.
    evidence = gather(solution(), [added.effects[0]])
    (column,) = evidence.columns["edge_glow"]
    by_place = sorted(
        (evidence.image_info[d.index].x_px, float(d.share @ d.jacobian[column])) for d in evidence.discs
    )
    assert by_place[-1][1] > 3 * abs(by_place[0][1])


def test_modules_changed_files_and_the_examples_of_the_documentation(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    text = "from __future__ import annotations\nfrom dataclasses import dataclass, KW_ONLY\n"
    text += GLOW + "\n@dataclass\nclass Lamp:\n    _: KW_ONLY\n    watts: float = 1.0\n"
    assert gap.__doc__ is not None
    indented = "\n".join(line[4:] for line in gap.__doc__.splitlines() if line.startswith("    "))
    codes = re.findall(r"```python\n(.*?)```", DOCUMENTATION.read_text("utf-8"), re.S)
    (in_page,) = (code for code in codes if "EFFECTS" in code)
    for example, name in ((text, "edge_glow"), (indented, "lamp_glow"), (in_page, "lamp_glow")):
        assert one_of(source_in(tmp_path, example)).name == name
    module = "my_effects_module"
    source_in(tmp_path, name=f"{module}.py")
    monkeypatch.syspath_prepend(tmp_path)
    assert one_of(module).name == "edge_glow"
    assert sha256_of_source(module) == added_effects([module])[0].sha256
    source_in(tmp_path, GLOW.replace("edge_glow", "module_glow"), name=f"{module}.py")
    assert one_of(module).name == "module_glow"
    monkeypatch.delitem(sys.modules, module)
    for name in ("edge_glow", "rim_glow"):
        assert one_of(source_in(tmp_path, GLOW.replace("edge_glow", name))).name == name


def test_an_error_in_a_source_is_reported_with_its_name(tmp_path: Path) -> None:
    texts = {
        "": "got no variable of this name",
        "EFFECTS = ()": "got an empty tuple or list",
        "EFFECTS = 3": "got int",
        "EFFECTS = (": "SyntaxError",
        "x = 1\ny = x + z\n": "NameError: name 'z' is not defined (line 2)",
        GLOW.replace('"a dark exposure", ', ""): "missing 1 required positional argument",
        GLOW.replace("edge_glow", "edge glow"): "letters, digits and _; got 'edge glow'",
        GLOW.replace("glow),)", "glow, family='lamps'),)"): "edge_glow: expected a family of ",
        GLOW.replace(
            '(EffectParameter("height", "DN/s", 5.0),)', "()"
        ): "edge_glow: expected at least one parameter",
    }
    for n, (text, said) in enumerate(texts.items()):
        source = source_in(tmp_path, text, f"mine_{n}.py")
        with pytest.raises(DataError) as refusal:
            added_effects([source])
        assert refusal.value.code == "bad-effects"
        assert said in refusal.value.message and source in refusal.value.message, text
    for source in ("nowhere.py", "no_such_module", "no_such.module", "sys", "..relative", ""):
        with pytest.raises(DataError, match=f"effects of {source}") as refusal:
            added_effects([source])
        assert refusal.value.code == "bad-effects"
    # Two sources must not define the same name.
    with pytest.raises(DataError, match=r"other\.py.* got 'edge_glow' twice"):
        added_effects([source_in(tmp_path), source_in(tmp_path, name="other.py")])


def test_a_change_that_is_not_an_image_is_reported_when_it_is_computed(tmp_path: Path) -> None:
    ny, nx = solution().transit.shape
    changes = {
        "plane[1:]": f"edge_glow: expected an image of shape ({ny}, {nx}) [y, x]; got an array of shape ({ny - 1}, ",
        "plane * np.nan": "got an image with NaN or infinite values",
        "plane / nothing": "NameError: name 'nothing' is not defined (line 8)",
    }
    for n, (change, said) in enumerate(changes.items()):
        text = GLOW.replace("lambda n, images: plane", f"lambda n, images: {change}")
        (faulty,) = one_of(source_in(tmp_path, text, f"mine_{n}.py")).changes(view())
        with pytest.raises(DataError) as refusal:
            faulty.change(0, view().expected)
        assert refusal.value.code == "bad-effects" and said in refusal.value.message
    two = GLOW.replace("unocculted=False)]", "unocculted=False)] * 2")
    with pytest.raises(DataError, match="edge_glow: expected 1 Change, one per parameter; got 2"):
        one_of(source_in(tmp_path, two)).changes(view())
    # `why_not` and `held` of an added effect are checked too.
    text = GLOW.replace("glow),)", "glow, lambda view: 1 / 0, held=lambda view: EFFECTS[0]),)")
    effect = one_of(source_in(tmp_path, text))
    with pytest.raises(DataError, match="ZeroDivisionError"):
        effect.why_not(view())
    assert effect.held is not None
    (held,) = effect.held(view()).changes(view())
    np.testing.assert_array_equal(held.change(0, view().expected)[0], held.change(3, view().expected)[9])
