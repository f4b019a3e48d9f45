"""Options without effect are refused before anything is read, with a remedy."""

from __future__ import annotations

import pytest
from support.commands import MOUNTED

IGNORED = [
    ("fit c --no-sample --max-minutes 3", "--max-minutes is for a sampler"),
    ("fit c --no-sample --resume", "--resume continues a chain"),
    ("report c --laboratory A --country MX", "--country is for a certificate"),
    ("calibrate c --quick --no-sample", "--quick is for a sampler"),
    ("compare a b --by regions", "--by is for one campaign"),
    ("compare c --by positions --seed 3", "--seed is for steps and regions"),
    ("compare a b --seed 3", "--seed is for one campaign"),
    ("compare a b --by steps --seed 0", "--by and --seed are for one campaign"),
    ("locate c --points p.csv --pan-approach right", "--pan-approach is for one point"),
    ("locate c --points p.csv --tilt-approach up", "--tilt-approach is for one point"),
    ("locate c --points p.csv --budget", "--budget is for one point"),
    ("steps-for c --export header --pan-approach left", "--pan-approach is for one target"),
    ("steps-for c --export json --rig r.toml", "--rig is for one target"),
    ("study r.toml p.csv --workers 4", "--workers is for engines with workers"),
    ("study r.toml p.csv --scheduler tcp://a:1", "--scheduler is for engines with workers"),
    ("study r.toml p.csv --engine processes --scheduler tcp://a:1", "--scheduler is for the engine dask"),
    ("study r.toml p.csv --engine dask --scheduler tcp://a:1 --workers 4", "--workers is for a cluster"),
    ("plan c --watch --confirm 1e-4", "--confirm is for targets"),
    ("check c p.csv --repair-to d", "a repaired journal takes no plan"),
    ("stereo f --board 9x6 --pitch-mm 25 --image-size 1280x720", "--image-size is for --import"),
    ("stereo f --board 9x6 --pitch-mm 25 --import-unit m", "--import-unit is for --import"),
    ("stereo f --board 9x6 --pitch-mm 25 --rms-px 0.2 --joint", "--joint and --rms-px are for --import"),
    ("stereo --import a.yml --finder sector --swap", "--finder and --swap are for pictures"),
    ("stereo --import a.yml --fix-k3 --robust", "--fix-k3 and --robust are for pictures"),
    ("acquire r.toml p.csv o --centroids", "--centroids is for the twin"),
    ("acquire r.toml p.csv o --emulate", "--emulate is for the twin"),
    ("acquire r.toml p.csv o --seed 0", "--seed is for the twin"),
    ("acquire r.toml p.csv o --simulate --port 8000", "--port is for --live"),
    ("acquire r.toml p.csv o --simulate --no-browser", "--no-browser is for --live"),
    ("acquire r.toml p.csv o --simulate --laser-class 3B", "--laser-class is for a laser"),
    ("acquire r.toml p.csv o --target-u 1e-4 --no-estimate", "--target-u needs the fits"),
    ("import t.csv --to o --run 1 --deviations", "--run and --deviations are for files of an axis"),
    ("import t.csv --to o --assume u_deg=1", "--assume is for a guide log or sightings"),
    ("import t.csv --to o --axis --sightings", "--sightings is for a head"),
    ("import t.csv --to o --axis --tilt-approach up", "--tilt-approach is for a scanner"),
    ("import t.csv --to o --sightings --swap", "--swap is for spots in pictures"),
    ("import t.urdf --to o --urdf --assume u_deg=1 --format phd2", "--format and --assume are for other tables"),
    ("import t.dat --to o --format pointing --pixels-from 1", "--pixels-from is for other tables"),
    ("import t.dat --to o --format pointing --tilt-joint a", "--tilt-joint is for a URDF"),
    ("import . --to o --swap --run 1 --urdf", "--run and --urdf are for tables of other programs"),
]


@pytest.mark.parametrize(("line", "message"), IGNORED, ids=[line for line, _ in IGNORED])
def test_options_without_effect_are_refused(ask, line, message):
    code, document = ask(*line.split())
    assert (code, document["error"]["code"]) == (2, "usage")
    assert document["error"]["message"].startswith(message) and document["error"]["remedy"]


def test_a_unit_is_for_files_that_state_none(ask):
    """Files of other programs leave the unit of T open; that of ours is stated."""
    pair = MOUNTED / "stereo.json"
    for option in (("--import-unit", "m"), ("--image-size", "1280x720")):
        code, document = ask("stereo", "--import", pair, *option)
        assert (code, document["error"]["code"]) == (2, "usage") and "other programs" in document["error"]["message"]
    assert ask("stereo", "--import", pair)[0] == 0


@pytest.mark.parametrize(
    ("line", "option"),
    [
        *(("report c --limit-mm inf", "--limit-mm"), ("report c --limit-deg-per-step inf", "--limit-deg-per-step")),
        *(("report c --range-mm inf", "--range-mm"), ("calibrate c --limit-mm inf", "--limit-mm")),
        *(("plan c --watch --minutes inf", "--minutes"), ("plan r --given c --next 3 --confirm inf", "--confirm")),
        *(("plan --given c --minutes inf", "--minutes"), ("fit c --max-minutes inf", "--max-minutes")),
        ("acquire r.toml p.csv o --simulate --target-u inf", "--target-u"),
        ("acquire r.toml p.csv o --simulate --target-u 1e-4 --adapt --minutes inf", "--minutes"),
    ],
)
def test_infinity_is_refused_before_anything_is_read(ask, line, option):
    """JSON cannot hold it, so the document could not be written."""
    code, document = ask(*line.split())
    assert (code, document["error"]["code"], document["error"]["column"]) == (2, "number", option)


AXIS = [
    ("--next 3", "--next is for a scanner"),
    ("--criterion D", "--criterion is for a scanner"),
    ("--draws 100", "--draws is for a scanner"),
    ("--confirm 1e-4 --aperture", "--aperture and --confirm are for a scanner"),
]


@pytest.mark.parametrize(("options", "message"), AXIS, ids=[options for options, _ in AXIS])
def test_an_axis_is_planned_with_its_own_options(ask, tmp_path, options, message):
    (tmp_path / "campaign.toml").write_text('format = "tvsbayes-axis/1"\n')
    code, document = ask("plan", "--given", tmp_path, *options.split())
    assert (code, document["error"]["code"]) == (2, "usage") and document["error"]["message"].startswith(message)
