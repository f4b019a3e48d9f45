"""A watched calibration: the linear algebra against a dense Gaussian, planted knocks named, chances as stated."""

from __future__ import annotations

from dataclasses import replace

import jsonschema
import numpy as np
import pytest
from support.dense_spots import dense_covariance
from support.fit_documents import shipped_schema

from tvsbayes.comparison import departures
from tvsbayes.comparison.departures import (
    FALSE_ALARM_RATE,
    Departure,
    columns_of,
    null_distribution,
    powers,
)
from tvsbayes.comparison.watched_looks import CHANGES, SIGHTED_CHANGES, WatchedLooks, watch
from tvsbayes.errors import InputError, NothingToEstimate
from tvsbayes.instrument.campaign import Campaign, write_campaign
from tvsbayes.instrument.parameters import STEREO_PARAMETER_NAMES
from tvsbayes.instrument.protocols import four_point_protocol
from tvsbayes.report.tables import sentences
from tvsbayes.results.watch_record import CANNOT_TELL, MOVED, OK
from tvsbayes.statistics.chances import binomial_bounds
from tvsbayes.twin.simulated_campaign import simulate
from tvsbayes.twin.true_rig import Truth

pytestmark = pytest.mark.thorough


@pytest.fixture(scope="module")
def truth(mixed_run) -> Truth:
    return mixed_run.truth


def next_day(rig, truth: Truth, seed: int = 11, repeats: int = 1, **changed: float) -> Campaign:
    """Looks at the same counters after parameters have changed by so much; `__` stands for a dot."""
    vector, parameters = truth.stereo.vector.copy(), dict(truth.parameters)
    for name, by in changed.items():
        name = name.replace("__", ".")
        if name in STEREO_PARAMETER_NAMES:
            vector[STEREO_PARAMETER_NAMES.index(name)] += by
        else:
            parameters[name] += by
    now = replace(truth, parameters=parameters, stereo=truth.stereo.with_vector(vector))
    plan = four_point_protocol(repeats=repeats, steps=(100, 200))
    return simulate(rig, plan, seed=seed, truth=now).campaign


def test_the_departure_is_that_of_a_dense_gaussian(mounted_rig, mixed_fit, truth):
    """Covariance of all residuals spelled out, the second day given the first by the rule of Gaussian conditioning."""
    watched = WatchedLooks(mixed_fit, next_day(mounted_rig, truth))
    departure = watched.departure(mixed_fit.z)
    spots = watched.linear(mixed_fit.z)
    count, size = len(mixed_fit.z), len(spots.residual)
    columns = spots.jacobian.reshape(4 * size, -1)
    fitted, shifts = columns[:, :count], columns[:, count:]
    dense = dense_covariance(spots) + fitted @ fitted.T
    # A priori the coordinates are N(0, 1): z of them is taken back to zero.
    residual = spots.residual.ravel() + fitted @ np.where(watched.problem.held, 0.0, mixed_fit.z)
    new = np.arange(4 * size) >= 4 * watched.first
    gain = dense[np.ix_(new, ~new)] @ np.linalg.inv(dense[np.ix_(~new, ~new)])
    left = residual[new] - gain @ residual[~new]
    inverse = np.linalg.inv(dense[np.ix_(new, new)] - gain @ dense[np.ix_(~new, new)])
    tested = shifts[new]
    # Priors of 1e5 sds of the spots: the dense inverse keeps six digits of what is large.
    assert departure.chi2 == pytest.approx(left @ inverse @ left, rel=1e-6)
    dense_information = tested.T @ inverse @ tested
    scale = 1 / np.sqrt(np.diag(dense_information))
    both = np.outer(scale, scale)
    np.testing.assert_allclose(departure.information * both, dense_information * both, atol=1e-5)
    np.testing.assert_allclose(departure.score * scale, tested.T @ inverse @ left * scale, atol=1e-4)
    assert departure.dof == 3 * watched.looks and not shifts[~new].any()


@pytest.mark.parametrize(
    ("changed", "what", "size"),
    [
        ({"stereo__rotation_rad__x": np.radians(0.1)}, "cameras: rotation about x", 0.1),
        ({"degrees_per_step__tilt": 0.05 * 0.07}, "ratio: tilt", 5.0),
        ({"backlash_deg__tilt": 0.8}, "play: tilt", 0.8),
    ],
)
def test_a_planted_change_is_named(mounted_rig, mixed_fit, truth, changed, what, size):
    test = watch(mixed_fit, next_day(mounted_rig, truth, **changed, repeats=2))
    assert test.verdict == MOVED and test.p < FALSE_ALARM_RATE
    part = test.moved[0]
    assert part.what == what and len({other.what for other in test.moved}) == len(test.moved)
    # Linear in the change: a tenth of it beside four u.
    assert part.value == pytest.approx(size, abs=4 * part.u + 0.1 * size)


def test_looks_of_the_campaign_are_refused(mixed_fit):
    """All of them, or more than half: they agree with it whatever has happened since."""
    campaign = mixed_fit.campaign
    for looks in (campaign, replace(campaign, spots=campaign.spots[::2])):
        with pytest.raises(InputError, match=r"spots\.csv of the first folder"):
            watch(mixed_fit, looks)


def test_nothing_has_moved(mounted_rig, mixed_fit, truth, monkeypatch):
    """The same looks are OK where their power is enough, and name the change they cannot detect where it is not."""
    looks = next_day(mounted_rig, truth)
    test = watch(mixed_fit, looks)
    assert test.verdict == CANNOT_TELL and test.p > FALSE_ALARM_RATE and not test.moved and test.same_cameras
    assert "ratio: pan" in {change.what for change in test.unseen(0.8)}
    monkeypatch.setattr(departures, "POWER_MIN", 0.0)
    assert watch(mixed_fit, looks).verdict == OK
    unseen = replace(looks, spots=tuple(replace(s, status="saturated") for s in looks.spots[3:]) + looks.spots[:3])
    with pytest.raises(NothingToEstimate, match="3 new looks"):
        watch(mixed_fit, unseen)


def test_false_alarms_and_power_are_those_of_the_linear_model():
    """Scores drawn from a model in which nothing, or one change, has moved: counted against what is stated."""
    generator = np.random.default_rng(5)
    rows = columns_of(CHANGES)
    columns = generator.standard_normal((40, rows[-1].stop)) * 0.6
    # A size of 1 mm beside one of 0.05 deg: all changes about as visible.
    columns /= np.concatenate([np.full(len(c.names), c.size) for c in CHANGES])
    known = Departure(0.0, 40, np.zeros(columns.shape[1]), columns.T @ columns, CHANGES)
    null, trials, shifted = null_distribution(known, 1), 400, rows[6]
    stated = powers(known, null.limit, 1)[6]
    alarms = noticed = 0
    for _ in range(trials):
        noise = generator.standard_normal(40)
        for moved in (False, True):
            sample = noise + moved * columns[:, shifted] @ [CHANGES[6].size]
            trial = replace(known, chi2=float(sample @ sample), score=columns.T @ sample)
            logs = trial.log_chances()
            alarms += (not moved) and bool(logs[1:].min() <= null.limit)
            noticed += moved and bool(logs[1 + 6] <= null.limit)
    low, high = binomial_bounds(trials, FALSE_ALARM_RATE)
    assert low <= alarms / trials <= high
    low, high = binomial_bounds(trials, stated)
    assert low <= noticed / trials <= high and 0.05 < stated < 1
    assert null.probability(null.limit) == pytest.approx(FALSE_ALARM_RATE, rel=0.02)
    assert null.probability(-50.0) == pytest.approx(8 * np.exp(-50), rel=1e-9)


def test_the_command_keeps_a_table(ask, say, mounted_rig, mixed_fit, truth, tmp_path, monkeypatch):
    monkeypatch.setattr("tvsbayes.pipeline.StoredOrFitted.fit", mixed_fit)
    for name, campaign in (
        ("old", mixed_fit.campaign),
        ("same", next_day(mounted_rig, truth)),
        ("knocked", next_day(mounted_rig, truth, extrinsics__translation_mm__y=5.0)),
    ):
        write_campaign(campaign, tmp_path / name)
    old, same, knocked, table = (tmp_path / name for name in ("old", "same", "knocked", "nights.csv"))
    code, text, _ = say("watch", old, same, "--append", table)
    assert code == 3 and text.startswith("CANNOT TELL (p = ")
    assert "cannot see 0.3 % of ratio: pan: pan counters further apart" in text
    code, document = ask("watch", old, knocked, "--append", table)
    jsonschema.validate(document, shipped_schema("watch-1"))
    assert (code, document["verdict"], document["looks"], document["false_alarm_rate"]) == (1, "MOVED", 16, 0.01)
    assert document["moved"][0]["what"] == "positioner: shift along y" and document["moved"][0]["unit"] == "mm"
    head, first, second = table.read_text().splitlines()
    assert head == "time,verdict,p,looks,moved"
    assert first.split(",")[1] == "CANNOT TELL" and "positioner: shift along y" in second
    # A table that takes no line: the result is out once, with what went wrong.
    other = tmp_path / "other.csv"
    other.write_text("night,what\n")
    code, document = ask("watch", old, same, "--append", other)
    assert (code, document["verdict"], document["error"]["code"]) == (2, "CANNOT TELL", "header")
    assert other.read_text() == "night,what\n"
    of_axis = {"ratio", "play", "zero"}
    helps, remedies = sentences("watch_better"), sentences("moved")
    assert set(helps) == {change.what for change in (*CHANGES, *SIGHTED_CHANGES)} | of_axis
    assert set(remedies) == {what.split(":")[0] for what in helps}
