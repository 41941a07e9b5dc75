"""The tree of causes: every effect and field has its family, and data have only the fields that they can show."""

from __future__ import annotations

from dataclasses import replace

from psfcore.gap.evidence.tree import FAMILIES, STAGES, Field, family_of, fields_of
from psfcore.gap.library.registry import LIBRARY

ALL = fields_of((1, 2), exposures=True, kinds=True)


def test_every_effect_and_field_has_a_family_of_its_stage() -> None:
    stages, families = ({one.name: getattr(one, what) for one in LIBRARY} for what in ("stage", "family"))
    for name, family in families.items():
        assert FAMILIES[family].stage == stages[name], name
        assert set(FAMILIES[family].axes) & {a for one in LIBRARY if one.name == name for a in one.axes}, name
    used = {field.family for field in ALL} | set(families.values())
    assert all(FAMILIES[one].words and FAMILIES[one].settled_by and FAMILIES[one].axes for one in used)
    # The other families are those of added effects that state none.
    ghost = next(one for one in LIBRARY if one.name == "ghost")
    added = [family_of(replace(ghost, stage=stage, family="")) for stage in STAGES]
    assert sorted(set(FAMILIES) - used) == sorted(added) and family_of(ghost) == "ghost"
    assert [FAMILIES[one].stage for one in added] == list(STAGES)


def test_data_have_only_the_fields_that_they_can_show() -> None:
    assert len(set(ALL)) == len(ALL)
    rows = [
        ((1,), True, True, ["light_pointing"]),
        ((1, 2), False, True, ["offset_place", "offset_place_time", "offset_time"]),
        ((1, 2), True, False, ["gain_kind"]),
    ]
    for pointings, exposures, kinds, missing in rows:
        found = fields_of(pointings, exposures=exposures, kinds=kinds)
        assert sorted({one.family for one in ALL} - {one.family for one in found}) == missing
        of_pointings = {one.pointing for one in found if one.operator == "outside"}
        assert of_pointings == ({None} if len(pointings) == 1 else {None, *pointings})


def test_the_unocculted_field_shows_what_differs_between_images_of_a_pointing() -> None:
    hidden = {field.family for field in ALL if not field.in_blocks}
    shown = {field.family for field in ALL if field.in_blocks}
    assert hidden & shown == set()
    assert {"light_time", "psf_time", "psf_place_time", "gain_kind", "offset_place"} <= shown
    assert {"light_place", "psf", "psf_place", "gain_place", "edge", "edge_time", "outside"} <= hidden
    assert Field("light_place", "light", "place", 0.2).everywhere
    assert not Field("light_place", "light", "place", 0.1).everywhere
