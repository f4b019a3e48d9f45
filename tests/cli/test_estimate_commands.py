"""`classic`, `fit`, `report`, `compare`: documents, files and exit codes."""

from __future__ import annotations

import json
from dataclasses import replace
from functools import partial

import numpy as np
import pytest
from support.commands import (
    ESTIMATE_KEYS,
    PAPER_TWIN,
    assert_error,
    no_constant,
    with_spots,
)
from support.fit_documents import problems, shipped_schema

from tvsbayes.estimators import joint_fit
from tvsbayes.estimators.four_point import select_experiments
from tvsbayes.inference import diagnosis, ensemble, importance
from tvsbayes.instrument.axes import DIRECTIONS
from tvsbayes.instrument.campaign import read_campaign, write_campaign
from tvsbayes.instrument.parameters import Prior
from tvsbayes.instrument.protocols import mixed_protocol
from tvsbayes.posterior import sampling
from tvsbayes.twin.simulated_campaign import simulate

pytestmark = pytest.mark.usefixtures("own_compilation_cache", "each_fitted_once")


def test_classic_document_has_the_documented_keys(ask):
    code, document = ask("classic", PAPER_TWIN)
    assert code == 0
    assert set(document) == {"directions", "experiments", "skipped"}
    keys = {
        *("n", "mean_deg_per_step", "sd_deg_per_step", "u_type_a_deg_per_step", "interval95_type_a"),
        *("u_gum_deg_per_step", "interval95_gum", "u_stereo_deg_per_step", "effective_dof", "outlier"),
    }
    assert list(document["directions"]) == list(DIRECTIONS)
    for result in document["directions"].values():
        assert set(result) == keys
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


def test_fit_document_has_the_documented_keys_and_files(ask, grid_folder):
    code, document = ask("fit", grid_folder, "--no-sample")
    assert code == 0
    assert (document["estimator"], document["converged"], document["seed"]) == ("laplace", True, 0)
    assert list(document["effective_deg_per_step"]) == list(DIRECTIONS)
    assert set(document["reference_pose_deg"]) == {"pan", "tilt"}
    for estimate in (*document["parameters"].values(), *document["effective_deg_per_step"].values()):
        assert set(estimate) == ESTIMATE_KEYS
        assert estimate["rhat"] is estimate["ess_bulk"] is estimate["ess_tail"] is None
    for direction in DIRECTIONS:
        assert document["effective_deg_per_step"][direction]["contraction"] > 0.9
    assert {"chi2", "dof", "pixel_scale"} <= set(document["noise"])
    assert document["noise"]["pixel_scale"] == document["parameters"]["pixel_scale"]["value"]
    assert all({"text", "loadings"} <= set(weak) for weak in document["weak_directions"])
    assert document["excluded_spots"] == []
    assert document["files"] == {
        "draws": str(grid_folder / "results" / "draws.npz"),
        "fit": str(grid_folder / "results" / "fit.json"),
    }
    saved = json.loads((grid_folder / "results" / "fit.json").read_text(), parse_constant=no_constant)
    assert saved["format"] == "tvsbayes-fit/1"
    assert problems(saved, shipped_schema("fit-1")) == []
    assert {**{key: saved[key] for key in document if key != "files"}, "files": document["files"]} == document
    with np.load(grid_folder / "results" / "draws.npz", allow_pickle=False) as draws:
        assert draws["effective_deg_per_step"].shape == (len(draws["physical"]), 4)
        column = list(draws["names"]).index("backlash_deg.pan")
        sd = document["parameters"]["backlash_deg.pan"]["sd"]
        assert draws["physical"][:, column].std() == pytest.approx(sd, rel=1e-9)


def test_fit_for_people_names_value_interval_and_origin(say, grid_folder, tmp_path):
    out = tmp_path / "elsewhere"
    out.mkdir()
    (out / "posterior.nc").write_bytes(b"of an earlier fit")
    code, text, log = say("fit", grid_folder, "--no-sample", "--out", out)
    assert code == 0
    assert not (out / "posterior.nc").exists() and "posterior.nc of an earlier fit is removed" in log
    row = next(line for line in text.splitlines() if line.startswith("effective left"))
    assert row.split()[-1] == "data"
    assert str(out / "fit.json") in text
    assert (out / "draws.npz").is_file()
    assert not (grid_folder / "results").exists()


@pytest.mark.slow
def test_fit_samples_writes_for_arviz_and_keeps_the_better_answer(ask, grid_folder, monkeypatch):
    """The limits are loosened: the test covers options and files, not convergence."""
    import arviz

    for module, loose in (
        (ensemble, {"FIRST_CHECK": 40, "BLOCK": 20, "TAU_LIMIT": 1}),
        (diagnosis, {"ESS_LIMIT": 50, "RHAT_LIMIT": 3.0, "TAU_LIMIT": 1}),
        (diagnosis, {"AGREEMENT_LIMIT": 100.0, "STUCK_ACCEPTANCE": 0.0, "STUCK_DEVIATION": 1e9}),
    ):
        for name, value in loose.items():
            monkeypatch.setattr(module, name, value)
    code, document = ask("fit", grid_folder, "--seed", 2, "--chain")
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

    monkeypatch.setattr(diagnosis, "ESS_LIMIT", 10**9)
    code, document = ask("fit", grid_folder, "--seed", 2, "--resume", "--max-minutes", "0.01")
    # A chain that ends too soon is a better answer than weighted draws which allow only Laplace's.
    assert (code, document["answer"], document["tier"]) == (0, "rough", "emcee")
    assert document["monte_carlo_error"]["effective_deg_per_step.left"]["mean"] <= 0.3
    code, document = ask("fit", grid_folder, "--seed", 3, "--resume")
    assert (code, document["error"]["code"]) == (2, "other-chain")


@pytest.mark.slow
def test_unreliable_weights_fall_back_to_laplace_with_a_warning(ask, say, grid_folder, monkeypatch):
    """The posterior is proper and its mode explains the data: there is an answer, and exit code 0."""
    for name, value in {"ROUNDS_LEAST": 1, "K_MAX": 0.0, "ROUGH_K_MAX": 0.0}.items():
        monkeypatch.setattr(importance, name, value)
    monkeypatch.setattr(sampling, "importance_run", partial(sampling.importance_run, rounds_max=3))
    code, document = ask("fit", grid_folder, "--quick")
    assert (code, document["estimator"], document["answer"], document["converged"]) == (0, "laplace", "laplace", False)
    assert document["problems"][0].startswith("LAPLACE: the weights of importance sampling have Pareto k")
    code, text, _ = say("fit", grid_folder, "--quick")
    assert code == 0 and "not sampled: the weights of importance sampling have Pareto k" in text
    assert "\nverdict: usable with care: the posterior could not be sampled" in text


def test_too_few_spots_are_nothing_to_estimate(ask, grid_campaign, tmp_path):
    write_campaign(replace(grid_campaign, spots=grid_campaign.spots[:7]), tmp_path / "few")
    code, document = ask("fit", tmp_path / "few", "--no-sample")
    assert code == 3
    assert_error(document, "too-few-spots")
    assert not (tmp_path / "few" / "results").exists()


@pytest.mark.thorough
def test_swapped_cameras_give_a_warning_and_files(ask, mounted_rig, tmp_path):
    """Pixels outside the lens model and remote draws give no number that JSON cannot hold."""

    def swapped(s):
        left, right = (s.u_left_px, s.v_left_px), (s.u_right_px, s.v_right_px)
        changed = zip(("u_left_px", "v_left_px", "u_right_px", "v_right_px"), (*right, *left), strict=True)
        return replace(s, **dict(changed))

    four = simulate(mounted_rig, mixed_protocol(4), seed=3).campaign
    write_campaign(with_spots(four, swapped), tmp_path / "swapped")
    code, document = ask("fit", tmp_path / "swapped", "--no-sample")
    error = assert_error(document, "cameras-swapped")
    assert (code, error["file"], error["line"]) == (2, "spots.csv", 2) and "--anyway" in error["remedy"]
    assert not (tmp_path / "swapped" / "results").exists()
    code, document = ask("fit", tmp_path / "swapped", "--no-sample", "--anyway")
    assert code == 4 and "are left and right swapped" in document["error"]["remedy"]
    saved = json.loads((tmp_path / "swapped" / "results" / "fit.json").read_text(), parse_constant=no_constant)
    assert problems(saved, shipped_schema("fit-1")) == []


@pytest.mark.thorough
def test_a_spot_outside_the_lens_model_and_a_duplicate_are_left_out(ask, mounted_rig, tmp_path):
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


def test_all_fixed_is_nothing_to_estimate(ask, grid_campaign, tmp_path):
    priors = {name: replace(prior, u=0.0) for name, prior in grid_campaign.rig.priors.items()}
    stereo = replace(grid_campaign.stereo, parameter_covariance=np.zeros((24, 24)))
    write_campaign(replace(grid_campaign, stereo=stereo, rig=replace(grid_campaign.rig, priors=priors)), tmp_path / "c")
    code, document = ask("fit", tmp_path / "c", "--no-sample")
    assert (code, document["error"]["code"]) == (3, "nothing-free")


@pytest.mark.slow
@pytest.mark.parametrize(("u", "swap", "ends"), [(0.05, False, 0), (0.5, False, 0), (0.0, False, 0), (0.0, True, 4)])
def test_noise_larger_than_stated_is_no_misfit(ask, grid_campaign, tmp_path, u, swap, ends):
    """A misfit is a factor on the stated noise, whatever its uncertainty; swapped cameras are one."""
    rng = np.random.default_rng(1)

    def louder(s):
        names = ("u_left_px", "v_left_px", "u_right_px", "v_right_px")
        pixels = [getattr(s, name) + 0.25 * rng.normal() for name in (names[2:] + names[:2] if swap else names)]
        return replace(s, **dict(zip(names, pixels, strict=True)))

    priors = {**grid_campaign.rig.priors, "pixel_scale": Prior(1.0, u, "log-normal")}
    write_campaign(
        with_spots(replace(grid_campaign, rig=replace(grid_campaign.rig, priors=priors)), louder), tmp_path / "c"
    )
    assert ask("fit", tmp_path / "c", "--no-sample", *["--anyway"] * swap)[0] == ends


def test_a_fit_that_did_not_converge_is_exit_4(ask, say, grid_folder, monkeypatch):
    fit = joint_fit.fit

    def astray(*arguments, **options):
        return replace(fit(*arguments, **options), converged=False, problems=("it went astray",))

    monkeypatch.setattr("tvsbayes.estimators.joint_fit.fit", astray)
    code, document = ask("fit", grid_folder, "--no-sample")
    assert code == 4
    assert document["converged"] is False
    assert "it went astray" in assert_error(document, "not-converged")["message"]
    code, _, log = say("fit", grid_folder, "--no-sample")
    assert code == 4
    assert "NOT CONVERGED: it went astray" in log


def test_without_experiments_compare_fits_nothing(ask, grid_folder, monkeypatch):
    monkeypatch.setattr("tvsbayes.cli.estimate_commands.StoredOrFitted", None)
    code, document = ask("compare", grid_folder)
    assert code == 3 and "--by positions" in assert_error(document, "no-experiments")["remedy"]
