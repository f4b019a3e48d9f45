"""Foreign files of an axis: each is read by one command with the correct result, or refused with a remedy.

Files in tests/data/foreign have observed layouts and invented numbers; the test writes the others.
"""

from __future__ import annotations

import numpy as np
import pytest
from importing.samples import FOREIGN, guide_log
from support.commands import assert_error

from tvsbayes.single_axis.axis_campaign import read_axis
from tvsbayes.single_axis.axis_rows import rows_of
from tvsbayes.single_axis.classic_line import classic_axis


@pytest.mark.parametrize(
    ("file", "ratio", "play", "unit", "remark"),
    [
        # Truths and the scatter of stops of each file: its README in the layouts' collection.
        ("counts_wrap/log.csv", 1.024, 5.7, "counts", "whole turns 8 times, which are added: 4096 counts each"),
        ("direction_signs/log.csv", None, None, "mm", "u: none"),
        ("error_column_as_u/log.csv", 1.010, 0.08, "deg", "Error (deg) is Actual (deg) - Target (deg) in every row"),
        ("error_column_as_u/signed.csv", 1.010, 0.08, "deg", "a deviation, no uncertainty; set aside"),
        ("wide_forward_backward/dial.csv", 1.0012, 0.035, "mm", "runs: 4 columns"),
    ],
)
def test_observed_file_layouts(ask, tmp_path, file, ratio, play, unit, remark):
    out = tmp_path / "out"
    code, document = ask("import", FOREIGN / file, "--axis", "--to", out, "--yes")
    campaign = read_axis(out)
    rows = rows_of(campaign)
    line = classic_axis(rows)
    assert code == 0 and campaign.unit == unit and any(remark in text for text in document["assumed"])
    if ratio is not None:
        assert abs(line.per_command - ratio) < 4 * line.u_per_command
        assert abs(abs(line.backlash) - play) < 4 * line.u_backlash
    assert rows.both_sides and {reading.u for reading in campaign.readings} == {0.0}


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("by", ["position", "run", "column"])
def test_sides_of_a_compensated_axis_are_those_of_the_sheet(ask, tmp_path, by, seed):
    """Readings that barely differ from the targets, some of them alike, say nothing of sides; the sheet does."""
    rng, targets = np.random.default_rng(seed), [0, 20, 40, 60, 80]
    ways = [(t, side) for side in ("forward", "backward") for t in targets[:: 1 if side == "forward" else -1]]
    read = {way: f"{way[0] + rng.normal(0, 0.001):.3f}" for way in ways}
    order = sorted(ways, key=lambda way: way[0]) if by == "position" else ways
    rows = ["target (mm),direction,measured (mm)", *(f"{t},{side},{read[t, side]}" for t, side in order)]
    if by == "column":
        rows = [
            "target (mm),forward (mm),backward (mm)",
            *(f"{t},{read[t, ways[0][1]]},{read[t, ways[-1][1]]}" for t in targets),
        ]
    (tmp_path / "sheet.csv").write_text("\n".join(rows))
    assert ask("import", tmp_path / "sheet.csv", "--axis", "--to", tmp_path / "out", "--yes")[0] == 0
    campaign = read_axis(tmp_path / "out")
    arrived, before = {}, None
    for move in campaign.moves:
        rises = move.approach or ("forward" if before is None or move.command > before else "backward")
        arrived[move.move], before = (move.command, rises), move.command
    found = sorted((*arrived[reading.move], reading.value) for reading in campaign.readings)
    assert found == sorted((t, side, float(value)) for (t, side), value in read.items())


def test_a_guide_log_is_listed_and_one_run_taken(ask, say, tmp_path):
    """`--yes` without a run does not select the first of several."""
    file, out = tmp_path / "PHD2_GuideLog.txt", tmp_path / "out"
    file.write_text(guide_log(20) + "\n" + guide_log(300))
    code, document = ask("import", file, "--axis", "--to", out)
    assert code == 0 and [run["frames"] for run in document["runs"]] == [19, 299] and document["files"] == []
    assert (
        f"next: `tvsbayes import {file} --axis --run 2 --to {out} --yes`"
        in say("import", file, "--axis", "--to", out)[1]
    )
    code, document = ask("import", file, "--axis", "--to", out, "--yes")
    assert code == 2 and "--run 2" in assert_error(document, "usage")["remedy"] and not out.exists()
    code, document = ask("import", file, "--axis", "--to", out, "--yes", "--run", 2)
    assert (code, document["readings"], document["moves"]) == (0, 299, 1)
    toml = (out / "campaign.toml").read_text()
    assert "period_between = [60.0, 298.0]" in toml and 'periods_in = "seconds"' in toml and "rate = 15.04" in toml
    assert "campaign.toml: period_between = [60.0, 298.0]" in document["assumed"]
