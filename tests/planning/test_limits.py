"""Shares and floors, what would do, the next looks, and when to stop."""

from __future__ import annotations

import math
import re
from dataclasses import replace

import numpy as np
import pytest
from msgspec import structs
from support.coarse_planning import with_priors

from tvsbayes.instrument.axes import HOME_APPROACH
from tvsbayes.instrument.mechanisms import TWO_MIRROR
from tvsbayes.instrument.parameters import Prior
from tvsbayes.instrument.plan import LOOKS_PER_EXPERIMENT, run_plan
from tvsbayes.planning import planner
from tvsbayes.planning.candidates import candidates
from tvsbayes.planning.expectation import information_of, prior_knowledge
from tvsbayes.planning.limits import Batch, Limit, limit_of, next_experiments, split_of, stop_now
from tvsbayes.planning.looks import LookArrays, arrange, information_of_looks
from tvsbayes.planning.search import DesignProblem
from tvsbayes.planning.target import (
    GEARS_AT_POINT,
    NOISE_AT_POINT,
    STOP_AT_POINT,
    Sensitivity,
    Target,
    parse_target,
    sensitivity,
)
from tvsbayes.results.plan_record import steps_of

pytestmark = pytest.mark.usefixtures("small_searches")


@pytest.fixture(scope="module")
def wide(mounted_rig):
    """A rig that can look at everything again a full turn away, and whose prior ratio is precise enough to find it."""
    limits = {"pan_min_steps": -200, "pan_max_steps": 6400, "tilt_min_steps": -130, "tilt_max_steps": 130}
    return with_priors(replace(mounted_rig, positioner=limits), degrees_per_step__pan=Prior(0.06, 1e-5))


def test_next_looks_are_worth_what_they_state_near_and_a_full_turn_away(wide):
    """As many looks a turn away as here: 6000 steps of 0.06 deg. Gains are those of the plan judged move by move."""
    known = prior_knowledge(wide)
    pool = candidates(known)
    seen = LookArrays(pool.looks, known, False).at(known.z, known.space)
    target = parse_target("u(left) <= 1e-5 deg/step")
    pose = seen.mirror_angles_rad.mean(axis=0)
    at = sensitivity(target, known.z, known.space, wide.table, pose)
    now = at.value(known.covariance)
    batches = next_experiments(DesignProblem(known, pool, seen, target, at))
    turned = [batch for batch in batches if batch.text.startswith("a full turn of pan away, ")]
    assert turned and len(turned) < len(batches)
    for batch in batches:
        steps = steps_of(batch.actions)
        log = run_plan(steps, wide, HOME_APPROACH)
        pan = [log.moves[look.move].pan_steps for look in log.looks]
        assert len(pan) == LOOKS_PER_EXPERIMENT
        assert min(pan) > 3000 or batch not in turned
        # The text names the looks' own counters.
        assert all(f"({counter}, " in batch.text for counter in pan)
        judged = planner.baseline_of("", information_of(steps, known), known, target, pose)
        assert batch.gain == pytest.approx(now - judged.joint, rel=1e-6)
        assert batch.minutes == judged.minutes and batch.gain_per_minute == batch.gain / batch.minutes


def test_a_target_below_the_floor_names_the_term_and_what_would_do(mounted_rig):
    """Exact cameras of unknown focal scale, known mechanics, one depth: the scale limits, and its remedy is enough.

    4 degrees of pan, seen to a pixel, are too few to separate scale and ratio.
    """
    free = ("degrees_per_step", "backlash", "stop_sd", "pixel_scale", "focal_scale")
    priors = mounted_rig.table.priors
    held = {name: replace(prior, u=0.0) for name, prior in priors.items() if not name.startswith(free)}
    exact = replace(mounted_rig.stereo, parameter_covariance=np.zeros_like(mounted_rig.stereo.parameter_covariance))
    small = {f"backlash_deg.{axis}": Prior(0.0, 0.05, "half-normal") for axis in ("pan", "tilt")}
    rig = replace(
        with_priors(mounted_rig, **held, **small),
        stereo=exact,
        sheets_mm={"d2": 275.0},
        positioner={"pan_min_steps": 270, "pan_max_steps": 330, "tilt_min_steps": -50, "tilt_max_steps": 50},
        cameras={**mounted_rig.cameras, "spot_sd_px": 1.0},
    )
    looks = candidates(prior_knowledge(rig)).looks
    once = np.linspace(0, len(looks) - 1, 2 * LOOKS_PER_EXPERIMENT).astype(int)

    def limit(focal_scale_u: float, limit: float) -> Limit:
        known = prior_knowledge(with_priors(rig, focal_scale=Prior(1.0, focal_scale_u)))
        shown = LookArrays(looks, known, False).at(known.z, known.space)
        path = np.zeros((len(once), 2))
        information = information_of_looks(shown, once, path, known.space, None)
        target = structs.replace(parse_target("u(left) <= 1 deg/step"), limit=limit)
        at = sensitivity(target, known.z, known.space, known.rig.table, shown.mirror_angles_rad.mean(axis=0))
        return limit_of(known, information, at, target)

    reachable = limit(0.002, 1.0)
    assert reachable.reachable and reachable.needed is None
    assert sum(reachable.shares.values()) == pytest.approx(1.0, abs=1e-6)
    wanted = 0.8 * reachable.floor
    short = limit(0.002, wanted)
    assert not short.reachable and short.cause == "focal scale" and short.floor == reachable.floor
    needed = re.fullmatch(r"it suffices to know u\(focal_scale\) = (\S+) instead of 0\.002", short.needed)
    assert limit(float(needed[1]), wanted).floor <= wanted
    # Two digits rounded down: the next number is too large.
    last = 10.0 ** (math.floor(math.log10(float(needed[1]))) - 1)
    assert not limit(float(needed[1]) + last, wanted).reachable


def test_no_calibration_removes_the_stop_at_the_point(knowledge, seen, pool):
    target = parse_target("U95(x) at 1000,0,0 mm <= 0.5 mm")
    at = sensitivity(target, knowledge.z, knowledge.space, knowledge.rig.table, np.zeros(2))
    path = arrange(pool.looks, knowledge.sheets, pool.run_up).path
    information = information_of_looks(seen, np.arange(len(pool.looks)), path, knowledge.space, None)
    limit = limit_of(knowledge, information, at, target)
    assert not limit.reachable and "at the point itself" in limit.needed


def test_errors_of_the_gears_at_the_point_are_not_called_its_stop(knowledge):
    """Stop 3 mm and reading 4 mm make 5 mm; with 12 mm of the gears, which nearer looks would reduce, 13 mm."""
    parts = {STOP_AT_POINT: np.array([9.0]), NOISE_AT_POINT: np.array([16.0]), GEARS_AT_POINT: np.array([144.0])}
    point, none = Sensitivity(at({SCALE: 1e-3})[None], parts), np.zeros((len(TWO_MIRROR.names), len(TWO_MIRROR.names)))

    def needed(limit_mm: float) -> str | None:
        target = parse_target(f"u(x) at 1000,0,0 mm <= {limit_mm} mm")
        return limit_of(knowledge, none, point, target).needed

    assert needed(4.9).startswith("5 mm come from the stop and the reading at the point itself")
    text = needed(5.1)
    assert "13 mm come from the point itself" in text and "5 from the stop" in text and "12 from errors of the" in text
    assert "only a smaller stop error" not in text and "[positioner]" in text
    assert needed(13.1) is None


SCALE, STEREO = TWO_MIRROR.index["focal_scale"], len(TWO_MIRROR.names) - 1


def at(columns: dict[int, float]) -> np.ndarray:
    """A vector over the coordinates with a few entries, shape (p,)."""
    vector = np.zeros(len(TWO_MIRROR.names))
    vector[list(columns)] = list(columns.values())
    return vector


def test_shares_of_two_parameters_by_hand(knowledge):
    """Data diag(3, 1) on priors of 1: S = diag(1/4, 1/2); g = (2, 3) is pulled by S g = (1/2, 3/2)."""
    data, noise = (np.diag(at({SCALE: scale, STEREO: camera})) for scale, camera in ((3.0, 1.0), (2.0, 0.2)))
    gradient = np.stack([at({SCALE: 0.1}), at({SCALE: 2.0, STEREO: 3.0})])
    at_point = {STOP_AT_POINT: np.array([0.0, 0.5]), NOISE_AT_POINT: np.array([0.4, 0.0])}
    target = Sensitivity(gradient, at_point)
    # Prior 1/4 and 9/4; pixels 2/4 + 0.2 * 9/4; the rest of the data 1/4 + 0.8 * 9/4; the point 0.5.
    parts = {"focal scale": 0.25, "stereo calibration": 2.25, STOP_AT_POINT: 0.5}
    looks = {"pixel noise": 0.95, "stop errors of the looks": 2.05}
    assert split_of(knowledge, data, noise, target) == pytest.approx({k: v / 6 for k, v in (parts | looks).items()})
    shares = split_of(knowledge, data, None, target)
    assert shares == pytest.approx({k: v / 6 for k, v in (parts | {"looks": 3.0}).items()})
    assert list(shares) == ["looks", "stereo calibration", STOP_AT_POINT, "focal scale"], "largest first"


def test_after_data_priors_and_campaign_are_one_share(knowledge):
    """Precision 2 of all and data diag(2, 0): S = diag(1/4, 1/2), S g = (1/2, 3/2); 2 (1/4 + 9/4) and 2 / 4."""
    known = replace(knowledge, precision=2 * np.eye(len(TWO_MIRROR.names)), after_data=True)
    gradient = at({SCALE: 2.0, STEREO: 3.0})[None]
    shares = split_of(known, np.diag(at({SCALE: 2.0})), None, Sensitivity(gradient))
    assert shares == pytest.approx({"the campaign and its priors": 5.0 / 5.5, "looks": 0.5 / 5.5})


def target_of(limit: float) -> Target:
    return Target("", "left", limit, "deg/step")


def test_an_input_has_to_be_known_as_much_better_as_the_floor_is_too_high(knowledge):
    """A value that is one prior's alone goes with its u: a floor 4 / 1.02 times the target requires u / 4 * 1.02.

    What is needed is never rounded up: 0.255, 0.2578 and 0.2598 of 0.002 are 0.00051, 0.000516 and 0.0005196, of which
    two digits that are enough are 0.00051.
    """
    nothing, only = np.zeros((len(TWO_MIRROR.names), len(TWO_MIRROR.names))), Sensitivity(at({SCALE: 2.0})[None])
    limit = limit_of(knowledge, nothing, only, target_of(0.51))
    assert (limit.floor, limit.cause, limit.reachable) == (2.0, "focal scale", False)
    for share in (0.255, 0.2578, 0.2598):
        needed = limit_of(knowledge, nothing, only, target_of(2.0 * share)).needed
        assert needed == "it suffices to know u(focal_scale) = 0.00051 instead of 0.002"
    assert limit_of(knowledge, nothing, only, target_of(2.0)).reachable


def test_two_inputs_are_required_where_one_is_not_enough(knowledge):
    """4^2 + 3^2 with a target of 2: the larger to a tenth of its u, the smaller to sqrt(4 - 0.4^2) / 3 = 0.653."""
    nothing, both = (
        np.zeros((len(TWO_MIRROR.names), len(TWO_MIRROR.names))),
        Sensitivity(at({STEREO: 4.0, SCALE: 3.0})[None]),
    )
    limit = limit_of(knowledge, nothing, both, target_of(2.0))
    assert limit.shares == pytest.approx({"stereo calibration": 16 / 25, "focal scale": 9 / 25})
    stereo = "the stereo calibration to 10 % of its present uncertainty"
    assert limit.needed == f"it suffices to know {stereo}; u(focal_scale) = 0.0013 instead of 0.002"


OPEN = Limit(1e-5, "focal scale", {}, True, None)
FLOOR = structs.replace(OPEN, floor=2.5e-4, reachable=False)


@pytest.mark.parametrize(
    ("now", "gain_per_minute", "limit", "after_data", "stop"),
    [
        # The target of 2e-4 is met; before any data nothing is measured yet.
        (2e-4, 2e-5, OPEN, True, True),
        (2e-4, 2e-5, OPEN, False, False),
        (2.01e-4, 2e-5, OPEN, True, False),
        # The rule that is printed: less than 0.1 % a minute of what is known now; nothing is to stop before any data.
        *((3e-4, 0.98e-3 * 3e-4, OPEN, after_data, after_data) for after_data in (False, True)),
        (3e-4, 1.02e-3 * 3e-4, OPEN, True, False),
        # Out of reach.
        (3e-4, 2e-5, FLOOR, True, True),
        (3e-4, 2e-5, FLOOR, False, False),
    ],
)
def test_when_to_stop(now, gain_per_minute, limit, after_data, stop):
    batches = Batch((), 2.0, 2 * gain_per_minute, gain_per_minute, ""), Batch((), 2.0, 0.0, 0.0, "")
    advice = stop_now(now, parse_target("u(left) <= 2e-4 deg/step"), limit, batches, after_data)
    assert advice.now is stop and "less than 0.1 % a minute" in advice.rule
    assert ("floor" in advice.reason) is (limit is FLOOR)
