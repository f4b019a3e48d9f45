"""Every command, its documents and its exit codes, in this process; one subprocess for what `--help` loads.

One fit compiles the model (the paper twin, the small campaigns and the grid share one bucket), all others reuse it.
"""

from __future__ import annotations

import json
import os
import re
import shutil
import subprocess
import sys
from dataclasses import replace
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from results.test_fit_record import problems

from tvsbayes.cli.app import keep, report_line
from tvsbayes.cli.main import main, run
from tvsbayes.estimators.four_point import select_experiments
from tvsbayes.files.disk import shipped_data
from tvsbayes.instrument.campaign import Campaign, read_campaign, write_campaign
from tvsbayes.instrument.model_choice import ModelChoice
from tvsbayes.instrument.parameters import Prior
from tvsbayes.instrument.plan import PlanStep, write_plan
from tvsbayes.instrument.protocols import grid_protocol, mixed_protocol
from tvsbayes.pipeline import compile_for, fit_for
from tvsbayes.twin.simulated_campaign import simulate

DATA = shipped_data()
MOUNTED = DATA / "rigs" / "mounted"
PAPER_TWIN = DATA / "twins" / "paper_twin"
DIRECTIONS = ("left", "right", "up", "down")
ESTIMATE_KEYS = {"value", "sd", "interval95", "prior_sd", "contraction", "rhat", "ess_bulk", "ess_tail"}


def no_constant(name: str) -> None:
    raise AssertionError(f"{name} is no JSON")


@pytest.fixture(scope="module", autouse=True)
def own_compilation_cache():
    """`fit` and `demo` point JAX at the folder of the tests; afterwards JAX is as it was."""
    import jax
    from jax.experimental.compilation_cache import compilation_cache

    names = ("jax_compilation_cache_dir", "jax_persistent_cache_min_compile_time_secs")
    before = {name: jax.config.values[name] for name in names}
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("TVSBAYES_CACHE", os.environ["JAX_COMPILATION_CACHE_DIR"])
        yield
    for name, value in before.items():
        jax.config.update(name, value)
    compilation_cache.reset_cache()


@pytest.fixture
def ask(capsys):
    """Run a command with --json: exit code, and the one document on stdout."""

    def run_json(*arguments: object) -> tuple[int, dict[str, Any]]:
        code = run([*map(str, arguments), "--json"])
        captured = capsys.readouterr()
        assert "Traceback" not in captured.err
        return code, json.loads(captured.out, parse_constant=no_constant)

    return run_json


@pytest.fixture
def say(capsys):
    """Run a command for people: exit code, stdout, stderr."""

    def run_text(*arguments: object) -> tuple[int, str, str]:
        code = run([*map(str, arguments)])
        return code, *capsys.readouterr()

    return run_text


def steps(*orders: tuple) -> tuple[PlanStep, ...]:
    """Orders as a plan: ("place", target), ("look",), ("home" or "move", pan, tilt)."""
    return tuple(
        PlanStep(number, action, target=rest[0]) if action == "place" else PlanStep(number, action, *rest)
        for number, (action, *rest) in enumerate(orders)
    )


def two_sheets(*counters: tuple[int, int]) -> tuple[PlanStep, ...]:
    """Each stop looked at twice on both sheets; both axes homed at 0."""
    looks = (("place", "d1"), ("look",), ("look",), ("place", "d2"), ("look",), ("look",))
    return steps(("home", 0, 0), *looks, *(order for pair in counters for order in (("move", *pair), *looks)))


@pytest.fixture(scope="module")
def small(mounted_rig) -> Campaign:
    """24 spots: three by two poses on two sheets, each from either side of both axes."""
    plan = grid_protocol(targets=("d1", "d2"), pan_steps=(0, 100, 200), tilt_steps=(-60, 60))
    return simulate(mounted_rig, plan, seed=3).campaign


@pytest.fixture
def folder(small, tmp_path) -> Path:
    """A copy of the small campaign that a test may spoil."""
    write_campaign(small, tmp_path / "campaign")
    return tmp_path / "campaign"


def assert_error(document: dict[str, Any], code: str) -> dict[str, Any]:
    error = document["error"]
    assert {"code", "file", "line", "message", "remedy"} <= set(error)
    assert error["code"] == code
    assert error["message"]
    assert error["remedy"]
    return error


def test_check_reads_campaign_rig_and_plan(ask, say):
    code, document = ask("check", PAPER_TWIN)
    assert code == 0
    assert document == {
        "kind": "campaign",
        "moves": 244,
        "segments": 1,
        "spots": 384,
        "ok_spots": 384,
        "refused": {},
        "aperture_readings": 0,
        "experiments": 96,
        "warnings": [],
    }
    code, document = ask("check", MOUNTED / "rig.toml")
    assert (code, document["kind"], document["sheets_mm"]["d1"]) == (0, "rig", 175.0)
    code, document = ask("check", MOUNTED / "paper.csv")
    assert (code, document["kind"], document["look"], document["home"]) == (0, "plan", 384, 1)
    code, out, _ = say("check", PAPER_TWIN)
    assert code == 0
    assert "spots: 384" in out
    assert out.endswith(", 0 warnings\n")


def test_check_warns_without_failing(ask, say, small, tmp_path):
    """Weak directions alone are exit 0 (DESIGN 8)."""
    stereo = replace(small.stereo, parameter_covariance=np.zeros((24, 24)))
    write_campaign(replace(small, stereo=stereo), tmp_path / "exact")
    code, document = ask("check", tmp_path / "exact")
    assert code == 0
    assert len(document["warnings"]) == 1
    assert "covariance is zero" in document["warnings"][0]
    assert "warning: the stereo covariance is zero" in say("check", tmp_path / "exact")[1]


def test_classic_document_has_the_contracts_keys(ask):
    code, document = ask("classic", PAPER_TWIN)
    assert code == 0
    assert set(document) == {"directions", "experiments", "skipped"}
    contract = {
        "n",
        "mean_deg_per_step",
        "sd_deg_per_step",
        "u_type_a_deg_per_step",
        "interval95_type_a",
        "u_gum_deg_per_step",
        "interval95_gum",
    }
    assert list(document["directions"]) == list(DIRECTIONS)
    for result in document["directions"].values():
        # Two more than DESIGN 8 names.
        assert set(result) == contract | {"u_stereo_deg_per_step", "effective_dof"}
        assert result["n"] == 24
        low, high = result["interval95_type_a"]
        assert low < result["mean_deg_per_step"] < high
    assert len(document["experiments"]) == 96
    keys = {"experiment", "direction", "steps", "theta_i_deg", "theta_f_deg", "deg_per_step"}
    assert all(set(e) == keys for e in document["experiments"])


def test_classic_gives_null_for_a_direction_without_experiments(ask, say, tmp_path):
    twin = read_campaign(PAPER_TWIN)
    left_only = tuple(s for s in twin.spots if s.experiment < 24)
    write_campaign(replace(twin, spots=left_only), tmp_path / "left")
    code, document = ask("classic", tmp_path / "left")
    assert code == 0
    assert document["directions"]["left"]["n"] == 24
    assert [document["directions"][d] for d in DIRECTIONS[1:]] == [None] * 3
    assert "no experiment" in say("classic", tmp_path / "left")[1]


def test_classic_without_a_complete_experiment_has_nothing_to_estimate(ask, folder):
    code, document = ask("classic", folder)
    assert code == 3
    assert set(document) == {"error"}


def test_simulate_writes_a_campaign_and_repeats_itself(ask, tmp_path):
    plan = tmp_path / "plan.csv"
    write_plan(two_sheets((100, 30)), plan)
    documents = []
    for name, seed in (("a", 7), ("b", 7), ("c", 8)):
        code, document = ask("simulate", MOUNTED / "rig.toml", plan, tmp_path / name, "--aperture", "--seed", seed)
        assert code == 0
        documents.append(document)
    assert documents[0] == {"campaign": str(tmp_path / "a"), "moves": 2, "spots": 8, "ok": 8, "seed": 7}
    names = {"campaign.toml", "stereo.json", "moves.csv", "spots.csv", "truth.json"}
    assert {path.name for path in (tmp_path / "a").iterdir()} == names
    for name in names:
        assert (tmp_path / "a" / name).read_bytes() == (tmp_path / "b" / name).read_bytes()
    assert (tmp_path / "a" / "spots.csv").read_bytes() != (tmp_path / "c" / "spots.csv").read_bytes()
    assert all(spot.aperture_deg is not None for spot in read_campaign(tmp_path / "a").spots)
    code, document = ask("simulate", MOUNTED / "rig.toml", plan, tmp_path / "a")
    assert code == 2
    assert_error(document, "occupied")


def test_new_campaign_lacks_only_its_stereo_calibration(ask, say, tmp_path):
    out = tmp_path / "mine"
    code, document = ask("new", out)
    assert code == 0
    assert sorted(document["files"]) == ["campaign.toml", "moves.csv", "rig.toml", "spots.csv"]
    code, document = ask("check", out)
    assert code == 2
    assert assert_error(document, "missing-file")["file"] == "stereo.json"
    (out / "stereo.json").write_bytes((MOUNTED / "stereo.json").read_bytes())
    code, document = ask("check", out)
    assert code == 0
    assert (document["moves"], document["spots"]) == (1, 0)
    assert ask("check", out / "rig.toml")[0] == 0
    code, text, log = say("new", out)
    assert (code, text) == (2, "")
    assert "nothing is overwritten" in log


def test_fit_document_has_the_contracts_keys_and_its_files(ask, folder):
    code, document = ask("fit", folder, "--no-sample", "--seed", 4)
    assert code == 0
    assert (document["estimator"], document["converged"], document["seed"]) == ("laplace", True, 4)
    assert list(document["effective_deg_per_step"]) == list(DIRECTIONS)
    assert set(document["reference_pose_deg"]) == {"pan", "tilt"}
    required = {
        *("degrees_per_step.pan", "degrees_per_step.tilt"),
        *(f"degrees_per_step.{d}" for d in DIRECTIONS),
        *("ratio_contrast_deg_per_step.pan", "ratio_contrast_deg_per_step.tilt"),
        *("backlash_deg.pan", "backlash_deg.tilt", "tilt_zero_deg"),
        *("mirror_offset_mm", "effective_mirror_offset_mm", "mirror1_error_deg", "mirror2_error_deg"),
        *("laser_tilt_deg.x", "laser_tilt_deg.y", "laser_offset_mm.x", "laser_offset_mm.y"),
        *("tilt_axis_skew_deg", "tilt_axis_offset_mm.x", "tilt_axis_offset_mm.z"),
        *(f"extrinsics.{kind}.{axis}" for kind in ("rotation_rad", "translation_mm") for axis in "xyz"),
        *(f"stop_sd_deg.{d}" for d in DIRECTIONS),
        *("pixel_scale", "focal_scale", "stereo.left.fx"),
    }
    # Without aperture readings a, C0 and the aperture's zero and noise are not estimated.
    assert required <= set(document["parameters"])
    assert not {"baseline_mm", "pan_zero_emission_deg", "aperture_zero_deg", "aperture_sd_deg"} & set(
        document["parameters"]
    )
    for estimate in (*document["parameters"].values(), *document["effective_deg_per_step"].values()):
        assert set(estimate) == ESTIMATE_KEYS
        low, high = estimate["interval95"]
        assert low <= estimate["value"] <= high
        assert estimate["rhat"] is estimate["ess_bulk"] is estimate["ess_tail"] is None
    for direction in DIRECTIONS:
        assert document["effective_deg_per_step"][direction]["contraction"] > 0.9
    assert {"chi2", "dof", "pixel_scale"} <= set(document["noise"])
    assert document["noise"]["pixel_scale"] == document["parameters"]["pixel_scale"]["value"]
    assert all({"text", "loadings"} <= set(weak) for weak in document["weak_directions"])
    assert document["excluded_spots"] == []
    assert document["files"] == {
        "draws": str(folder / "results" / "draws.npz"),
        "fit": str(folder / "results" / "fit.json"),
    }
    saved = json.loads((folder / "results" / "fit.json").read_text(), parse_constant=no_constant)
    assert saved["format"] == "tvsbayes-fit/1"
    assert problems(saved, json.loads((DATA / "schemas" / "fit-1.schema.json").read_text())) == []
    assert {**{key: saved[key] for key in document if key != "files"}, "files": document["files"]} == document
    with np.load(folder / "results" / "draws.npz", allow_pickle=False) as draws:
        assert draws["effective_deg_per_step"].shape == (len(draws["physical"]), 4)
        column = list(draws["names"]).index("backlash_deg.pan")
        sd = document["parameters"]["backlash_deg.pan"]["sd"]
        assert draws["physical"][:, column].std() == pytest.approx(sd, rel=1e-9)


def test_fit_for_people_names_value_interval_and_origin(say, folder, tmp_path):
    out = tmp_path / "elsewhere"
    out.mkdir()
    (out / "posterior.nc").write_bytes(b"of an earlier fit")
    code, text, told = say("fit", folder, "--no-sample", "--out", out)
    assert code == 0
    assert not (out / "posterior.nc").exists() and "posterior.nc of an earlier fit is removed" in told
    row = next(line for line in text.splitlines() if line.startswith("effective left"))
    assert row.split()[-1] == "data"
    assert str(out / "fit.json") in text
    assert (out / "draws.npz").is_file()
    assert not (folder / "results").exists()


@pytest.mark.slow
def test_fit_samples_writes_for_arviz_and_refuses_what_has_not_converged(ask, folder, monkeypatch):
    """The limits are loosened: what is tested is the way from options to files, not convergence."""
    import arviz

    from tvsbayes.posterior import sampling

    for name, value in {"FIRST_CHECK": 40, "BLOCK": 20, "ESS_LIMIT": 50, "RHAT_LIMIT": 3.0, "TAU_LIMIT": 1}.items():
        monkeypatch.setattr(sampling, name, value)
    code, document = ask("fit", folder, "--seed", 2)
    assert (code, document["estimator"], document["converged"]) == (0, "posterior", True)
    left = document["effective_deg_per_step"]["left"]
    assert left["interval95"][0] < left["value"] < left["interval95"][1]
    assert left["ess_bulk"] >= 50 and left["rhat"] <= 3.0
    assert document["parameters"]["degrees_per_step.left"]["ess_tail"] > 0
    assert set(document["files"]) == {"fit", "draws", "posterior", "chain"}
    assert {"effective_deg_per_step", "lost_motion"} == set(document["curves"])
    tree = arviz.from_netcdf(document["files"]["posterior"])
    assert list(tree["posterior"]["degrees_per_step"].dims) == ["chain", "draw", "direction"]
    assert list(tree["posterior"]["backlash_deg"].dims) == ["chain", "draw", "axis"]
    assert {"prior", "posterior_predictive", "log_likelihood", "observed_data", "sample_stats"} <= set(tree.children)
    mean = tree["posterior"]["effective_deg_per_step"].sel(direction="left").mean().item()
    assert mean == pytest.approx(left["value"], rel=1e-12)
    assert arviz.summary(tree, var_names=["backlash_deg"]).shape[0] == 2

    monkeypatch.setattr("tvsbayes.posterior.sampling.ESS_LIMIT", 10**9)
    code, document = ask("fit", folder, "--seed", 2, "--resume", "--max-minutes", "0.01")
    assert (code, document["estimator"], document["converged"]) == (4, "laplace", False)
    assert document["error"]["code"] == "unconverged"
    assert document["sampling"]["steps"] > 40
    code, document = ask("fit", folder, "--seed", 3, "--resume")
    assert (code, document["error"]["code"]) == (2, "other-chain")


def test_per_axis_fit_has_one_gear_ratio_per_axis(ask, folder):
    code, document = ask("fit", folder, "--no-sample", "--per-axis")
    assert code == 0
    parameters = document["parameters"]
    assert parameters["degrees_per_step.left"]["value"] == parameters["degrees_per_step.right"]["value"]
    contrast = parameters["ratio_contrast_deg_per_step.tilt"]
    assert (contrast["value"], contrast["sd"], contrast["prior_sd"], contrast["contraction"]) == (0.0, 0.0, 0.0, None)


def test_what_a_fit_left_is_taken_up_again(folder, monkeypatch):
    """`compare` and `plan --given` start from results/ (DESIGN 8): the same model, mode and draws, no second fit."""
    from tvsbayes.assessment.fitted_calibration import calibration_of
    from tvsbayes.assessment.summary import summarise
    from tvsbayes.estimators.joint_fit import fit, restored
    from tvsbayes.results.fit_record import stored_mode, write_results

    campaign = read_campaign(folder)
    assert stored_mode(campaign) is None
    fresh = fit(campaign, model=ModelChoice(per_axis=True))
    write_results(fresh, summarise(fresh), folder / "results", 0, calibration_of(fresh))
    back = restored(campaign, stored_mode(campaign))
    for name in ("z", "covariance", "draws_z", "free", "reference_pose_rad"):
        np.testing.assert_array_equal(getattr(back, name), getattr(fresh, name))
    np.testing.assert_array_equal(back.draws.effective_deg_per_step, fresh.draws.effective_deg_per_step)
    assert (back.converged, back.log_density, back.chi2) == (True, fresh.log_density, fresh.chi2)
    monkeypatch.setattr("tvsbayes.estimators.joint_fit.fit", None)
    monkeypatch.setattr("tvsbayes.studies.study_job.fit", None)
    assert fit_for(campaign, report_line).converged
    (folder / "moves.csv").write_bytes((folder / "moves.csv").read_bytes() + b"\n")
    assert stored_mode(read_campaign(folder)) is not None, "a blank line changes nothing that was measured"
    spots = (folder / "spots.csv").read_text().replace("d2", "d3")
    (folder / "spots.csv").write_text(spots)
    assert stored_mode(read_campaign(folder)) is None


def test_fit_without_backlash_and_with_harmonics(ask, small, folder, tmp_path):
    code, document = ask("fit", folder, "--no-sample", "--harmonics")
    assert code == 2 and "harmonic_period_deg.pan" in document["error"]["remedy"]
    table = replace(small.rig, harmonic_period_deg={"tilt": 360.0})
    write_campaign(replace(small, rig=table), tmp_path / "wheel")
    code, document = ask("fit", tmp_path / "wheel", "--no-sample", "--harmonics", "--no-backlash")
    assert code == 0
    parameters = document["parameters"]
    assert {name for name in parameters if name.startswith("harmonic_deg")} == {
        f"harmonic_deg.tilt.{order}.{part}" for order in (1, 2) for part in ("cos", "sin")
    }
    assert parameters["backlash_deg.pan"]["value"] == parameters["backlash_deg.tilt"]["sd"] == 0.0


def test_robust_fit_names_the_spot_it_leaves_out(ask, small, tmp_path):
    spots = list(small.spots)
    # 40 stated sds.
    spots[9] = replace(spots[9], v_left_px=spots[9].v_left_px + 40 * spots[9].sv_left_px)
    write_campaign(replace(small, spots=tuple(spots)), tmp_path / "odd")
    code, document = ask("fit", tmp_path / "odd", "--no-sample", "--robust")
    assert code == 0
    assert document["excluded_spots"] == [spots[9].spot]


def test_a_direction_never_moved_is_null_and_one_side_is_weak(ask, say, mounted_rig, tmp_path):
    plan = two_sheets((40, 0), (80, 30), (120, 30), (160, 60), (200, 90))
    write_campaign(simulate(mounted_rig, plan, seed=5).campaign, tmp_path / "one way")
    code, document = ask("fit", tmp_path / "one way", "--no-sample")
    assert code == 0
    effective = document["effective_deg_per_step"]
    assert effective["right"] is effective["down"] is None
    assert effective["left"]["contraction"] > 0.9
    texts = [weak["text"] for weak in document["weak_directions"]]
    assert [text for text in texts if "pan ratio and pan backlash" in text and "from one side" in text]
    assert "never moved" in say("fit", tmp_path / "one way", "--no-sample")[1]


def test_too_few_spots_are_nothing_to_estimate(ask, small, tmp_path):
    write_campaign(replace(small, spots=small.spots[:7]), tmp_path / "few")
    code, document = ask("fit", tmp_path / "few", "--no-sample")
    assert code == 3
    assert_error(document, "too-few-spots")
    assert not (tmp_path / "few" / "results").exists()


def test_spots_at_one_stop_inform_no_headline(ask, mounted_rig, tmp_path):
    """Both axes move, but only after the last look."""
    looks = [("place", "d1"), *[("look",)] * 5, ("place", "d2"), *[("look",)] * 5]
    plan = steps(("home", 0, 0), *looks, ("move", 100, 50), ("move", 0, 0))
    write_campaign(simulate(mounted_rig, plan, seed=6).campaign, tmp_path / "still")
    code, document = ask("fit", tmp_path / "still", "--no-sample")
    assert code == 3
    assert_error(document, "uninformed")
    # The document is there all the same, and says where the values come from.
    assert all(e["contraction"] < 0.1 for e in document["effective_deg_per_step"].values())


def with_spots(campaign: Campaign, change) -> Campaign:
    """Every spot changed."""
    return replace(campaign, spots=tuple(map(change, campaign.spots)))


def test_swapped_cameras_end_in_words_and_files(ask, mounted_rig, tmp_path):
    """Predicted pixels beyond the lens model, draws far out: no number that JSON cannot hold."""

    def swapped(s):
        left, right = (s.u_left_px, s.v_left_px), (s.u_right_px, s.v_right_px)
        changed = zip(("u_left_px", "v_left_px", "u_right_px", "v_right_px"), (*right, *left), strict=True)
        return replace(s, **dict(changed))

    four = simulate(mounted_rig, mixed_protocol(4), seed=3).campaign
    write_campaign(with_spots(four, swapped), tmp_path / "swapped")
    code, document = ask("fit", tmp_path / "swapped", "--no-sample")
    assert code == 4 and "swapped cameras" in document["error"]["remedy"]
    saved = json.loads((tmp_path / "swapped" / "results" / "fit.json").read_text(), parse_constant=no_constant)
    assert problems(saved, json.loads((DATA / "schemas" / "fit-1.schema.json").read_text())) == []


def test_a_spot_beyond_the_lens_and_one_twice_cost_themselves_only(ask, mounted_rig, tmp_path):
    """One that cannot be undistorted is left out by name; experiments without a ratio have no gap."""
    four = simulate(mounted_rig, mixed_protocol(2), seed=3).campaign
    selection = select_experiments(four)
    ups = set(selection.experiments[selection.direction == "up"].tolist())
    firsts = {s.experiment: s for s in four.spots if s.point == 1}
    lost = next(s.spot for s in four.spots if s.experiment not in ups)

    def spoilt(s):
        if s.spot == lost:
            return replace(s, u_left_px=1279.0, v_left_px=719.0)
        if s.experiment in ups and s.point == 2:
            names = ("u_left_px", "v_left_px", "u_right_px", "v_right_px")
            return replace(s, **{name: getattr(firsts[s.experiment], name) for name in names})
        return s

    stereo = replace(four.stereo, D1=np.array([-0.4, 0.0, 0.0, 0.0, 0.0]))
    write_campaign(replace(with_spots(four, spoilt), stereo=stereo), tmp_path / "c")
    code, document = ask("fit", tmp_path / "c", "--no-sample")
    assert code == 0 and document["excluded_spots"] == [lost]
    assert document["classic_predicted_deg_per_step"]["up"] is None
    saved = json.loads((tmp_path / "c" / "results" / "fit.json").read_text())
    assert saved["gap"]["up"] is None and saved["gap"]["down"] is not None


def test_looks_at_one_stop_have_nothing_to_tell(ask, small, tmp_path):
    seen = small.moves[small.spots[0].move]
    only = replace(small.moves[0], pan_steps=seen.pan_steps, tilt_steps=seen.tilt_steps)
    here = replace(small, moves=(only,), spots=tuple(s for s in small.spots if s.move == seen.move))
    repeated = [replace(s, spot=k, move=0, u_left_px=s.u_left_px + 0.02 * k) for k, s in enumerate(here.spots * 12)]
    write_campaign(replace(here, spots=tuple(repeated)), tmp_path / "c")
    code, document = ask("fit", tmp_path / "c", "--no-sample")
    assert (code, document["error"]["code"]) == (3, "uninformed")


def test_all_fixed_is_nothing_to_estimate(ask, small, tmp_path):
    priors = {name: replace(prior, u=0.0) for name, prior in small.rig.priors.items()}
    stereo = replace(small.stereo, parameter_covariance=np.zeros((24, 24)))
    write_campaign(replace(small, stereo=stereo, rig=replace(small.rig, priors=priors)), tmp_path / "c")
    code, document = ask("fit", tmp_path / "c", "--no-sample")
    assert (code, document["error"]["code"]) == (3, "nothing-free")


@pytest.mark.slow
@pytest.mark.parametrize(("u", "swap", "ends"), [(0.05, False, 0), (0.5, False, 0), (0.0, False, 0), (0.0, True, 4)])
def test_noise_above_the_stated_is_no_misfit(ask, small, tmp_path, u, swap, ends):
    """A misfit is a factor on the stated noise, however sure the noise was said to be; swapped cameras are one."""
    rng = np.random.default_rng(1)

    def louder(s):
        names = ("u_left_px", "v_left_px", "u_right_px", "v_right_px")
        pixels = [getattr(s, name) + 0.25 * rng.normal() for name in (names[2:] + names[:2] if swap else names)]
        return replace(s, **dict(zip(names, pixels, strict=True)))

    priors = {**small.rig.priors, "pixel_scale": Prior(1.0, u, "log-normal")}
    write_campaign(with_spots(replace(small, rig=replace(small.rig, priors=priors)), louder), tmp_path / "c")
    assert ask("fit", tmp_path / "c", "--no-sample")[0] == ends


def test_a_fit_that_did_not_converge_is_exit_4(ask, say, folder, monkeypatch):
    import tvsbayes

    fitted = tvsbayes.fit(read_campaign(folder))

    def astray(*arguments, **options):
        return replace(fitted, converged=False, problems=("it went astray",))

    monkeypatch.setattr("tvsbayes.estimators.joint_fit.fit", astray)
    code, document = ask("fit", folder, "--no-sample")
    assert code == 4
    assert document["converged"] is False
    assert "it went astray" in assert_error(document, "not-converged")["message"]
    code, _, log = say("fit", folder, "--no-sample")
    assert code == 4
    assert "NOT CONVERGED: it went astray" in log


def test_demo_shows_classic_and_joint_beside_the_truth(ask, tmp_path):
    out = tmp_path / "kept"
    code, document = ask("demo", out)
    assert code == 0
    assert set(document) == {"classic", "fit", "truth"}
    fit, truth = document["fit"], document["truth"]
    intervals = {d: fit["effective_deg_per_step"][d]["interval95"] for d in DIRECTIONS}
    names = ("backlash_deg.pan", "backlash_deg.tilt", "effective_mirror_offset_mm")
    intervals |= {name: fit["parameters"][name]["interval95"] for name in names}
    assert set(truth) == set(intervals)
    for name, (low, high) in intervals.items():
        assert low < truth[name] < high, name
    # The claim that the demo exists for: type A intervals of the classic estimator miss.
    for direction, result in document["classic"]["directions"].items():
        low, high = result["interval95_type_a"]
        assert not low < truth[direction] < high
    # What the joint model expects the classic estimator to say is what it says, within five sds of both.
    for direction, result in document["classic"]["directions"].items():
        predicted = fit["classic_predicted_deg_per_step"][direction]
        sd = np.hypot(predicted["sd"], result["u_type_a_deg_per_step"])
        assert abs(predicted["value"] - result["mean_deg_per_step"]) < 5 * sd
    assert (out / "truth.json").is_file()
    assert (out / "results" / "fit.json").is_file()
    assert ask("demo", out)[0] == 2


def test_readme_shows_what_the_demo_prints(say):
    """Same lines; each number within a tenth of its uncertainty (another processor rounds differently)."""
    readme = DATA.parent / "README.md"
    if not readme.is_file():
        pytest.skip("the README is not part of an installed package")
    shown = readme.read_text(encoding="utf-8").split("```text\n")[1].split("```")[0]
    code, out, _ = say("demo")
    assert code == 0
    number = re.compile(r"(-?\d+\.\d+)(?:\((\d+\.?\d*)\))?")
    assert [re.sub(r" +", " ", number.sub("#", line)) for line in out.splitlines()] == [
        re.sub(r" +", " ", number.sub("#", line)) for line in shown.splitlines()
    ]
    pairs = list(zip(number.finditer(out), number.finditer(shown), strict=True))
    assert len(pairs) == 4 * 3 + 3 * 2
    for (value, digits), (value_shown, digits_shown) in ((a.groups(), b.groups()) for a, b in pairs):
        unit = 10.0 ** -len(value.partition(".")[2])
        u = unit if digits is None else float(digits) * (1.0 if "." in digits else unit)
        assert abs(float(value) - float(value_shown)) <= max(0.1 * u, 1.01 * unit)
        assert (digits is None) == (digits_shown is None)


SPOILED = {
    "underscore": ("spots.csv", lambda text: text.replace(",ok", ",ok,9_4.7", 1), None),
    "missing move": ("spots.csv", lambda text: text.replace("\n0,", "\n0,99", 1), None),
    "NUL": ("moves.csv", lambda text: text + "\0", "control-character"),
    "unknown key": ("campaign.toml", lambda text: "colour = 'red'\n" + text, "unknown-key"),
    "no TOML": ("campaign.toml", lambda text: text + "\n[[", None),
    "NaN in JSON": ("stereo.json", lambda text: text.replace("1280", "NaN", 1), None),
    "deep JSON": ("stereo.json", lambda text: "[" * 100_000, None),
}


@pytest.mark.parametrize("name", SPOILED)
@pytest.mark.parametrize("command", ["check", "classic", "fit"])
def test_hostile_files_are_taught_errors(ask, say, folder, command, name):
    file, spoil, error_code = SPOILED[name]
    text = (folder / file).read_text()
    assert spoil(text) != text
    (folder / file).write_text(spoil(text))
    code, document = ask(command, folder)
    assert code == 2
    assert set(document) == {"error"}
    error = assert_error(document, error_code or document["error"]["code"])
    assert error["file"] == file
    code, out, log = say(command, folder)
    assert (code, out) == (2, "")
    assert log.startswith(f"error: {file}")
    assert "Traceback" not in log


@pytest.mark.parametrize(
    "arguments",
    [
        ("fit", "x", "--nope"),
        ("frobnicate",),
        ("classic",),
        ("simulate", "a", "b", "c", "--seed", "-1"),
        ("simulate", "a", "b", "c", "--seed", "many"),
    ],
)
def test_wrong_usage_is_bad_input(ask, say, arguments):
    code, document = ask(*arguments)
    assert code == 2
    assert set(document) == {"error"}
    assert_error(document, "usage")
    code, out, log = say(*arguments)
    assert (code, out) == (2, "")
    assert log


@pytest.mark.parametrize("command", ["check", "classic", "fit"])
def test_a_folder_that_is_not_there_is_bad_input(ask, tmp_path, command):
    code, document = ask(command, tmp_path / "nowhere")
    assert code == 2
    assert_error(document, "missing-file")


def test_control_characters_of_a_name_do_not_reach_the_terminal(say, tmp_path):
    code, out, log = say("check", tmp_path / "a\x1b[31mb")
    assert code == 2
    assert "\x1b" not in out + log


def test_check_tells_a_folder_from_a_file(ask, folder, tmp_path):
    shutil.copytree(folder, tmp_path / "camp.csv")
    code, document = ask("check", tmp_path / "camp.csv")
    assert code == 0 and document["spots"] > 0


def test_a_report_for_a_browser_that_is_not_there_ends_at_once(ask, folder, monkeypatch):
    monkeypatch.setattr("tvsbayes.report.page.BROWSERS", ())
    monkeypatch.setattr("tvsbayes.pipeline.document_for", None)
    monkeypatch.setattr("tvsbayes.cli.estimate_commands.document_for", None)
    code, document = ask("report", folder, "--pdf")
    assert (code, document["error"]["code"]) == (2, "no-browser")


def test_what_cannot_be_kept_costs_nobody_the_result(tmp_path, capsys):
    (tmp_path / "results").write_text("a file where the folder should be")
    assert not keep({}, tmp_path / "results" / "compare.json")
    assert "warning: not kept" in capsys.readouterr().err
    assert keep({"a": 1}, tmp_path / "new" / "compare.json")
    assert json.loads((tmp_path / "new" / "compare.json").read_text()) == {"a": 1}


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="Linux")
@pytest.mark.parametrize("arguments", [("check", "FOLDER", "--json"), ("check", "nothing here", "--json")])
def test_a_full_disk_behind_stdout_is_said_without_a_traceback(folder, arguments):
    words = [str(folder) if word == "FOLDER" else word for word in arguments]
    command = [sys.executable, "-c", "from tvsbayes.cli.main import main; main()", *words]
    with open("/dev/full", "w") as full:
        done = subprocess.run(command, stdout=full, stderr=subprocess.PIPE, text=True, check=False)
    assert done.returncode == 2 and "No space left" in done.stderr
    assert "Traceback" not in done.stderr


@pytest.mark.skipif(os.name != "posix", reason="pipes that break")
def test_a_reader_that_has_gone_changes_no_exit_code(folder):
    """As where Ctrl-C ends the `tee` behind a run, for both streams."""
    command = [sys.executable, "-c", "from tvsbayes.cli.main import main; main()", "check", "nothing here"]
    reader, writer = os.pipe()
    os.close(reader)
    done = subprocess.run(command, stdout=writer, stderr=writer, check=False)
    with_json = subprocess.run([*command, "--json"], stdout=writer, stderr=subprocess.PIPE, text=True, check=False)
    os.close(writer)
    assert (done.returncode, with_json.returncode, with_json.stderr) == (2, 2, "")


def test_interrupt_under_json_is_a_document_too(ask, monkeypatch):
    def interrupted(path):
        raise KeyboardInterrupt

    monkeypatch.setattr("tvsbayes.instrument.campaign.read_campaign", interrupted)
    monkeypatch.setattr("tvsbayes.acquisition.campaign_files.read_campaign", interrupted)
    code, document = ask("check", "x")
    assert (code, document["error"]["code"]) == (130, "interrupted")


def test_interrupt_is_130(say, monkeypatch):
    def interrupted(path):
        raise KeyboardInterrupt

    monkeypatch.setattr("tvsbayes.instrument.campaign.read_campaign", interrupted)
    monkeypatch.setattr("tvsbayes.acquisition.campaign_files.read_campaign", interrupted)
    code, out, log = say("classic", PAPER_TWIN)
    assert (code, out) == (130, "")
    assert "interrupted" in log


def test_a_bug_is_no_bad_input(monkeypatch):
    """Only errors a user can act on become exit codes; anything else must not be hidden."""

    def broken(path):
        raise RuntimeError("a bug")

    monkeypatch.setattr("tvsbayes.instrument.campaign.read_campaign", broken)
    monkeypatch.setattr("tvsbayes.acquisition.campaign_files.read_campaign", broken)
    with pytest.raises(RuntimeError, match="a bug"):
        run(["classic", str(PAPER_TWIN)])


def test_the_version_is_the_packages(say):
    assert say("--version")[:2] == (0, f"tvsbayes {version('tvsbayes')}\n")


def test_help_loads_nothing_heavy_and_lists_the_commands():
    heavy = ("jax", "cv2", "scipy", "rich.table", "arviz", "emcee", "matplotlib", "equinox")
    code = (
        "import sys; from tvsbayes.cli.main import run; code = run(['--help']); "
        f"print([name for name in {heavy!r} if name in sys.modules], code, file=sys.stderr)"
    )
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert result.stderr.strip() == "[] 0"
    for command in ("demo", "new", "simulate", "check", "classic", "fit"):
        assert f"  {command} " in result.stdout


def test_whoever_waits_for_the_first_compilation_is_told(tmp_path, capsys, monkeypatch):
    import jax

    monkeypatch.setenv("TVSBAYES_CACHE", str(tmp_path))
    monkeypatch.setattr(jax.config, "update", lambda *_: None)
    compile_for(report_line)
    assert capsys.readouterr().err == "", "progress is for terminals"
    monkeypatch.setattr(sys.stderr, "isatty", lambda: True, raising=False)
    compile_for(report_line)
    assert "first run" in capsys.readouterr().err
    (tmp_path / "jit_fit-cache").touch()
    compile_for(report_line)
    assert capsys.readouterr().err == ""


def test_a_slow_computers_user_is_not_sent_to_the_authors_of_xla(monkeypatch):
    monkeypatch.setenv("TF_CPP_MIN_LOG_LEVEL", "")
    monkeypatch.delenv("TF_CPP_MIN_LOG_LEVEL")
    monkeypatch.setattr(sys, "argv", ["tvsbayes", "--help"])
    with pytest.raises(SystemExit):
        main()
    assert os.environ["TF_CPP_MIN_LOG_LEVEL"] == "3"
