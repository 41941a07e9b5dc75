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
from psfcore.gap.evidence.evidence import gather
from psfcore.gap.library.added import added_effects, library_with
from psfcore.gap.library.registry import LIBRARY
from psfcore.gap.view import View
from tests.gap_files import EDGE_GLOW as GLOW
from tests.psfcore.gap.small_gaps import found


def written(folder: Path, text: str = GLOW, name: str = "mine.py") -> str:
    path = folder / name
    path.write_text(dedent(text))
    return str(path)


def one_of(source: str) -> Effect:
    (added,) = added_effects([source])
    return added.effects[0]


def test_the_effects_of_a_file_follow_the_library_and_have_its_hash(tmp_path: Path) -> None:
    source = written(tmp_path)
    (added,) = added_effects([source])
    assert [effect.name for effect in library_with([added])] == [*(e.name for e in LIBRARY), "edge_glow"]
    assert added.source == source
    assert added.sha256 == hashlib.sha256(Path(source).read_bytes()).hexdigest() == sha256_of_source(source)
    assert library_with([]) == LIBRARY


def test_the_discs_show_an_added_effect(tmp_path: Path) -> None:
    evidence = gather(found().solution, [one_of(written(tmp_path))])
    (column,) = evidence.columns["edge_glow"]
    by_place = sorted(
        (evidence.image_info[d.index].x_px, float(d.share @ d.jacobian[column])) for d in evidence.discs
    )
    assert by_place[-1][1] > 3 * abs(by_place[0][1])  # strongest at the right


def test_a_module_also_works_and_a_changed_file_is_reloaded(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    written(tmp_path, name="my_effects_module.py")
    monkeypatch.syspath_prepend(tmp_path)
    assert one_of("my_effects_module").name == "edge_glow"
    assert sha256_of_source("my_effects_module") == added_effects(["my_effects_module"])[0].sha256
    written(tmp_path, GLOW.replace("edge_glow", "module_glow"), name="my_effects_module.py")
    assert one_of("my_effects_module").name == "module_glow", (
        "the module must be reloaded although it was imported before"
    )
    monkeypatch.delitem(sys.modules, "my_effects_module")
    source = written(tmp_path)
    assert one_of(source).name == "edge_glow"
    written(tmp_path, GLOW.replace("edge_glow", "rim_glow"))
    assert one_of(source).name == "rim_glow"


def test_a_file_may_define_dataclasses(tmp_path: Path) -> None:
    text = "from __future__ import annotations\nfrom dataclasses import dataclass, KW_ONLY\n"
    text += GLOW + "\n@dataclass\nclass Lamp:\n    _: KW_ONLY\n    watts: float = 1.0\n"
    assert one_of(written(tmp_path, text)).name == "edge_glow"


def test_the_examples_of_the_documentation_work(tmp_path: Path) -> None:
    assert gap.__doc__ is not None
    indented = [line[4:] for line in gap.__doc__.splitlines() if line.startswith("    ")]
    page = (Path(__file__).parents[4] / "docs" / "gap.md").read_text("utf-8")
    (in_readme,) = (code for code in re.findall(r"```python\n(.*?)```", page, re.S) if "EFFECTS" in code)
    for example in ("\n".join(indented), in_readme):
        assert one_of(written(tmp_path, example)).name == "edge_glow"


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("", "expected EFFECTS to be a tuple of Effect; got no variable of this name"),
        ("EFFECTS = ()", "got an empty tuple or list"),
        ("EFFECTS = (1, 'a')", "got a tuple or list of int, str"),
        ("EFFECTS = 3", "got int"),
        ("EFFECTS = (", "SyntaxError"),
        ("import no_such_module_anywhere", "No module named 'no_such_module_anywhere' (line 1)"),
        ("x = 1\ny = x + z\n", "NameError: name 'z' is not defined (line 2)"),
        (GLOW.replace('"a dark exposure", ', ""), "missing 1 required positional argument"),
        (
            GLOW.replace("edge_glow", "edge glow"),
            "expected an effect name of letters, digits and _; got 'edge glow'",
        ),
        (GLOW.replace("edge_glow", "dark_offset"), "expected unique effect names; got 'dark_offset' twice"),
        (
            GLOW.replace('(EffectParameter("height", "DN/s", 5.0),)', "()"),
            "edge_glow: expected at least one parameter; got none",
        ),
    ],
)
def test_an_error_in_a_file_is_reported_with_its_name(tmp_path: Path, text: str, said: str) -> None:
    source = written(tmp_path, text)
    with pytest.raises(DataError) as caught:
        added_effects([source])
    assert caught.value.code == "bad-effects"
    assert said in caught.value.message and source in caught.value.message


def test_two_sources_must_not_define_the_same_name(tmp_path: Path) -> None:
    first, second = written(tmp_path), written(tmp_path, name="other.py")
    with pytest.raises(DataError, match="got 'edge_glow' twice") as caught:
        added_effects([first, second])
    assert "other.py" in caught.value.message


@pytest.mark.parametrize(
    "source", ["nowhere.py", "no_such_module_anywhere", "no_such.module", "sys", "..relative", ""]
)
def test_a_missing_source_is_reported(source: str) -> None:
    with pytest.raises(DataError, match=f"effects of {source}") as caught:
        added_effects([source])
    assert caught.value.code == "bad-effects"


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (
            "lambda n, images: plane[1:]",
            "edge_glow: expected an image of shape (96, 96) [y, x]; got an array of shape (95, 96)",
        ),
        ("lambda n, images: plane * np.nan", "got an image with NaN or infinite values"),
        ("lambda n, images: plane / nothing", "NameError: name 'nothing' is not defined (line 8)"),
    ],
)
def test_a_change_that_is_not_an_image_is_reported_when_it_is_computed(
    tmp_path: Path, change: str, said: str
) -> None:
    effect = one_of(written(tmp_path, GLOW.replace("lambda n, images: plane", change)))
    view = View(found().solution)
    (made,) = effect.changes(view)
    with pytest.raises(DataError) as caught:
        made.change(0, view.expected)
    assert caught.value.code == "bad-effects" and said in caught.value.message


def test_every_parameter_needs_a_change(tmp_path: Path) -> None:
    text = GLOW.replace("unocculted=False)]", "unocculted=False)] * 2")
    with pytest.raises(
        DataError, match="edge_glow: expected 1 Change, one per parameter; got 2 of type Change"
    ):
        one_of(written(tmp_path, text)).changes(View(found().solution))


def test_why_not_and_held_of_an_added_effect_are_checked_too(tmp_path: Path) -> None:
    text = GLOW.replace("glow),)", "glow, lambda view: 1 / 0, held=lambda view: EFFECTS[0]),)")
    effect, view = one_of(written(tmp_path, text)), View(found().solution)
    with pytest.raises(DataError, match="ZeroDivisionError"):
        effect.why_not(view)
    assert effect.held is not None
    (made,) = effect.held(view).changes(view)
    np.testing.assert_array_equal(made.change(0, view.expected)[0], made.change(3, view.expected)[9])
