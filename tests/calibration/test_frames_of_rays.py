"""Rays in the frames of positioner and cameras, against the twin's optics and the draws themselves."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from support.bent_rig import AXES, BENT, ROUNDING, ROUNDING_MM, TWIN_SIDE, calibration, twin_angle_deg

from tvsbayes.calibration.drawn_looks import drawn
from tvsbayes.calibration.frames import EXTRINSICS_NAMES, P_INPUTS
from tvsbayes.calibration.states import poses_of
from tvsbayes.errors import InputError
from tvsbayes.instrument.axes import sides_of
from tvsbayes.instrument.mechanisms import SIGHTING_HEAD, TWO_MIRROR
from tvsbayes.instrument.stereo_pair import rotation_matrix
from tvsbayes.twin.physics import Sheet, light_on_sheet

STEPS, APPROACH = (200.0, -120.0), ("left", "down")
POSE = np.array([0.05, -0.12, 0.4, 12.0, 85.0, -40.0])
POSE_SD = np.array([2e-3, 2e-3, 3e-3, 0.5, 0.4, 0.6])


@pytest.fixture(scope="module")
def placed():
    """The bent rig before cameras, its pose in step with the mirror offset."""
    bent = calibration(BENT, draws=4000)
    off = np.random.default_rng(2).standard_normal((4000, 6))
    shared = (bent.inputs[:, :1] - bent.inputs[:, 0].mean()) / bent.inputs[:, 0].std()
    return replace(bent, extrinsics=POSE + POSE_SD * (0.8 * off + 0.6 * shared))


def angles_rad(values):
    angles = [
        twin_angle_deg(values, axis, n, TWIN_SIDE[side]) for axis, n, side in zip(AXES, STEPS, APPROACH, strict=True)
    ]
    return np.radians(angles)


def test_frame_s_is_where_the_twins_light_goes(placed):
    """The ray ends on the twin's sheet where the twin's light does; OpenCV's axes have z along the view, y down."""
    ray = placed.ray(*STEPS, APPROACH, frame="S")
    values = placed.estimates | dict(zip(EXTRINSICS_NAMES, placed.extrinsics.mean(axis=0), strict=True))
    light = light_on_sheet(*angles_rad(values), values, Sheet(np.array(300.0), np.array([1.0, 0.05, -0.04])))
    reach = np.linalg.norm(light.points_mm - ray.origin_mm)
    np.testing.assert_allclose(ray.origin_mm + reach * ray.direction, light.points_mm, atol=ROUNDING_MM)
    np.testing.assert_allclose(ray.direction, light.directions, atol=ROUNDING)
    camera = placed.ray(*STEPS, APPROACH, frame="camera")
    for in_s, in_camera in ((ray.origin_mm, camera.origin_mm), (ray.direction, camera.direction)):
        np.testing.assert_allclose(in_s, [in_camera[2], -in_camera[0], -in_camera[1]], atol=ROUNDING_MM)


def rays_of_draws(placed, frame):
    """Rays (draws, 6) of the draws, each with the noises of a look."""
    looks = drawn(placed, 40_000, seed=3)
    values = looks.values_at(placed, tuple(np.array([n]) for n in STEPS))
    values = {name: np.ravel(each) for name, each in values.items()} | ({} if frame == "T" else dict(P_INPUTS))
    beam = placed.noisy_beam(values, looks.noise.T, STEPS, sides_of(APPROACH))
    rays = np.array([*beam.origin, *beam.direction]).T
    if frame not in ("S", "camera"):
        return rays
    poses = placed.extrinsics[np.arange(len(rays)) % len(placed.extrinsics)]
    turns = np.array([rotation_matrix(pose[:3]) for pose in poses])
    origin = np.einsum("nij,nj->ni", turns, rays[:, :3]) + poses[:, 3:]
    rays = np.c_[origin, np.einsum("nij,nj->ni", turns, rays[:, 3:])]
    return rays if frame == "S" else np.c_[-rays[:, 1], -rays[:, 2], rays[:, 0], -rays[:, 4], -rays[:, 5], rays[:, 3]]


@pytest.mark.parametrize("frame", ["T", "P", "S", "camera"])
def test_covariance_is_that_of_the_draws(placed, frame):
    """Of the point 500 mm along the ray, in which origin and direction meet: sds within 3 %, correlations 0.03.

    40 000 draws of 4 000 rigs determine an sd to 1.1 %, a correlation to 0.016.
    """
    ray = placed.ray(*STEPS, APPROACH, frame=frame, covariance=True)
    along = np.c_[np.eye(3), 500.0 * np.eye(3)]
    expected = np.cov(rays_of_draws(placed, frame) @ along.T, rowvar=False)
    covariance = along @ ray.covariance @ along.T
    sd, ray_sd = np.sqrt(np.diag(expected)), np.sqrt(np.diag(covariance))
    np.testing.assert_allclose(ray_sd, sd, rtol=0.03)
    np.testing.assert_allclose(covariance / np.outer(ray_sd, ray_sd), expected / np.outer(sd, sd), atol=0.03)
    np.testing.assert_allclose(ray.covariance, ray.covariance.T, atol=1e-9)


def test_frames_that_there_are_not(placed, bent):
    with pytest.raises(InputError, match="frame 'Q'") as refused:
        placed.ray(*STEPS, frame="Q")
    assert refused.value.allowed == "T, P, S, camera"
    with pytest.raises(InputError, match="where the cameras stand") as refused:
        bent.ray(*STEPS, frame="camera")
    assert "results/" in refused.value.remedy


def test_a_head_with_sightings_stands_in_its_own_frame():
    """A scanner's draws without extrinsics have no pose instead."""
    for kind, poses in ((SIGHTING_HEAD, np.zeros((3, 6))), (TWO_MIRROR, np.zeros((0, 6)))):
        names = [name for name in kind.names if not name.startswith("extrinsics")]
        np.testing.assert_array_equal(poses_of(names, np.ones((3, len(names)))), poses)
    np.testing.assert_array_equal(poses_of(TWO_MIRROR.names, np.ones((3, len(TWO_MIRROR.names)))), np.ones((3, 6)))
