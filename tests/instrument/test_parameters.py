"""The registry of parameters: one entry each, in an order that stored draws and results rely on."""

from __future__ import annotations

from tvsbayes.instrument.mechanisms import TWO_MIRROR
from tvsbayes.instrument.parameters import BLOCKS, names_of, unit_of


def test_the_order_of_stored_draws():
    """The order of `draws.npz` and of every covariance of results is that of earlier results."""
    blocks = (
        *("degrees_per_step", "ratio_contrast_deg_per_step", "backlash_deg", "tilt_zero_deg", "mirror_offset_mm"),
        *("mirror1_error_deg", "mirror2_error_deg", "laser_tilt_deg", "laser_offset_mm", "tilt_axis_skew_deg"),
        *("tilt_axis_offset_mm", "extrinsics.rotation_rad", "extrinsics.translation_mm", "stop_sd_deg"),
        *("pixel_scale", "focal_scale", "baseline_mm", "pan_zero_emission_deg", "aperture_zero_deg"),
        *("aperture_sd_deg", "harmonic_deg", "transmission_error_deg", "transmission_error_length_deg"),
        *("play_variation_deg", "drift_deg_per_root_hour", "harmonic_amplitude_deg", "look_scatter_deg"),
        *("creep_deg", "creep_minutes", "thermal_deg_per_K", "home_sd_deg"),
        *("stereo.left", "stereo.right", "stereo.rotation_rad", "stereo.translation_mm"),
    )
    assert TWO_MIRROR.names == names_of(*blocks), "the parameters of a block follow each other"
    assert BLOCKS["stop_sd_deg"] == tuple(f"stop_sd_deg.{d}" for d in ("left", "right", "up", "down"))
    assert BLOCKS["harmonic_deg"][:3] == ("harmonic_deg.pan.1.cos", "harmonic_deg.pan.1.sin", "harmonic_deg.pan.2.cos")
    cameras = ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2", "k3")
    assert BLOCKS["stereo.right"] == tuple(f"stereo.right.{name}" for name in cameras)


def test_every_prior_is_in_one_group():
    assert next(iter(TWO_MIRROR.prior_groups)) == "stereo calibration"
    assert TWO_MIRROR.prior_groups["stereo calibration"] == list(
        range(len(TWO_MIRROR.rig_names), len(TWO_MIRROR.names))
    )
    plays = TWO_MIRROR.prior_groups["prior of backlash_deg"]
    assert [TWO_MIRROR.names[column] for column in plays] == list(BLOCKS["backlash_deg"])
    assert len(TWO_MIRROR.prior_groups["prior of extrinsics"]) == 6 and len(TWO_MIRROR.prior_groups["focal scale"]) == 1
    assert sorted(column for group in TWO_MIRROR.prior_groups.values() for column in group) == list(
        range(len(TWO_MIRROR.names))
    )


def test_units_of_contract_names():
    units = {
        "effective_deg_per_step.left": "deg/step",
        "degrees_per_step.pan": "deg/step",
        "ratio_contrast_deg_per_step.tilt": "deg/step",
        "backlash_deg.pan": "deg",
        "mirror_offset_mm": "mm",
        "extrinsics.rotation_rad.x": "rad",
        "extrinsics.translation_mm.z": "mm",
        "effective_contrast_deg_per_step.pan": "deg/step",
        "effective_mirror_offset_mm": "mm",
        "stereo.left.cy": "px",
        "stereo.right.k3": "1",
        "stereo.rotation_rad.z": "rad",
        "focal_scale": "1",
    }
    assert {name: unit_of(name) for name in units} == units
