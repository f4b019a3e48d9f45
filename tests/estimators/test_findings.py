"""Findings: which stop a fit, what they say, and the command that mends a campaign."""

from __future__ import annotations

import shlex
from dataclasses import replace
from pathlib import Path

import pytest

from tvsbayes.errors import InputError
from tvsbayes.estimators.findings import Finding, mending_command, stop_at
from tvsbayes.files.disk import shipped_data
from tvsbayes.instrument.campaign import read_campaign

DOUBT = Finding("units", "is it in metres?")
SIGN = Finding("counter-sign", "spots move right", "flip it", True, "moves.csv", 7)


def test_what_is_certain_stops_with_where_and_what_to_do():
    swapped = Finding("cameras-swapped", "left is right", "exchange them", True, "spots.csv", 2)
    with pytest.raises(InputError) as caught:
        stop_at([DOUBT, SIGN, swapped], "--anyway goes on")
    error = caught.value
    assert (error.code, error.exit_code, error.file, error.line) == ("counter-sign", 2, "moves.csv", 7)
    assert error.message == "spots move right; left is right"
    assert error.remedy == "flip it; exchange them; --anyway goes on"


@pytest.mark.parametrize(
    ("path", "to"), [("runs/a b", "runs/a b-mended"), ("mine/", "mine-mended"), (".", "../{}-mended")]
)
def test_the_command_can_be_typed_as_it_stands(path, to):
    campaign = replace(read_campaign(shipped_data() / "twins" / "grid_twin"), path=Path(path))
    words = shlex.split(mending_command(campaign, "--flip pan_steps").strip("`"))
    assert words[:3] == ["tvsbayes", "import", str(Path(path))]
    assert words[3:] == ["--to", to.format(Path.cwd().name), "--flip", "pan_steps", "--yes"]
    assert "CAMPAIGN" in mending_command(replace(campaign, path=None), "--swap")
