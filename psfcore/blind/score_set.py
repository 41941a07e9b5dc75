"""Score a diagnosed blind set: open its seals, compare reports and truths, and write the score into the folder of the set."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence

from psfcore.blind.case_set import BlindSet
from psfcore.blind.plot import score_png
from psfcore.blind.run_set import judged_cases
from psfcore.blind.score_table import score, table


def write_score(made: BlindSet, numbers: Sequence[int], not_made: Mapping[int, str]) -> str:
    """Write score.json, score.txt and score.png into the folder of the set; return the table as text.

    numbers: the cases to score. not_made: the reason for each case that could not be made.
    """
    judged, failures = judged_cases(made, numbers)
    found = score(judged, dict(not_made) | failures)
    text = table(found)
    (made.folder / "score.json").write_text(json.dumps(found.to_json(), indent=1, allow_nan=False), "utf-8")
    (made.folder / "score.txt").write_text(text + "\n", "utf-8")
    score_png(found, made.folder / "score.png")
    return text
