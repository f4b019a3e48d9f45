"""What people and programs get to see: `value(u)`, tables, and the files in `results/`."""

from __future__ import annotations

import json
import math
import os
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from support.small_campaign import small_campaign

from tvsbayes.calibration.calibration_file import load_calibration
from tvsbayes.calibration.pointing import INPUT_NAMES, NOISE_NAMES, Calibration
from tvsbayes.errors import InputError
from tvsbayes.estimators.four_point import ClassicResult, DirectionResult
from tvsbayes.instrument.campaign import input_hashes
from tvsbayes.report.fit_text import KEY_PARAMETERS, classic_text, demo_text, estimate_row, fit_text
from tvsbayes.report.tables import concise, interval_text, text_table
from tvsbayes.results.estimates import Estimate, FitSummary, Leverage, WeakDirection
from tvsbayes.results.fit_record import StoredMode, write_results


@pytest.mark.parametrize(
    ("value", "sd", "expected"),
    [
        (0.059394, 0.000081, "0.059394(81)"),
        (0.0593944, 0.0008082, "0.05939(81)"),
        (-12.3456, 0.0123, "-12.346(12)"),
        # Rounding the sd to two digits carries into the next decade: 10, never 100.
        (0.0593944, 0.0000994, "0.059394(99)"),
        (0.0593944, 0.0000995, "0.05939(10)"),
        (0.0593944, 0.0000996, "0.05939(10)"),
        (0.0593944, 0.00099999, "0.0594(10)"),
        (21.34, 0.996, "21.3(1.0)"),
        (21.34, 1.54, "21.3(1.5)"),
        (21.34, 9.94, "21.3(9.9)"),
        (21.34, 9.96, "21(10)"),
        (21.34, 12.6, "21(13)"),
        (1234.5, 123.0, "1234(120)"),
        (0.2, 0.0, "0.2"),
        (200.0, 0.0, "200"),
        (0.2, math.nan, "0.2"),
        (0.2, math.inf, "0.2"),
        (0.0, 1e-12, "0.0000000000000(10)"),
    ],
)
def test_concise_shows_two_digits_of_the_uncertainty(value, sd, expected):
    assert concise(value, sd) == expected


@pytest.mark.parametrize("mantissa", [1.0, 1.049, 1.05, 4.44, 9.4999, 9.5, 9.949, 9.95, 9.96, 9.999])
def test_concise_says_the_uncertainty_to_five_percent(mantissa):
    """Read back: two digits leave at most half a unit of 1.0, 5 %; value and digits end at the same place."""
    for exponent in range(-9, 3):
        sd = mantissa * 10.0**exponent
        number, digits = concise(math.pi, sd).rstrip(")").split("(")
        places = len(number.partition(".")[2])
        shown = float(digits) if "." in digits or not places else int(digits) * 10.0**-places
        assert len(digits.replace(".", "").rstrip("0") or "0") <= 2
        assert shown == pytest.approx(sd, rel=0.0501)
        assert abs(float(number) - math.pi) <= 0.5 * 10.0**-places


@pytest.mark.parametrize(
    ("low", "high", "sd", "expected"),
    [
        (0.061926, 0.0622781, 0.00009, "[0.0619260, 0.0622781]"),
        (-0.5, 0.5, 0.25, "[-0.500, 0.500]"),
        (18.3, 24.3, 1.54, "[18.30, 24.30]"),
        (-100.0, 300.0, 123.0, "[-100, 300]"),
        (0.2, 0.2, 0.0, "[0.200000, 0.200000]"),
    ],
)
def test_interval_ends_carry_one_digit_more_than_the_uncertainty(low, high, sd, expected):
    assert interval_text(low, high, sd) == expected


def test_tables_are_plain_text_whatever_the_terminal_says(monkeypatch):
    monkeypatch.setenv("FORCE_COLOR", "1")
    monkeypatch.setenv("COLUMNS", "20")
    text = text_table("title", ["name", "95 %"], [["[bold]a[/bold]", "1.25"], ["longer name", "[1, 2]"]])
    assert text.splitlines() == [
        "title",
        "name              95 %",
        "[bold]a[/bold]    1.25",
        "longer name     [1, 2]",
    ]


def estimate(value: float, sd: float, contraction: float | None = 0.9) -> Estimate:
    return Estimate(value, sd, (value - 1.96 * sd, value + 1.96 * sd), 10 * sd, contraction)


def small_summary() -> FitSummary:
    """A fit in which the pan axis never moved right and the tilt axis never moved."""
    parameters = {name: estimate(1.0, 0.1) for name, _, _ in KEY_PARAMETERS}
    parameters["mirror_offset_mm"] = estimate(30.0, 5.0, 0.001)
    parameters["stop_sd_deg.up"] = Estimate(0.05, 0.0, (0.05, 0.05), 0.0, None)
    return FitSummary(
        converged=True,
        problems=(),
        effective={"left": estimate(0.0621, 0.0001), "right": None, "up": None, "down": None},
        contrasts={"pan": None, "tilt": None},
        reference_pose_deg={"pan": 6.0, "tilt": 0.5},
        jacobian=((1.0, 0.0), (0.0, 1.0)),
        parameters=parameters,
        chi2=31.0,
        dof=30.5,
        weak_directions=(WeakDirection("the tilt axis was never moved", {"degrees_per_step.tilt": 1.0}),),
        leverage=(Leverage(0, (3, 4), "effective left", None, "without move 0 it is lost"),),
        classic_predicted=dict.fromkeys(("left", "right", "up", "down")),
        excluded_spots=(17,),
        suspect_spots=tuple(range(30)),
        prior_conflicts=(),
        prior_sensitivity=(),
    )


def small_fit() -> SimpleNamespace:
    """What `write_results` reads of a fit; a real one would compile the model."""
    draws = SimpleNamespace(
        physical=np.random.default_rng(3).normal(size=(50, 3)),
        effective_deg_per_step=np.full((50, 4), 0.06),
    )
    names = ("backlash_deg.pan", "not estimated", "pixel_scale")
    stored = StoredMode(names, np.zeros(3), np.eye(3), -1.0, np.ones((2, 3)), np.ones(6), np.ones(6))
    pose, campaign = np.array([0.1, 0.0]), small_campaign()
    return SimpleNamespace(names=names, draws=draws, reference_pose_rad=pose, campaign=campaign, stored=stored)


def test_rows_say_whether_data_or_prior_set_a_value():
    assert estimate_row("x", estimate(0.5, 0.01), "deg")[1:] == ["0.500(10)", "deg", "[0.4804, 0.5196]", "data"]
    assert estimate_row("x", estimate(0.5, 0.01, 0.09), "deg")[-1] == "prior"
    assert estimate_row("x", estimate(0.5, 0.0, None), "deg")[-1] == "fixed"
    assert estimate_row("x", None, "deg")[1] == "never moved"


def test_a_fit_astray_shows_no_results():
    """Where it stopped may help to find out why; no uncertainty and no diagnosis rests on it."""
    astray = replace(small_summary(), converged=False, problems=("it ran away",), few_stops={"up": 3})
    text = fit_text(astray)
    assert text.splitlines()[0] == "NOT CONVERGED: it ran away"
    assert "NOT results" in text and "95 %" not in text and "0.0621" not in text and "weak" not in text
    assert "19 and 10 more" in text


@pytest.mark.parametrize(("estimator", "word"), [("laplace", "too short; sample"), ("posterior", "intervals hold it")])
def test_few_stops_are_said(estimator, word):
    lines = fit_text(replace(small_summary(), few_stops={"up": 3, "down": 2}, estimator=estimator)).splitlines()
    (line,) = (line for line in lines if line.startswith("few stops"))
    assert "(up 3, down 2)" in line and word in line
    assert "few stops" not in fit_text(small_summary())


def test_fit_text_shows_what_the_reader_must_know():
    text = fit_text(small_summary())
    lines = {line.split("  ")[0]: line for line in text.splitlines()}
    assert "pan 6.00 deg, tilt 0.50 deg" in lines["joint estimator (Laplace) at pan 6.00 deg, tilt 0.50 deg"]
    assert "0.06210(10)" in lines["effective left"]
    assert "never moved" in lines["effective right"]
    assert lines["mirror offset L"].endswith("prior")
    assert lines["stop sd up"].endswith("fixed")
    assert "left - right" not in text
    assert "chi2 31.0 for 30.5 degrees of freedom" in text
    assert "weak: the tilt axis was never moved" in text
    assert "leverage: without move 0 it is lost" in text
    assert "excluded spots: 17\n" in text
    # A flood of ids helps nobody.
    assert "spots that disagree with all others: 0, 1, 2" in text
    assert ", 19 and 10 more; look at them" in text


def direction(mean: float, u: float | None) -> DirectionResult:
    interval = None if u is None else (mean - 2 * u, mean + 2 * u)
    n = 1 if u is None else 4
    return DirectionResult(n, mean, None if u is None else 2 * u, u, interval, u, interval, 1e-4, None)


def test_classic_text_has_a_row_per_direction_with_or_without_experiments():
    directions = {"left": direction(0.0594, 0.0002), "right": direction(0.062, None), "up": None, "down": None}
    rows = [line.split() for line in classic_text(ClassicResult(directions, (), ())).splitlines()]
    assert rows[2] == ["left", "4", "0.059400", "0.000400", "0.000200", "[0.059000,", "0.059800]"]
    assert rows[3] == ["right", "1", "0.062000", "-", "-", "-"]
    assert rows[4] == ["up", "0", "no", "experiment"]


def test_demo_text_says_which_interval_holds_the_truth():
    classic = ClassicResult({"left": direction(0.0594, 0.0002), "right": None, "up": None, "down": None}, (), ())
    truth = {"left": 0.06205, **{name: 1.0 for name, _, _ in KEY_PARAMETERS[:3]}}
    text = demo_text(classic, small_summary(), truth)
    row = next(line.split() for line in text.splitlines() if line.startswith("left"))
    assert row == ["left", "0.05940(20)", "NO", "0.06210(10)", "yes", "0.062050"]
    off = demo_text(classic, small_summary(), {**truth, "backlash_deg.pan": 2.0})
    assert next(line for line in off.splitlines() if line.startswith("backlash pan")).split()[4] == "NO"


def test_results_are_two_files_with_their_provenance(tmp_path):
    summary, folder = small_summary(), tmp_path / "new" / "results"
    paths = write_results(small_fit(), summary, folder, seed=5)
    assert paths == {"draws": str(folder / "draws.npz"), "fit": str(folder / "fit.json")}
    assert sorted(path.name for path in folder.iterdir()) == ["draws.npz", "fit.json"]

    def refuse(constant):
        raise AssertionError(f"{constant} is no JSON")

    document = json.loads((folder / "fit.json").read_text(), parse_constant=refuse)
    assert document["format"] == "tvsbayes-fit/1"
    assert document["seed"] == 5
    assert document["inputs"] == input_hashes(small_campaign())
    assert document["effective_deg_per_step"]["right"] is None
    assert document["covariance"]["names"] == ["backlash_deg.pan", "pixel_scale"]
    assert {"python", "tvsbayes", "jax", "numpy"} <= set(document["versions"])
    assert document["command"].startswith("tvsbayes")
    with np.load(folder / "draws.npz", allow_pickle=False) as draws:
        physical, names = draws["physical"], list(draws["names"])
    assert names == ["backlash_deg.pan", "not estimated", "pixel_scale"]
    expected = np.cov(physical[:, [0, 2]], rowvar=False)
    np.testing.assert_allclose(document["covariance"]["matrix"], expected, rtol=1e-12)


def test_results_with_a_calibration_are_read_back(tmp_path):
    count = len(INPUT_NAMES)
    calibration = Calibration(
        mean=np.arange(count, dtype=float),
        covariance=np.eye(count),
        noise_variance=dict.fromkeys(NOISE_NAMES, 0.01),
        overshoot_steps={"pan": 3, "tilt": 4},
        estimator="posterior",
        inputs=np.ones((5, count)),
        noise=np.ones((5, len(NOISE_NAMES))),
    )
    write_results(small_fit(), small_summary(), tmp_path, 0, calibration)
    found = load_calibration(tmp_path)
    assert (found.estimator, found.overshoot_steps["tilt"]) == ("posterior", 4)
    np.testing.assert_array_equal(found.mean, calibration.mean)
    np.testing.assert_array_equal(found.inputs, calibration.inputs)
    with np.load(tmp_path / "draws.npz", allow_pickle=False) as draws:
        assert draws["physical"].shape == (50, 3)
        assert str(draws["estimator"]) == "posterior"
    write_results(small_fit(), small_summary(), tmp_path, 0)
    with pytest.raises(InputError, match="did not converge"):
        load_calibration(tmp_path)


def test_nan_is_written_nowhere(tmp_path):
    with pytest.raises(ValueError, match="JSON"):
        write_results(small_fit(), replace(small_summary(), chi2=math.nan), tmp_path / "results", seed=0)
    assert not (tmp_path / "results").exists()


def test_a_failed_write_leaves_the_old_result_whole(tmp_path, monkeypatch):
    write_results(small_fit(), small_summary(), tmp_path, seed=1)
    before = (tmp_path / "fit.json").read_bytes()
    replace_file = os.replace

    def full(source, target):
        if str(target).endswith("fit.json"):
            raise OSError(28, "No space left on device")
        replace_file(source, target)

    monkeypatch.setattr(os, "replace", full)
    with pytest.raises(InputError, match="No space left"):
        write_results(small_fit(), small_summary(), tmp_path, seed=2)
    assert (tmp_path / "fit.json").read_bytes() == before
    assert sorted(path.name for path in tmp_path.iterdir()) == ["draws.npz", "fit.json"]


def test_a_file_where_the_folder_should_be_is_bad_input(tmp_path):
    (tmp_path / "results").write_text("")
    with pytest.raises(InputError):
        write_results(small_fit(), small_summary(), tmp_path / "results", seed=0)
