"""A head in a URDF: terms of its joints, refusals, and the round trip through an independent parser."""

from __future__ import annotations

import math
from io import BytesIO
from pathlib import Path

import numpy as np
import pytest

from tvsbayes.errors import InputError
from tvsbayes.head.urdf import HeadModel, ratios_of
from tvsbayes.importing.urdf import head_joints
from tvsbayes.instrument.axes import AXES
from tvsbayes.instrument.chains import chain_of
from tvsbayes.instrument.mechanisms import HEAD, SIGHTING_HEAD
from tvsbayes.instrument.parameters import BLOCKS, REGISTRY, TERMS

UNIT = (Path(__file__).parent / "unit.urdf").read_bytes()
BY_NAME = dict.fromkeys(AXES)
ROUNDING = 1e-9
"""Of unit vectors: numbers are written with 12 digits."""
TERM_NAMES = [term.name for term in TERMS]
OFF = {
    "azimuth_zero_deg": 3.0,
    "elevation_zero_deg": -2.0,
    "azimuth_axis_tilt_deg.north": 0.3,
    "azimuth_axis_tilt_deg.east": -0.2,
    "axes_not_square_deg": 0.25,
    "beam_not_square_deg": -0.4,
    "elevation_axis_offset_mm": 0.6,
}
"""What an estimate may differ by from the nominal head."""


def beam_of(terms, azimuth_deg, elevation_deg):
    """Origin (m) over the pan joint but for its height, and direction, for angles from the joints' zeros."""
    unit = {"deg": math.pi / 180, "mm": 1.0}

    def block(name: str) -> float | list[float]:
        parts = [unit[REGISTRY[part].unit] * terms.get(part, 0.0) for part in BLOCKS[name]]
        return parts if len(parts) > 1 else parts[0]

    optics = chain_of(HEAD, block)
    ray = optics.leaving(math.radians(azimuth_deg), math.radians(elevation_deg + terms["elevation_zero_deg"]), np)
    return np.array([*ray.direction], dtype=float)


def by_another_parser(data, pan, tilt):
    """Direction of x of the tilt link in the mast's frame, by yourdfpy."""
    yourdfpy = pytest.importorskip("yourdfpy", exc_type=ImportError)
    robot = yourdfpy.URDF.load(BytesIO(data), load_meshes=False, build_scene_graph=True)
    robot.update_cfg({"pan_joint": pan, "tilt_joint": tilt})
    return robot.get_transform("tilt_link", "mast")


def model(head, steps_per_turn=None, **off):
    terms = {name: head.terms.get(name, 0.0) + off.get(name, 0.0) for name in TERM_NAMES}
    ratios = {name: value * off.get(name, 1.0) for name, value in ratios_of(head, 200.0).items()}
    values = {**ratios, **terms}
    return HeadModel(
        tuple(values), np.array(list(values.values())), np.eye(len(values)), "a test", "ab12", steps_per_turn
    )


def test_terms_of_joints_are_those_of_the_chain():
    """Forward kinematics by hand: pan about z of its origin, tilt about y of the link on it."""
    head = head_joints(UNIT, "unit.urdf", BY_NAME)
    assert (head.names, head.sign) == ({"pan": "pan_joint", "tilt": "tilt_joint"}, {"pan": 1, "tilt": -1})
    assert head.limits_deg["pan"] is None
    assert head.limits_deg["tilt"] == pytest.approx((math.degrees(-0.5), math.degrees(1.2)))
    assert head.terms["elevation_axis_offset_mm"] == pytest.approx(30.0, abs=1e-6)
    x, y, z = 0.002, -0.003, 0.1
    turn = np.array([[math.cos(z), -math.sin(z), 0], [math.sin(z), math.cos(z), 0], [0, 0, 1]])
    turn = turn @ np.array([[math.cos(y), 0, math.sin(y)], [0, 1, 0], [-math.sin(y), 0, math.cos(y)]])
    turn = turn @ np.array([[1, 0, 0], [0, math.cos(x), -math.sin(x)], [0, math.sin(x), math.cos(x)]])
    for pan, tilt in ((0.0, 0.0), (0.7, 0.3), (-2.0, -0.6)):
        sight = turn @ np.array([math.cos(pan) * math.cos(tilt), math.sin(pan) * math.cos(tilt), -math.sin(tilt)])
        assert np.allclose(beam_of(head.terms, math.degrees(pan), -math.degrees(tilt)), sight, atol=ROUNDING)


def test_a_nominal_head_round_trips():
    """Except for the properties."""
    head = head_joints(UNIT, "unit.urdf", BY_NAME)
    written = model(head).urdf(head).decode()
    kept = [line for line in written.splitlines() if "xacro" not in line]
    lost = [line for line in UNIT.decode().splitlines() if line not in kept]
    assert lost == ['<robot name="unit">'] and len(kept) == len(UNIT.decode().splitlines()) - 1


def test_an_estimated_head_is_what_another_parser_reads():
    head = head_joints(UNIT, "unit.urdf", BY_NAME)
    head_model = model(head, 200.0, **OFF, **{"degrees_per_step.pan": 1.01})
    data = head_model.urdf(head)
    again = head_joints(data, "unit.urdf", BY_NAME)
    for name, off in OFF.items():
        assert again.terms[name] == pytest.approx(head.terms[name] + off, abs=1e-7), name
    assert again.reductions["pan"] == pytest.approx(-30 / 1.01) and again.reductions["tilt"] == 20
    lines, before = data.decode().splitlines(), UNIT.decode().splitlines()
    assert len([line for line in before if line not in lines]) == 5, "robot, two origins, one axis, one reduction"
    with pytest.raises(InputError, match="not applied twice"):
        head_model.urdf(again)
    terms = {name: again.terms[name] for name in OFF}
    for pan, tilt in ((0.0, 0.0), (0.7, 0.3), (-2.0, -0.6)):
        other = by_another_parser(data, pan, tilt)
        assert np.allclose(other[:3, 0], beam_of(terms, math.degrees(pan), -math.degrees(tilt)), atol=ROUNDING)


def test_a_joint_without_an_origin_gets_one():
    origin = b'    <origin rpy="0 0 -1.5707963267948966" xyz="0 -0.02 0.01" />\n'
    head = head_joints(UNIT.replace(origin, b"").replace(b"1.5707963267948966", b"0"), "unit.urdf", BY_NAME)
    terms = head_joints(model(head, **OFF).urdf(head), "unit.urdf", BY_NAME).terms
    for name, off in OFF.items():
        assert terms[name] == pytest.approx(head.terms[name] + off, abs=1e-7), name


def test_a_later_correction_takes_the_place_of_an_earlier_one():
    head = head_joints(UNIT, "unit.urdf", BY_NAME)
    once = model(head, **OFF)
    again = head_joints(once.urdf(head), "unit.urdf", BY_NAME)
    later = HeadModel(once.names, once.values, once.covariance, "a test", "cd34")
    twice = later.urdf(again).decode()
    assert twice.count("head_corrects") == 1 and "cd34" in twice
    assert head_joints(twice.encode(), "unit.urdf", BY_NAME).terms == pytest.approx(again.terms, abs=1e-9)


def test_without_a_model_there_are_properties():
    head = head_joints(UNIT, "unit.urdf", BY_NAME)
    text = model(head).urdf(None).decode()
    assert '<xacro:property name="head_corrects" value="ab12"/>' in text
    assert '<xacro:property name="head_pan_steps_per_rad" value="' in text
    document = model(head).document(head)
    assert np.shape(document["covariance"]) == (len(document["names"]),) * 2
    # A joint that turns down where elevation grows counts down.
    assert document["joints"]["tilt"]["steps_per_rad"] < 0 < document["joints"]["pan"]["steps_per_rad"]
    assert set(document["names"]) <= set(SIGHTING_HEAD.names) | set(TERM_NAMES)
