"""Clouds: what stands in them, what is refused, files whole or not at all, memory that does not grow."""

from __future__ import annotations

import csv
from collections.abc import Iterator

import numpy as np
import pytest
from plyfile import PlyData
from support.bent_rig import ROUNDING_MM, calibration

from tvsbayes.coordinates.cloud import CHECKED_MAX, EvenSample, checked, cloud
from tvsbayes.coordinates.cloud_files import cloud_place, columns_of, write_cloud
from tvsbayes.coordinates.location import Settings, locate_linear, settings_of
from tvsbayes.coordinates.looks_file import BLOCK_ROWS, LOOKS, look_blocks
from tvsbayes.coordinates.simple_calibration import SimpleCalibration, simple_rays
from tvsbayes.errors import InputError

SIMPLE = {"nominal": SimpleCalibration({"left": 0.06, "right": 0.05, "up": 0.07, "down": 0.08}, 170.0, 70.0, 88.0, 0.0)}
FLOAT32 = 2.0**-23
"""Relative step of what a PLY holds."""
BEHIND_DEG = 150.0
"""A reading that no beam of these looks meets."""


def looks(count: int, seed: int = 1, first_line: int = 2) -> Settings:
    """Drawn looks; every seventh has no point."""
    generator = np.random.default_rng(seed)
    pan, tilt = generator.uniform(-80, 80, count), generator.uniform(-60, 60, count)
    reading = np.where(np.arange(count) % 7 == 6, BEHIND_DEG, generator.uniform(60, 75, count))
    sides = zip(generator.choice(["left", "right"], count), generator.choice(["up", "down"], count), strict=True)
    approach = [(str(one), str(other)) for one, other in sides]
    return settings_of(pan, tilt, reading, approach, range(first_line, first_line + count))


def test_points_are_those_of_the_law_and_of_the_published_equations():
    one, rows = calibration(), looks(50)
    (block,) = cloud(one, [rows], SIMPLE)
    law = locate_linear(one, rows)
    met = np.isfinite(law.value).all(axis=1)
    np.testing.assert_array_equal(block.xyz_mm, law.value[met])
    np.testing.assert_array_equal(block.sd_mm, np.sqrt(np.diagonal(law.covariance[met], 0, 1, 2)))
    np.testing.assert_array_equal(block.lines, np.arange(2, 52)[met])
    assert [line for line, _ in block.refused] == [2 + k for k in range(6, 50, 7)]
    assert {error.code for _, error in block.refused} == {"diverging"}
    # A simple calibration's point lies on its beam, and the aperture, 170 mm from the beam's origin, reads the angle.
    ray = simple_rays(SIMPLE["nominal"], rows.steps[met])
    along = block.simple_xyz_mm["nominal"].T - ray.origin_mm
    np.testing.assert_allclose(np.cross(along, ray.direction, axis=0), 0.0, atol=ROUNDING_MM)
    sight = block.simple_xyz_mm["nominal"] - [0.0, 70.0 - 170.0, 0.0]
    angle = np.degrees(np.arccos(sight[:, 1] / np.linalg.norm(sight, axis=1)))
    # In deg of an angle seen from 100 mm the same is more than enough.
    np.testing.assert_allclose(angle, rows.aperture_deg[met], atol=ROUNDING_MM)


def test_a_cloud_holds_what_a_robot_is_given_and_no_more():
    """Readings up to the one that beam and line of sight never meet under, with u that grows on the way there."""
    reading = np.linspace(85.0, 91.5, 40)
    count, rows = len(reading), settings_of(20.0, 10.0, reading)
    one, code = calibration(), []
    for deg in reading:
        try:
            one.locate(20.0, 10.0, deg)
        except InputError as error:
            code.append(error.code)
        else:
            code.append(None)
    (block,) = cloud(one, [rows], {})
    law = np.isfinite(locate_linear(one, rows).value).all(axis=1)
    kept = np.array([each is None for each in code])
    # Some have a point of the estimates that more than a thousandth of the draws have not.
    assert 0 < kept.sum() < law.sum() < count
    np.testing.assert_array_equal(block.lines, np.flatnonzero(kept))
    assert [(line, error.code) for line, error in block.refused] == [(k, c) for k, c in enumerate(code) if c]


def test_both_formats_hold_the_same_and_a_foreign_reader_opens_them(tmp_path):
    one, blocks = calibration(), [looks(40), looks(30, seed=2, first_line=42)]
    ply, table = (
        write_cloud(cloud(one, blocks, SIMPLE), tmp_path / f"c.{kind}", ["nominal"]) for kind in ("ply", "csv")
    )
    assert (
        (ply.written, ply.refused, ply.reasons)
        == (61, 9, {"diverging": 9})
        == (table.written, table.refused, table.reasons)
    )
    vertices = PlyData.read(str(ply.cloud))["vertex"].data
    assert vertices.dtype.names == columns_of(["nominal"]) == ply.columns
    with open(table.cloud, newline="") as stream:
        rows = list(csv.DictReader(stream))
    for name in columns_of(["nominal"]):
        column = name if name in ("line", "extrapolated") else f"{name}_mm"
        written = np.array([float(row[column]) for row in rows])
        # Four digits after the point against single precision.
        np.testing.assert_allclose(vertices[name], written, atol=0.5e-4, rtol=FLOAT32)
    expected = np.concatenate([block.xyz_mm for block in cloud(one, blocks, SIMPLE)])
    np.testing.assert_allclose(np.stack([vertices[axis] for axis in "xyz"], axis=1), expected, rtol=FLOAT32)
    with open(ply.refused_file, newline="") as stream:
        assert [int(row["line"]) for row in csv.DictReader(stream)] == [*range(8, 42, 7), *range(48, 72, 7)]


def test_the_table_of_an_earlier_cloud_goes_and_a_foreign_file_of_its_name_stays(tmp_path):
    place, table = tmp_path / "c.ply", tmp_path / "c.refused.csv"
    assert write_cloud(cloud(calibration(), [looks(20)], {}), place, []).refused == 2 and table.exists()
    assert write_cloud(cloud(calibration(), [looks(6)], {}), place, []).refused_file is None
    assert not table.exists(), "it would tell of looks that are not refused"
    table.write_text("my own notes\n")
    write_cloud(cloud(calibration(), [looks(6)], {}), place, [])
    assert table.read_text() == "my own notes\n"


@pytest.mark.parametrize("name", ["looks.csv", "looks.refused.csv"])
def test_a_cloud_does_not_replace_the_looks_that_it_is_made_of(tmp_path, name):
    file = tmp_path / name
    file.write_text("measured\n")
    with pytest.raises(InputError) as refused:
        cloud_place(tmp_path / "looks.csv", file)
    assert refused.value.code == "usage" and name in refused.value.message
    assert cloud_place(tmp_path / "other.csv", file) == tmp_path / "other.csv"


def test_what_fails_half_way_leaves_the_old_cloud(tmp_path):
    def failing() -> Iterator[Settings]:
        yield looks(20)
        raise InputError("number", "a bad cell")

    place = tmp_path / "c.csv"
    place.write_text("old")
    with pytest.raises(InputError, match="a bad cell"):
        write_cloud(cloud(calibration(), failing(), SIMPLE), place, ["nominal"])
    assert place.read_text() == "old" and len(list(tmp_path.iterdir())) == 1
    with pytest.raises(InputError) as refused:
        write_cloud([], tmp_path / "c.xyz", [])
    assert ".ply" in str(refused.value.remedy)


@pytest.mark.parametrize("count", [1, CHECKED_MAX, 3 * CHECKED_MAX + 1])
def test_the_sample_is_even_whatever_the_blocks(count):
    rows = looks(count)
    samples = []
    for size in (count, 7):
        sample = EvenSample()
        parts = (rows[k : k + size] for k in range(0, count, size))
        assert sum(map(len, sample.of(parts))) == count
        samples.append(sample.looks.lines.tolist())
    assert samples[0] == samples[1] and len(samples[0]) <= CHECKED_MAX
    stride = 1 if count <= CHECKED_MAX else 4
    assert samples[0] == rows.lines[::stride].tolist()


def test_the_law_is_checked_by_draws():
    sample = EvenSample()
    list(sample.of([looks(28)]))
    check = checked(calibration(), sample.looks, 600, 0)
    assert check.points == 24 and 0 < check.held <= 24
    # Half of the points differ by less than the worst one; none by as much as the ranges themselves.
    assert 0 < check.off_mm < check.most_off_mm < 1000


def test_files_are_read_in_blocks_with_the_lines_of_the_file(tmp_path):
    """A bad cell behind the first block is named by its own line; shares of the file rise to one."""
    file, shares = tmp_path / "looks.csv", []
    rows = ["10,20,left,up,70"] * (BLOCK_ROWS + 5)
    file.write_text("\n".join([",".join(LOOKS.required), *rows]) + "\n")
    blocks = list(look_blocks(file, shares.append))
    assert [len(block.lines) for block in blocks] == [BLOCK_ROWS, 5]
    assert (blocks[0].lines[0], blocks[1].lines[0], blocks[1].lines[-1]) == (2, BLOCK_ROWS + 2, BLOCK_ROWS + 6)
    assert shares == sorted(shares) and shares[-1] == 1.0
    rows[BLOCK_ROWS + 1] = "10,20,left,up,7O"
    file.write_text("\n".join([",".join(LOOKS.required), *rows]) + "\n")
    with pytest.raises(InputError) as refused:
        list(look_blocks(file))
    assert (refused.value.line, refused.value.column) == (BLOCK_ROWS + 3, "aperture_deg")
    file.write_text(",".join(LOOKS.required) + "\n")
    with pytest.raises(InputError, match="no points"):
        list(look_blocks(file))
