"""Command lines that are refused: exit code 2, the kind of mistake, what is said; nothing is written."""

from __future__ import annotations

import shlex

import pytest
from support.axes import drawn, runs
from support.commands import MOUNTED, PAPER_TWIN, assert_error
from support.compensated import results

from tvsbayes.single_axis.axis_record import keep_fit

RIG, PLAN = MOUNTED / "rig.toml", MOUNTED / "grid.csv"
LOOKS = "Nr;Pan;Tilt;XL;YL;XR;YR;Blatt\n1;0;0;640,5;360,25;500;360;nah\n"


@pytest.fixture(scope="module")
def folders(tmp_path_factory) -> dict[str, str]:
    """What stands in the lines for folders and files: an axis, another with its fit, a table of looks."""
    place = tmp_path_factory.mktemp("folders")
    drawn(7, runs(2)).write(place / "axis")
    drawn(7, runs(2)).write(place / "stage")
    keep_fit(results().fit, results().summary, place / "stage" / "results")
    (place / "looks.csv").write_text(LOOKS)
    words = {"AXIS": place / "axis", "STAGE": place / "stage", "LOOKS": place / "looks.csv", "OUT": place / "out"}
    return {name: str(path) for name, path in {**words, "TWIN": PAPER_TWIN, "RIG": RIG, "PLAN": PLAN}.items()}


# (command line, code, part of what is said)
REFUSED = (
    # Options without effect, before anything is read.
    ("fit c --no-sample --max-minutes 3", "usage", "--max-minutes is for a sampler"),
    ("fit c --no-sample --resume", "usage", "--resume continues a chain"),
    ("report c --laboratory A --country MX", "usage", "--country is for a certificate"),
    ("calibrate c --quick --no-sample", "usage", "--quick is for a sampler"),
    ("compare a b --by regions", "usage", "--by is for one campaign"),
    ("compare c --by positions --seed 3", "usage", "--seed is for steps and regions"),
    ("compare a b --seed 3", "usage", "--seed is for one campaign"),
    ("compare a b --by steps --seed 0", "usage", "--by and --seed are for one campaign"),
    ("locate c --points p.csv --pan-approach right", "usage", "--pan-approach is for one point"),
    ("locate c --points p.csv --tilt-approach up", "usage", "--tilt-approach is for one point"),
    ("locate c --points p.csv --budget", "usage", "--budget is for one point"),
    ("steps-for c --export header --pan-approach left", "usage", "--pan-approach is for one target"),
    ("steps-for c --export json --rig r.toml", "usage", "--rig is for one target"),
    ("study r.toml p.csv --workers 4", "usage", "--workers is for engines with workers"),
    ("study r.toml p.csv --scheduler tcp://a:1", "usage", "--scheduler is for engines with workers"),
    ("study r.toml p.csv --engine processes --scheduler tcp://a:1", "usage", "--scheduler is for the engine dask"),
    ("study r.toml p.csv --engine dask --scheduler tcp://a:1 --workers 4", "usage", "--workers is for a cluster"),
    ("plan c --watch --confirm 1e-4", "usage", "--confirm is for targets"),
    ("check c p.csv --repair-to d", "usage", "a repaired journal takes no plan"),
    ("stereo f --board 9x6 --pitch-mm 25 --image-size 1280x720", "usage", "--image-size is for --import"),
    ("stereo f --board 9x6 --pitch-mm 25 --import-unit m", "usage", "--import-unit is for --import"),
    ("stereo f --board 9x6 --pitch-mm 25 --rms-px 0.2 --joint", "usage", "--joint and --rms-px are for --import"),
    ("stereo --import a.yml --finder sector --swap", "usage", "--finder and --swap are for pictures"),
    ("stereo --import a.yml --fix-k3 --robust", "usage", "--fix-k3 and --robust are for pictures"),
    ("acquire r.toml p.csv o --centroids", "usage", "--centroids is for the twin"),
    ("acquire r.toml p.csv o --seed 0", "usage", "--seed is for the twin"),
    ("acquire r.toml p.csv o --simulate --port 8000", "usage", "--port is for --live"),
    ("acquire r.toml p.csv o --simulate --no-browser", "usage", "--no-browser is for --live"),
    ("acquire r.toml p.csv o --simulate --laser-class 3B", "usage", "--laser-class is for a laser"),
    ("acquire r.toml p.csv o --target-u 1e-4 --no-estimate", "usage", "--target-u needs the fits"),
    ("import t.csv --to o --run 1 --deviations", "usage", "--run and --deviations are for files of an axis"),
    ("import t.csv --to o --assume u_deg=1", "usage", "--assume is for a guide log or sightings"),
    ("import t.csv --to o --axis --sightings", "usage", "--sightings is for a head"),
    ("import t.csv --to o --axis --tilt-approach up", "usage", "--tilt-approach is for a scanner"),
    ("import t.csv --to o --sightings --swap", "usage", "--swap is for spots in pictures"),
    ("import t.urdf --to o --urdf --assume u_deg=1 --format phd2", "usage", "--format and --assume are for other"),
    ("import t.dat --to o --format pointing --pixels-from 1", "usage", "--pixels-from is for other tables"),
    ("import t.dat --to o --format pointing --tilt-joint a", "usage", "--tilt-joint is for a URDF"),
    ("import . --to o --swap --run 1 --urdf", "usage", "--run and --urdf are for tables of other programs"),
    ("steps-for c --export header --x-mm 1 --y-mm 2 --z-mm 3", "usage", "--x-mm and --y-mm and --z-mm are"),
    ("steps-for c --export json --azimuth-deg 3", "usage", "--azimuth-deg is"),
    ("steps-for c --x-mm 700 --y-mm 2 --z-mm 3 --out c.h", "usage", "--out is"),
    ("report c --dcc --laboratory ' '", "usage", "leave the option out"),
    ("report c --dcc --customer-country ' '", "usage", "leave the option out"),
    ("report c -o mine.pdf --pdf", "usage", "write -o NAME.html --pdf"),
    ("report c -o mine.PDF --pdf", "usage", "write -o NAME.html --pdf"),
    # Infinity, which JSON cannot hold.
    ("report c --limit-mm inf", "number", "--limit-mm"),
    ("report c --limit-deg-per-step inf", "number", "--limit-deg-per-step"),
    ("report c --range-mm inf", "number", "--range-mm"),
    ("calibrate c --limit-mm inf", "number", "--limit-mm"),
    ("plan c --watch --minutes inf", "number", "--minutes"),
    ("plan r --given c --next 3 --confirm inf", "number", "--confirm"),
    ("plan --given c --minutes inf", "number", "--minutes"),
    ("fit c --max-minutes inf", "number", "--max-minutes"),
    ("acquire r.toml p.csv o --simulate --target-u inf", "number", "--target-u"),
    ("acquire r.toml p.csv o --simulate --target-u 1e-4 --adapt --minutes inf", "number", "--minutes"),
    # Lines that no command understands, and what is not there.
    ("fit x --nope", "usage", "--nope"),
    ("frobnicate", "usage", "frobnicate"),
    ("classic", "usage", "CAMPAIGN"),
    ("simulate a b c --seed -1", "usage", "--seed"),
    ("simulate a b c --seed many", "usage", "--seed"),
    ("report TWIN --limit-mm 0,0004", "usage", "write a decimal point: 0.0004"),
    ("report TWIN --limit-mm -1,5", "usage", "write a decimal point: -1.5"),
    ("report TWIN --limit-mm many", "usage", "see tvsbayes --help"),
    ("check nowhere", "missing-file", "nowhere"),
    ("classic nowhere", "missing-file", "nowhere"),
    ("fit nowhere", "missing-file", "nowhere"),
    # One target, one point, whole.
    ("steps-for TWIN", "usage", "--azimuth-deg"),
    ("steps-for TWIN --x-mm 1 --y-mm 2", "usage", "--z-mm"),
    ("steps-for TWIN --azimuth-deg 1", "usage", "--elevation-deg"),
    ("steps-for TWIN --export xml", "usage", "--export"),
    ("locate TWIN", "usage", "--points"),
    ("locate TWIN --pan-steps 100", "usage", "--tilt-steps"),
    ("locate TWIN --pan-steps 1 --tilt-steps 2 --aperture-deg 70 --points x.csv", "usage", "--points"),
    ("locate TWIN --pan-steps 1 --tilt-steps 2 --aperture-deg 70 --pan-approach up", "approach", "left"),
    ("locate TWIN --pan-steps 1 --tilt-steps 2 --aperture-deg 70 --cloud c.ply", "usage", "--points"),
    ("locate TWIN --points LOOKS --cloud c.xyz", "usage", ".ply"),
    ("plan RIG --draws 20 --target 'u(left) <= 1 mm'", "target", "deg/step"),
    ("plan RIG --draws 20 --criterion E", "criterion", "--criterion"),
    ("compensate TWIN --to csv", "usage", "--to header"),
    ("plan --verify", "usage", "plan FOLDER --verify"),
    ("verify TWIN AXIS", "usage", "of the same kind of machine"),
    ("verify AXIS TWIN", "usage", "of the same kind of machine"),
    ("verify AXIS AXIS --distance-mm 500", "usage", "--distance-mm"),
    # What an axis lacks.
    ("fit AXIS --robust", "usage", "--robust"),
    ("fit AXIS --no-sample --quick", "usage", "--quick"),
    ("compare AXIS --by steps", "usage", "positions"),
    ("report AXIS --limit-mm 1", "usage", "scanner"),
    ("plan --given AXIS --target speed", "target", "speed"),
    ("plan AXIS", "usage", "--given"),
    ("plan --given AXIS --next 3", "usage", "--next is for a scanner"),
    ("plan --given AXIS --criterion D", "usage", "--criterion is for a scanner"),
    ("plan --given AXIS --draws 100", "usage", "--draws is for a scanner"),
    ("plan --given AXIS --confirm 1e-4 --aperture", "usage", "--aperture and --confirm are for a scanner"),
    ("simulate AXIS OUT --frames", "usage", "--frames"),
    ("locate AXIS --pan-steps 1 --tilt-steps 1 --aperture-deg 60", "usage", "is an axis folder"),
    ("steps-for AXIS --x-mm 1 --y-mm 1 --z-mm 1", "usage", "is an axis folder"),
    ("detect AXIS", "usage", "is an axis folder"),
    ("export AXIS --nexus OUT", "usage", "is an axis folder"),
    ("view AXIS", "usage", "not an axis"),
    # A tolerance, a signature, a table.
    ("report AXIS --tolerance 15um", "usage", "--of"),
    ("report AXIS --tolerance 15um --of Q", "usage", "a forward"),
    ("report AXIS --tolerance 15kg --of A", "usage", "15um"),
    ("report AXIS --tolerance -1 --of A", "usage", "above 0"),
    ("report AXIS --of A", "usage", "--tolerance"),
    ("report AXIS --tolerance 15um --of A --rule strict", "usage", "guarded"),
    ("report AXIS --tolerance 15um --of A --rule simple --guard 2", "usage", "guarded"),
    ("report AXIS --sign key.pem", "usage", "--dcc"),
    ("report AXIS --dcc --sign key.pem", "usage", "--certificate"),
    ("compensate STAGE --to csv --resolution 0,01", "usage", "0.01"),
    ("compensate STAGE --to csv --applied-by me", "usage", "host"),
    ("compensate STAGE --to grbl --in-force 250 --letter Q", "usage", "--letter"),
    # What a table is asked for.
    ("import LOOKS --to OUT --angles furlong", "usage", "deg, rad"),
    ("import LOOKS --to OUT --column XL", "usage", "u_left_px=XL"),
    ("import LOOKS --to OUT --column uleft=XL", "usage", "u_left_px"),
    ("import LOOKS --to OUT --column u_left_px=X", "usage", "did you mean XR"),
    ("import LOOKS --to OUT --pan-approach up", "approach", "left, right"),
    ("import LOOKS --to OUT --sheet one", "usage", "no sheets"),
)


@pytest.mark.parametrize(("line", "code", "said"), REFUSED, ids=[row[0] for row in REFUSED])
def test_a_line_is_refused_with_what_to_do(ask, folders, tmp_path, monkeypatch, line, code, said):
    monkeypatch.chdir(tmp_path)
    exit_code, document = ask(*(folders.get(word, word) for word in shlex.split(line)))
    error = assert_error(document, code)
    assert (exit_code, set(document)) == (2, {"error"})
    assert list(tmp_path.iterdir()) == []
    parts = (error["message"], error["remedy"], error["column"], error["allowed"], error["found"])
    assert any(said in str(part) for part in parts), error
