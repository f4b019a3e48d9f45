"""A head with a known fit: corrected model, verification and watch of fresh looks, next looks."""

from __future__ import annotations

import json
import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import yaml
from support.commands import assert_error

from tvsbayes.calibration.states import ZERO_NAMES, total_shift
from tvsbayes.estimators.joint_fit import fit
from tvsbayes.importing.urdf import head_joints
from tvsbayes.instrument.axes import AXES
from tvsbayes.instrument.campaign import read_campaign, write_campaign
from tvsbayes.instrument.mechanisms import SIGHTING_HEAD
from tvsbayes.instrument.parameters import Prior, names_of
from tvsbayes.instrument.plan import PlanBuilder, PlanStep, read_plan
from tvsbayes.instrument.rig import Rig, RigTable
from tvsbayes.pipeline import calibrate, load_calibration
from tvsbayes.planning.expectation import information_of, prior_knowledge
from tvsbayes.posterior.transport import transport
from tvsbayes.statistics.optimal_design import covariance_of
from tvsbayes.twin.head_physics import head_beam
from tvsbayes.twin.simulated_campaign import simulate
from tvsbayes.twin.true_rig import Truth

pytestmark = pytest.mark.thorough

UNIT = (Path(__file__).parent / "unit.urdf").read_bytes()
RATIO = 0.045
PLACES = [(pan, tilt) for pan in (-1500, -500, 600, 1400) for tilt in (-300, 200, 700, 1200)]


def head_rig() -> Rig:
    """A head of 0.045 deg a step with an error of a hundredth of it, and sightings of 0.005 deg."""
    ratios = dict.fromkeys(names_of("degrees_per_step"), Prior(RATIO, 0.01 * RATIO))
    nominal = head_joints(UNIT, "unit.urdf", {"pan": None, "tilt": None}).terms
    terms = {name: Prior(value, 0.3) for name, value in nominal.items() if name in SIGHTING_HEAD.parameters}
    table = RigTable({**ratios, **terms}, mechanism=SIGHTING_HEAD)
    costs = {"move_s": 1.5, "look_s": 1.0}
    return Rig(table, None, dict(table.priors), {}, {}, {"sighting_sd_deg": 0.005}, costs)


def rounds() -> tuple[PlanStep, ...]:
    """Every place twice, in two orders."""
    rng, plan = np.random.default_rng(7), PlanBuilder()
    plan.home()
    for _ in range(2):
        for place in rng.permutation(len(PLACES)).tolist():
            plan.move(*PLACES[place])
            plan.look()
    return tuple(plan.steps)


@pytest.fixture(scope="module")
def known_head(tmp_path_factory):
    """Folder of a campaign with accepted results, its model beside it; and the true head."""
    folder = tmp_path_factory.mktemp("head")
    simulated = simulate(head_rig(), rounds(), 11)
    header = {"urdf": {"pan_joint": "pan_joint", "tilt_joint": "tilt_joint", "steps_per_turn": 400.0}}
    simulated.campaign.header.update(header)
    simulated.write(folder)
    (folder / "head.urdf").write_bytes(UNIT)
    results = calibrate(simulated.campaign, folder / "results", tier="importance")
    assert results.record.summary.answer == "accepted"
    return folder, simulated.truth


def test_the_map_exists_at_scales_far_from_the_mode(known_head):
    """Sightings far better than stated leave only their scatter."""
    path = transport(fit(read_campaign(known_head[0])))
    noise = 6 * np.random.default_rng(0).standard_t(4, size=(768, path.noise))
    assert np.all(np.isfinite(path.conditional(noise).factor))


def test_truth_is_read_back_with_the_constants_that_a_head_leaves_out():
    run = simulate(head_rig(), rounds(), 3)
    document = json.loads(json.dumps(run.truth.as_json(run.campaign), allow_nan=False))
    again = Truth.from_json(document, None)
    assert again.parameters == run.truth.parameters and again.parameters.keys() > document["parameters"].keys()
    assert again.effective_deg_per_step(run.campaign) == pytest.approx(document["effective_deg_per_step"], rel=1e-12)


def fresh(truth, steps, folder, seed=5, counters=lambda pan, tilt: (pan, tilt)):
    """Looks of the same head; without the correction its campaign has other counters than the motors got."""
    plan = [
        replace(step, **dict(zip(("pan_steps", "tilt_steps"), counters(step.pan_steps, step.tilt_steps), strict=True)))
        if step.action == "move"
        else step
        for step in steps
    ]
    campaign = simulate(head_rig(), plan, seed, truth).campaign
    stated = iter([step for step in steps if step.action in ("home", "move")])
    moves = tuple(
        replace(move, pan_steps=step.pan_steps or 0, tilt_steps=step.tilt_steps or 0)
        for move, step in zip(campaign.moves, stated, strict=True)
    )
    write_campaign(replace(campaign, moves=moves), folder)
    return folder


def direction(head, pan_deg, tilt_deg):
    """Azimuth and elevation, deg, by the twin's optics."""
    tilt = np.radians(tilt_deg + head["elevation_zero_deg"])
    _, beam = head_beam(np.radians(pan_deg), tilt, {"tangent_flexure_deg": 0.0, **head})
    return np.degrees([np.arctan2(beam[1], beam[0]), np.arcsin(beam[2])])


def test_a_model_is_corrected_and_marked(ask, known_head, tmp_path):
    folder, truth = known_head
    out = tmp_path / "new.urdf"
    code, document = ask("compensate", folder, "--to", "urdf", "-o", out)
    promise = str(folder / "results" / "compensation.json")
    assert code == 0 and document["files"] == {"urdf": str(out), "yaml": f"{out}.yaml", "compensation": promise}
    kept = yaml.safe_load((tmp_path / "new.urdf.yaml").read_text())
    u = dict(zip(kept["names"], np.sqrt(np.diag(kept["covariance"])), strict=True))
    terms = head_joints(out.read_bytes(), "new.urdf", dict.fromkeys(AXES)).terms
    # Zeros are those at the calibration's state, with the creep.
    true, state = dict(truth.parameters), load_calibration(folder).states["pan"]
    draws = {name: np.array([true[name]]) for name in ZERO_NAMES}
    true["azimuth_zero_deg"] += float(total_shift(draws, "pan", state)[0, 0])
    for name in ("azimuth_axis_tilt_deg.north", "axes_not_square_deg", "azimuth_zero_deg"):
        assert abs(terms[name] - true[name]) < 4 * u[name], name
    assert ask("compensate", folder, "--to", "urdf", "-o", out)[0] == 0, "a model of ours is replaced"
    for place in (folder / "head.urdf", tmp_path / "again.urdf"):
        (tmp_path / "again.urdf").write_bytes(UNIT)
        code, document = ask("compensate", folder, "--to", "urdf", "-o", place)
        assert (code, document["error"]["code"]) == (2, "occupied") and place.read_bytes() == UNIT
    again = tmp_path / "again"
    again.mkdir()
    for path in folder.rglob("*"):
        if path.is_file():
            place = again / path.relative_to(folder)
            place.parent.mkdir(exist_ok=True)
            place.write_bytes(path.read_bytes())
    (again / "head.urdf").write_bytes(out.read_bytes())
    assert_error(ask("compensate", again, "--to", "urdf")[1], "applied")
    # It is marked as ours, but this head is corrected from it.
    assert_error(ask("compensate", again, "--to", "urdf", "-o", again / "head.urdf")[1], "occupied")
    code, document = ask("compensate", folder, "--to", "csv")
    assert code == 2 and "--to urdf" in document["error"]["remedy"]


@pytest.mark.parametrize("applied", [True, False])
def test_fresh_looks_show_whether_the_calibration_is_applied(ask, known_head, tmp_path, applied):
    """Not applied: the motors get the counters of the nominal head for the directions that were meant."""
    folder, truth = known_head
    assert ask("plan", folder, "--verify", "-o", tmp_path / "plan.csv")[0] == 0
    steps = read_plan(tmp_path / "plan.csv", SIGHTING_HEAD)
    nominal, calibration = read_campaign(folder).rig.values, load_calibration(folder)

    def sent(pan, tilt):
        # The direction that the calibration gives these counters, at its state.
        x, y, z = calibration.beam_at((float(pan), float(tilt)), (0.0, 0.0), math).direction
        aim = np.degrees([np.arctan2(y, x), np.arcsin(z)])
        angles = np.zeros(2)
        for _ in range(10):
            angles += np.degrees(np.angle(np.exp(1j * np.radians(aim - direction(nominal, *angles)))))
        return tuple(np.round(angles / RATIO).astype(int).tolist())

    looks = fresh(truth, steps, tmp_path / "fresh", counters=(lambda *n: n) if applied else sent)
    code, document = ask("verify", folder, looks)
    assert (code, document["verdict"]) == ((0, "KEPT") if applied else (1, "BROKEN"))
    world = max(document["worlds"], key=document["worlds"].get)
    assert world == ("applied" if applied else "not applied") and "millimetres" not in document
    assert ask("verify", folder, looks, "--distance-mm", "500")[0] == 2


def test_the_moved_part_is_named(ask, say, known_head, tmp_path):
    folder, truth = known_head
    plan = rounds()
    code, document = ask("watch", folder, fresh(truth, plan, tmp_path / "still"))
    assert document["verdict"] != "MOVED" and {c["what"] for c in document["changes"]} >= {"base: lean", "play: tilt"}
    leaning = {**truth.parameters, "azimuth_axis_tilt_deg.east": truth.parameters["azimuth_axis_tilt_deg.east"] + 0.5}
    moved = fresh(replace(truth, parameters=leaning), plan, tmp_path / "leaning")
    code, document = ask("watch", folder, moved)
    assert (code, document["verdict"]) == (1, "MOVED")
    part = document["moved"][0]
    assert part["what"] == "base: lean to azimuth 90" and abs(part["value"] - 0.5) < 4 * part["u"]
    assert "fasten it" in say("watch", folder, moved)[1]


def test_plan_of_a_watch_needs_no_sheet(ask, known_head, tmp_path):
    folder, _ = known_head
    code, document = ask("plan", folder, "--watch", "--minutes", 3, "-o", tmp_path / "looks.csv")
    assert code == 0 and document["looks"] >= 4
    steps = read_plan(tmp_path / "looks.csv", SIGHTING_HEAD)
    assert {step.action for step in steps} == {"home", "move", "look"}


def test_a_plan_predicts_what_the_fit_reports(known_head):
    """The covariance expected of the plan that was run, beside that of its fit: within a third, with 32 looks."""
    folder, _ = known_head
    knowledge = prior_knowledge(head_rig())
    plan = rounds()
    expected = covariance_of(
        (
            known := knowledge.with_gears(np.array([(s.pan_steps, s.tilt_steps) for s in plan if s.action == "move"]))
        ).precision
        + information_of(plan, known).fisher
    )
    summary = json.loads((folder / "results" / "fit.json").read_text())["parameters"]
    names, space = head_rig().table.mechanism.names, known.space
    for name in ("azimuth_axis_tilt_deg.north", "axes_not_square_deg"):
        k = names.index(name)
        sd = float(np.sqrt(expected[k, k]) * np.asarray(space.u)[k])
        assert 2 / 3 < sd / summary[name]["sd"] < 3 / 2, (name, sd, summary[name]["sd"])
