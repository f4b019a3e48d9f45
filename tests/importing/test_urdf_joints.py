"""Joints of a URDF as a head: refusals by line, what XML means by a number, and damaged files."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from support.damaged_files import damaged, few

from tvsbayes.errors import InputError
from tvsbayes.head.urdf import HeadModel, ratios_of
from tvsbayes.importing.urdf import HeadJoints, head_joints

UNIT = (Path(__file__).parents[1] / "head" / "unit.urdf").read_bytes()
BY_NAME = {"pan": None, "tilt": None}


@pytest.mark.parametrize(
    ("old", "new", "names", "message"),
    [
        (b"unit", b"unit", {"pan": "pn_joint"}, "did you mean pan_joint"),
        (b"unit", b"unit", {"pan": "foot"}, "joint foot is fixed"),
        (b"unit", b"unit", {"pan": "tilt_joint", "tilt": "pan_joint"}, "is not mounted on the pan joint"),
        (b'<axis xyz="0 1 0"/>', b'<axis xyz="0 0 1"/>', {}, "axes that cross"),
        (b'<axis xyz="0 1 0"/>', b'<axis xyz="1 0 0"/>', {}, "x looks ahead"),
        (b'name="unit"', b'name="${name}"', {}, "run `xacro FILE"),
        (b'<axis xyz="0 1 0"/>', b'<axis xyz="0 one 0"/>', {}, "finite numbers"),
        (b'<?xml version="1.0"?>', b'<!DOCTYPE robot [<!ENTITY a "b">]>', {}, "DOCTYPE"),
        (b"robot", b"sdf", {}, "SDF"),
        (b"</robot>", b"", {}, "XML"),
        (b"pan_joint", b"first", {}, None),
        (b'"continuous"', b'"fixed"', {}, "joints that turn: tilt_joint"),
    ],
)
def test_refusals_of_a_urdf_state_a_remedy(old, new, names, message):
    data = UNIT.replace(old, new)
    if message is None:
        assert head_joints(data, "unit.urdf", BY_NAME).names["pan"] == "first", "the only two that turn"
        return
    with pytest.raises(InputError) as refused:
        head_joints(data, "unit.urdf", {**BY_NAME, **names})
    assert message in refused.value.message + (refused.value.remedy or "")


def corrected(head: HeadJoints) -> bytes:
    """The file with its nominal terms and ratios."""
    values = {**head.terms, **ratios_of(head, 200.0)}
    numbers = np.array(list(values.values()))
    return HeadModel(tuple(values), numbers, np.eye(len(values)), "a test", "ab12", 200.0).urdf(head)


@pytest.mark.parametrize("text", ("-3&#48;", "-<!-- not 1 -->30", "-3<![CDATA[0]]>", " -30.0\n", "-3e1"))
def test_a_number_is_what_xml_says(text):
    """References to characters, comments inside, sections of characters: read, and replaced whole."""
    head = head_joints(UNIT.replace(b">-30<", f">{text}<".encode()), "unit.urdf", BY_NAME)
    assert head.reductions == {"pan": -30.0, "tilt": 20.0}
    again = head_joints(corrected(head), "again.urdf", BY_NAME)
    assert again.reductions == pytest.approx({"pan": -30.0, "tilt": 20.0})


@pytest.mark.parametrize("encoding", ("utf-16", "utf-16-be", "utf-8-sig", "iso-8859-1", "cp1252"))
def test_other_encodings_are_written_back_as_utf_8(encoding):
    name = "t\u00fcrm" if encoding != "utf-16-be" else "turm"
    text = UNIT.decode().replace("tilt_joint", f"tilt_{name}").replace('<?xml version="1.0"?>\n', "")
    start = "\ufeff" * encoding.endswith("-be") + f'<?xml version="1.0" encoding="{encoding.removesuffix("-sig")}"?>\n'
    head = head_joints((start.replace("-be", "") + text).encode(encoding), "head.urdf", BY_NAME)
    written = corrected(head)
    assert written.decode().startswith('<?xml version="1.0" encoding="UTF-8"?>')
    again = head_joints(written, "head.urdf", BY_NAME)
    assert again.terms == pytest.approx(head.terms) and again.names["tilt"] == f"tilt_{name}"


@pytest.mark.parametrize(
    ("old", "new"),
    [
        (b">20<", b">0<"),
        (b">20<", b">5e-324<"),
        (b">20<", b">1e308<"),
        (b">20<", b">nan<"),
        (b">20<", b"><"),
        (b'lower="-1.2"', b'lower="0.6"'),
        (b'upper="0.5"', b'upper="inf"'),
        (b'xyz="0 1 0"', b'xyz="0 5e-324 0"'),
        (b'xyz="0 0 0.05"', b'xyz="0 1e308 0.05"'),
        (b'name="lens"', b'name="pan_joint"'),
    ],
)
def test_absurd_numbers_are_refused_by_their_line(old, new):
    line = UNIT[: UNIT.index(old)].count(b"\n") + 1
    with pytest.raises(InputError) as refused:
        head_joints(UNIT.replace(old, new), "unit.urdf", BY_NAME)
    assert refused.value.line == line and refused.value.remedy


@few(60)
@given(damaged({"unit.urdf": UNIT}))
def test_damaged_files_are_heads_or_refused(case):
    """A head is written back as the same head."""
    try:
        head = head_joints(case[1], "unit.urdf", BY_NAME)
    except InputError as error:
        assert error.remedy
        return
    again = head_joints(corrected(head), "unit.urdf", head.names)
    assert again.terms == pytest.approx(head.terms, abs=1e-6)
