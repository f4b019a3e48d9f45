"""The files in `results/`: whole or not at all, and read back."""

from __future__ import annotations

import json
import math
import os

import numpy as np
import pytest
from msgspec import structs
from support.commands import no_constant
from support.small_campaign import small_campaign
from support.small_results import small_draws, small_mode, small_record, small_summary

from tvsbayes.calibration.pointing import INPUT_NAMES, NOISE_NAMES, Calibration
from tvsbayes.errors import InputError
from tvsbayes.instrument.campaign import input_hashes
from tvsbayes.instrument.mechanisms import SIGHTING_HEAD
from tvsbayes.instrument.parameters import STEREO_PARAMETER_NAMES
from tvsbayes.pipeline import load_calibration
from tvsbayes.results.stored_draws import StoredMode, write_results


def test_results_are_two_files_with_their_provenance(tmp_path):
    summary, folder = small_summary(), tmp_path / "new" / "results"
    paths = write_results(folder, small_record(summary, seed=5), small_draws())
    assert paths == {"draws": str(folder / "draws.npz"), "fit": str(folder / "fit.json")}
    assert sorted(path.name for path in folder.iterdir()) == ["draws.npz", "fit.json"]
    document = json.loads((folder / "fit.json").read_text(), parse_constant=no_constant)
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


def test_a_head_that_also_stored_what_it_lacks_keeps_its_own():
    """0.3.0 wrote the scanner's cameras, as coordinates that nothing moves, into the draws of a head with sightings."""
    own, rig = SIGHTING_HEAD.names, len(SIGHTING_HEAD.rig_names)
    names = (*own[:3], "baseline_mm", *own[3:], *STEREO_PARAMETER_NAMES)
    numbers = np.arange(len(names), dtype=float)
    prior = np.tile(numbers[: rig + 1], (2, 1))
    stored = StoredMode(names, numbers, np.diag(numbers), 1.0, prior, np.ones(4), np.ones(4))
    kept = stored.of(own, SIGHTING_HEAD.rig_names)
    np.testing.assert_array_equal(kept.z, np.delete(numbers[: rig + 1], 3))
    np.testing.assert_array_equal(np.diag(kept.covariance), kept.z)
    np.testing.assert_array_equal(kept.prior, [kept.z, kept.z])
    assert kept.names == own and stored.of((*own, "new"), SIGHTING_HEAD.rig_names) is None


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
    write_results(tmp_path, small_record(), small_draws(), calibration, small_mode())
    loaded = load_calibration(tmp_path)
    assert (loaded.estimator, loaded.overshoot_steps["tilt"]) == ("posterior", 4)
    np.testing.assert_array_equal(loaded.mean, calibration.mean)
    np.testing.assert_array_equal(loaded.inputs, calibration.inputs)
    with np.load(tmp_path / "draws.npz", allow_pickle=False) as draws:
        assert draws["physical"].shape == (50, 3)
        assert str(draws["estimator"]) == "posterior"
    write_results(tmp_path, small_record(), small_draws())
    with pytest.raises(InputError, match="did not converge"):
        load_calibration(tmp_path)


def test_nan_is_written_nowhere(tmp_path):
    with pytest.raises(ValueError, match="JSON"):
        summary = structs.replace(small_summary(), reference_pose_deg={"pan": math.nan, "tilt": 0.5})
        write_results(tmp_path / "results", small_record(summary), small_draws())
    assert not (tmp_path / "results").exists()


def test_a_failed_write_leaves_the_old_result_whole(tmp_path, monkeypatch):
    write_results(tmp_path, small_record(seed=1), small_draws())
    before = (tmp_path / "fit.json").read_bytes()
    replace_file = os.replace

    def full(source, target):
        if str(target).endswith("fit.json"):
            raise OSError(28, "No space left on device")
        replace_file(source, target)

    monkeypatch.setattr(os, "replace", full)
    with pytest.raises(InputError, match="No space left"):
        write_results(tmp_path, small_record(seed=2), small_draws())
    assert (tmp_path / "fit.json").read_bytes() == before
    assert sorted(path.name for path in tmp_path.iterdir()) == ["draws.npz", "fit.json"]


def test_a_file_where_the_folder_should_be_is_bad_input(tmp_path):
    (tmp_path / "results").write_text("")
    with pytest.raises(InputError):
        write_results(tmp_path / "results", small_record(), small_draws())
