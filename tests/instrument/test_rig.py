"""Stereo calibrations, rotations, the `[rig]` table and rig files."""

from __future__ import annotations

import dataclasses
import json
import re
from pathlib import Path

import numpy as np
import pytest
from support.small_campaign import small_stereo

from tvsbayes.errors import InputError
from tvsbayes.files.documents import parse_toml
from tvsbayes.instrument.parameters import (
    HARMONIC_NAMES,
    RIG_PRIORS,
    STEREO_PARAMETER_NAMES,
    Prior,
)
from tvsbayes.instrument.rig import RigTable, parse_rig_table, read_rig, rig_table_toml
from tvsbayes.instrument.stereo_pair import read_stereo, rotation_matrix, rotation_vector, write_stereo

ROUNDING = 16 * np.finfo(float).eps  # a dozen roundings in a product of three matrices of order 1


def rig_table(text: str) -> RigTable:
    return parse_rig_table(parse_toml(text.encode(), "rig.toml").table("rig"))


def test_rotation_matrix_against_opencv():
    cv2 = pytest.importorskip("cv2")
    rng = np.random.default_rng(1)
    for length in (0.0, 1e-12, 1e-5, 0.3, 2.0, np.pi - 1e-9, np.pi):
        axis = rng.normal(size=3)
        vector = length * axis / np.linalg.norm(axis)
        assert np.abs(rotation_matrix(vector) - cv2.Rodrigues(vector)[0]).max() < ROUNDING


@pytest.mark.parametrize("length", [0.0, 1e-15, 1e-9, 1e-4, 0.5, 3.0, np.pi - 1e-9, np.pi - 1e-13])
def test_rotation_vector_inverts_rotation_matrix(length):
    for axis in [*np.eye(3), *-np.eye(3), *np.random.default_rng(2).normal(size=(20, 3))]:
        vector = length * axis / np.linalg.norm(axis)
        matrix = rotation_matrix(vector)
        assert np.abs(rotation_matrix(rotation_vector(matrix)) - matrix).max() < ROUNDING
        # Next to pi the rounding of the matrix may turn the axis over: there only the matrix is compared.
        if length < 3.1:
            assert np.abs(rotation_vector(matrix) - vector).max() < ROUNDING


def test_rotation_vector_takes_the_nearest_rotation():
    matrix = rotation_matrix(np.array([0.1, 0.2, -0.3]))
    # A symmetric stretch does not turn: the polar factor is the rotation itself.
    assert rotation_vector(matrix @ np.diag([1 + 1e-7, 1 - 1e-7, 1.0])) == pytest.approx([0.1, 0.2, -0.3], abs=ROUNDING)


def test_stereo_vector_has_the_names_order_and_inverts():
    stereo = small_stereo()
    named = dict(zip(STEREO_PARAMETER_NAMES, stereo.vector, strict=True))
    assert stereo.vector.shape == (24,)
    assert (named["stereo.left.fx"], named["stereo.left.fy"]) == (802.0, 801.0)
    assert (named["stereo.right.cx"], named["stereo.right.cy"]) == (633.0, 362.0)
    assert (named["stereo.left.p2"], named["stereo.right.k3"]) == (-6e-4, -0.012)
    assert named["stereo.translation_mm.x"] == -85.2
    moved = stereo.with_vector(stereo.vector + np.arange(24) * 1e-3)
    assert np.abs(moved.vector - stereo.vector - np.arange(24) * 1e-3).max() < 802 * ROUNDING
    assert moved.image_width == 1280 and moved.M1[0, 1] == 0.0 and moved.M1[2, 2] == 1.0


def test_stereo_file_round_trip(tmp_path):
    for stereo in (small_stereo(), dataclasses.replace(small_stereo(), assumed=True)):
        path = tmp_path / "stereo.json"
        write_stereo(stereo, path)
        again = read_stereo(path)
        for field in dataclasses.fields(stereo):
            assert np.array_equal(getattr(again, field.name), getattr(stereo, field.name)), field.name


def stereo_document(tmp_path: Path) -> dict:
    write_stereo(small_stereo(), tmp_path / "stereo.json")
    return json.loads((tmp_path / "stereo.json").read_text())


def test_stereo_shapes_of_opencv_are_accepted(tmp_path):
    document = stereo_document(tmp_path)
    row, column = [document["D1"]], [[value] for value in document["D1"]]
    for distortion in (row, column):
        document |= {"D1": distortion, "T": [[value] for value in (-85.2, 0.3, -0.4)]}
        (tmp_path / "stereo.json").write_text(json.dumps(document))
        assert np.array_equal(read_stereo(tmp_path / "stereo.json").vector, small_stereo().vector)


def changed(matrix: list, row: int, column: int, value: object) -> list:
    rows = [list(r) for r in matrix]
    rows[row][column] = value
    return rows


STEREO_REFUSED = {
    "format": ("format", lambda d: {"format": "tvsbayes-stereo/9"}, "word"),
    "no format": ("format", lambda d: {"format": None}, "word"),
    "unknown key": ("Q", lambda d: {"Q": 1}, "unknown-key"),
    "width text": ("image_width", lambda d: {"image_width": "1280"}, "integer"),
    "width float": ("image_width", lambda d: {"image_width": 1280.0}, "integer"),
    "width huge": ("image_width", lambda d: {"image_width": 10**9}, "integer"),
    "flat M": ("M1", lambda d: {"M1": [1.0] * 9}, "shape"),
    "ragged M": ("M1", lambda d: {"M1": [[1.0], [1.0, 2.0], [3.0]]}, "shape"),
    "M of text": ("M2", lambda d: {"M2": changed(d["M2"], 0, 0, "802")}, "matrix"),
    "M of true": ("M2", lambda d: {"M2": changed(d["M2"], 0, 0, True)}, "matrix"),
    "M huge": ("M2", lambda d: {"M2": changed(d["M2"], 0, 0, 1e300)}, "matrix"),
    "negative fx": ("M1", lambda d: {"M1": changed(d["M1"], 0, 0, -802.0)}, "camera-matrix"),
    "skew": ("M1", lambda d: {"M1": changed(d["M1"], 0, 1, 0.1)}, "camera-matrix"),
    "last row": ("M1", lambda d: {"M1": changed(d["M1"], 2, 2, 2.0)}, "camera-matrix"),
    "four distortions": ("D1", lambda d: {"D1": d["D1"][:4]}, "shape"),
    "D deep": ("D1", lambda d: {"D1": [[d["D1"]]]}, "matrix"),
    "D absent": ("D2", lambda d: {"D2": None}, "matrix"),
    "T row": ("T", lambda d: {"T": [d["T"]]}, "shape"),
    "T zero": ("T", lambda d: {"T": [0.0, 0.0, 0.0]}, "translation"),
    "R scaled": ("R", lambda d: {"R": (np.array(d["R"]) * 1.00001).tolist()}, "rotation"),
    "R mirrored": ("R", lambda d: {"R": (-np.array(d["R"])).tolist()}, "rotation"),
    "R two by two": ("R", lambda d: {"R": [[1.0, 0.0], [0.0, 1.0]]}, "shape"),
    "covariance shape": (
        "parameter_covariance",
        lambda d: {"parameter_covariance": [[1.0] * 23] * 24},
        "shape",
    ),
    "covariance absent": ("parameter_covariance", lambda d: {"parameter_covariance": None}, "matrix"),
    "covariance empty": ("parameter_covariance", lambda d: {"parameter_covariance": []}, "shape"),
    "rms negative": ("rms_px", lambda d: {"rms_px": -0.1}, "number"),
    "assumed": ("assumed", lambda d: {"assumed": 1}, "boolean"),
}


@pytest.mark.parametrize("name", STEREO_REFUSED)
def test_stereo_refusals_name_line_and_key(tmp_path, name):
    key, change, code = STEREO_REFUSED[name]
    document = stereo_document(tmp_path)
    document |= change(document)
    path = tmp_path / "stereo.json"
    path.write_text("{\n" + ",\n".join(f'"{k}": {json.dumps(v)}' for k, v in document.items()) + "\n}")
    with pytest.raises(InputError) as caught:
        read_stereo(path)
    error = caught.value
    assert (error.code, error.file, error.column) == (code, "stereo.json", key)
    assert error.line == 2 + list(document).index(key)


def test_covariance_must_be_one(tmp_path):
    good = small_stereo().parameter_covariance

    def refused(covariance: np.ndarray) -> str:
        with pytest.raises(InputError) as caught:
            write_stereo(dataclasses.replace(small_stereo(), parameter_covariance=covariance), tmp_path / "s")
        assert caught.value.column == "parameter_covariance"
        return caught.value.message

    correlated = np.zeros((24, 24))
    correlated[:3, :3] = [[1, 0.9, -0.9], [0.9, 1, 0.9], [-0.9, 0.9, 1]]
    assert "eigenvalue" in refused(correlated)
    # The same matrix in the units of the distortion coefficients: scaling must not hide it.
    tiny = np.zeros((24, 24))
    tiny[4:7, 4:7] = 1e-14 * correlated[:3, :3]
    assert "eigenvalue" in refused(tiny)
    asymmetric = good.copy()
    asymmetric[0, 1] += 1e-6
    assert "symmetric" in refused(asymmetric)
    fixed = good.copy()
    fixed[8, 0] = fixed[0, 8] = 1e-9
    assert "variance 0" in refused(fixed)
    negative = np.diag([-1.0, *[1.0] * 23])
    assert "negative variance" in refused(negative) and "stereo.left.fx" in refused(negative)
    overflowing = np.ones((24, 24))
    overflowing[0, 0] = 5e-324
    assert "correlation of" in refused(overflowing)
    with pytest.raises(InputError, match="finite numbers"):
        write_stereo(dataclasses.replace(small_stereo(), parameter_covariance=good * np.nan), tmp_path / "s")
    write_stereo(dataclasses.replace(small_stereo(), parameter_covariance=np.zeros((24, 24))), tmp_path / "s")


def test_rig_table_defaults_and_both_spellings():
    assert rig_table("") == RigTable()
    quoted = rig_table('[rig.prior]\n"degrees_per_step.pan" = { value = 0.05, u = 0.02 }\n')
    dotted = rig_table("[rig.prior]\ndegrees_per_step.pan = { value = 0.05, u = 0.02 }\n")
    table = rig_table("[rig.prior.degrees_per_step.pan]\nvalue = 0.05\nu = 0.02\n")
    assert quoted == dotted == table
    assert quoted.priors["degrees_per_step.pan"] == Prior(0.05, 0.02)
    deep = rig_table("[rig.prior]\nextrinsics.rotation_rad.z = { value = 1, u = 0 }\n")
    assert deep.priors["extrinsics.rotation_rad.z"] == Prior(1.0, 0.0)


def test_any_parameter_may_stand_in_the_priors():
    """DESIGN 7: also one whose own place is [rig]."""
    one = rig_table("[rig]\nbaseline_mm = { value = 199, u = 0.2 }\nfocal_scale = { value = 1, u = 0.01 }")
    other = rig_table("[rig.prior]\nbaseline_mm = { value = 199, u = 0.2 }\nfocal_scale = { value = 1, u = 0.01 }")
    assert one == other and other.priors["baseline_mm"] == Prior(199.0, 0.2)


def test_one_camera_of_both_pictures_may_be_a_number(tmp_path):
    """As the template says."""
    text = re.sub(r"(?m)^(source|left|right) = .*\n", "", RIG_FILE).replace("[cameras]", "[cameras]\nsource = 3")
    assert read_rig(write_rig(tmp_path, text)).cameras["source"] == 3


def test_rig_table_round_trip():
    priors = {
        name: Prior(p.value if p.distribution == "half-normal" else p.value * 1.1 + 0.001, p.u / 3, p.distribution)
        for name, p in RIG_PRIORS.items()
        if name not in HARMONIC_NAMES
    }
    table = RigTable(priors, "azimuth")
    assert rig_table(rig_table_toml(table)) == table
    assert "harmonic" not in rig_table_toml(table), "a table without a period has nothing to say of them"
    stated = {name: Prior(0.01 * i, 0.02) for i, name in enumerate(HARMONIC_NAMES)}
    for periods in ({"pan": 22.5}, {"tilt": 360.0}, {"pan": 360.0, "tilt": 1.25}):
        own = {name: prior for name, prior in stated.items() if name.split(".")[1] in periods}
        table = RigTable({**priors, **own}, "azimuth", periods)
        assert rig_table(rig_table_toml(table)) == table


def test_harmonics_in_every_spelling():
    quoted = rig_table(
        '[rig]\n"harmonic_period_deg.pan" = { value = 30, u = 0 }\n'
        '[rig.prior]\n"harmonic_deg.pan.2.sin" = { value = 0.0, u = 0.05 }\n'
    )
    dotted = rig_table(
        "[rig]\nharmonic_period_deg.pan = { value = 30, u = 0 }\n"
        "[rig.prior]\nharmonic_deg.pan.2.sin = { value = 0.0, u = 0.05 }\n"
    )
    assert quoted == dotted
    assert quoted.harmonic_period_deg == {"pan": 30.0}
    assert quoted.priors["harmonic_deg.pan.2.sin"] == Prior(0.0, 0.05)
    assert quoted.priors["harmonic_deg.pan.1.sin"] == Prior(0.0, 0.0)


def test_a_table_completes_its_priors_and_refuses_harmonics_without_a_period():
    assert RigTable({"mirror_offset_mm": Prior(31.0, 1.0)}).priors == {
        **RIG_PRIORS,
        "mirror_offset_mm": Prior(31.0, 1.0),
    }
    for prior in (Prior(0.05, 0.0), Prior(0.0, 0.1)):
        with pytest.raises(InputError, match=r"harmonic_deg\.tilt\.1\.cos has no period") as caught:
            RigTable({"harmonic_deg.tilt.1.cos": prior}, harmonic_period_deg={"pan": 360.0})
        assert '"harmonic_period_deg.tilt" = { value = P, u = 0.0 }' in caught.value.remedy


RIG_REFUSED = {
    "derived ratio": (
        "[rig.prior]\n'degrees_per_step.left' = { value = 0.06, u = 0 }",
        2,
        "it is derived: state degrees",
    ),
    "derived ratio, dotted": (
        "[rig.prior]\ndegrees_per_step.up = { value = 0.06, u = 0 }",
        2,
        "ratio_contrast_deg_per_step.tilt",
    ),
    "derived offset": (
        "[rig.prior]\neffective_mirror_offset_mm = { value = 30, u = 0 }",
        2,
        "state mirror_offset_mm",
    ),
    "stereo": ("[rig.prior]\n'stereo.left.fx' = { value = 800, u = 1 }", 2, "come from stereo.json"),
    "stereo, dotted": ("[rig.prior]\nstereo.left.fx = { value = 800, u = 1 }", 2, "come from stereo.json"),
    "harmonic without period": (
        "[rig.prior]\n'harmonic_deg.pan.1.cos' = { value = 0, u = 0.1 }",
        2,
        r'add "harmonic_period_deg.pan" = \{ value = P, u = 0.0 \} to \[rig\]',
    ),
    "fixed harmonic without period, dotted": (
        "[rig]\nharmonic_period_deg.pan = { value = 360, u = 0 }\n"
        "[rig.prior]\nharmonic_deg.tilt.2.sin = { value = 0.1, u = 0 }",
        4,
        "harmonic_period_deg.tilt",
    ),
    "uncertain period": (
        "[rig]\n'harmonic_period_deg.pan' = { value = 30, u = 0.1 }",
        2,
        "tooth counts give the period exactly",
    ),
    "period 0": ("[rig]\n'harmonic_period_deg.pan' = { value = 0, u = 0 }", 2, "to 360"),
    "period of two turns": ("[rig]\n'harmonic_period_deg.pan' = { value = 720, u = 0 }", 2, "to 360"),
    "period as number": ("[rig]\n'harmonic_period_deg.pan' = 30", 2, "u = 0 states"),
    "period in prior": (
        "[rig.prior]\n'harmonic_period_deg.pan' = { value = 30, u = 0 }",
        2,
        r"belongs into \[rig\] itself",
    ),
    "period of no axis": (
        "[rig]\n'harmonic_period_deg.pen' = { value = 30, u = 0 }",
        2,
        "did you mean harmonic_period_deg.pan",
    ),
    "harmonic in rig": ("[rig]\n'harmonic_deg.pan.1.cos' = { value = 0, u = 0 }", 2, r"belongs into \[rig.prior\]"),
    "third harmonic": (
        "[rig.prior]\n'harmonic_deg.pan.3.cos' = { value = 0, u = 0.1 }",
        2,
        "did you mean harmonic_deg.pan.",
    ),
    "harmonic in radians or steps": (
        "[rig.prior]\n'harmonic_deg.pan.1.cos' = { value = 0, u = 100 }",
        2,
        "from 0 to 10",
    ),
    "declared twice": (
        "[rig]\nbaseline_mm = { value = 200, u = 0 }\n[rig.prior]\nbaseline_mm = { value = 201, u = 0 }",
        4,
        "remove one",
    ),
    "prior in rig": ("[rig]\nmirror_offset_mm = { value = 30, u = 0 }", 2, r"belongs into \[rig.prior\]"),
    "misspelt": ("[rig]\nbaselin_mm = { value = 200, u = 0 }", 2, "did you mean baseline_mm"),
    "misspelt prior": (
        "[rig.prior]\n'backlash.pan' = { value = 0, u = 1 }",
        2,
        "did you mean backlash_deg.pan",
    ),
    "both spellings": (
        "[rig.prior]\n'backlash_deg.pan' = { value = 0, u = 1 }\nbacklash_deg.pan = { value = 0, u = 1 }",
        None,
        "remove one",
    ),
    "plain number": ("[rig]\nbaseline_mm = 200.0", 2, "u = 0 states"),
    "no u": ("[rig]\nbaseline_mm = { value = 200.0 }", 2, "u = 0 states"),
    "sigma": ("[rig]\nbaseline_mm = { value = 200.0, u = 0.1, sigma = 1 }", 2, "u = 0 states"),
    "empty": ("[rig.prior]\nmirror_offset_mm = {}", 2, "u = 0 states"),
    "empty group": ("[rig.prior]\ndegrees_per_step = {}", 2, "only degrees_per_step.pan"),
    "negative u": ("[rig]\nbaseline_mm = { value = 200.0, u = -0.1 }", 2, "from 0 to"),
    "nan": ("[rig]\n\nbaseline_mm = { value = nan, u = 0.1 }", 3, "finite number"),
    "infinite u": ("[rig]\nbaseline_mm = { value = 200, u = inf }", 2, "finite number"),
    "baseline 0": ("[rig]\nbaseline_mm = { value = 0, u = 0.1 }", 2, "from 1 to"),
    "focal scale": ("[rig]\nfocal_scale = { value = -1, u = 0.1 }", 2, "from 0.5 to 2"),
    "C0": ("[rig]\npan_zero_emission_deg = { value = 181, u = 0.1 }", 2, "from 0 to 180"),
    "half-normal": ("[rig.prior]\n'backlash_deg.pan' = { value = 0.2, u = 0.1 }", 2, "exactly 0"),
    "ratio 0": ("[rig.prior]\n'degrees_per_step.pan' = { value = 0, u = 0.1 }", 2, "number from"),
    "ratio in steps per degree": (
        "[rig.prior]\n'degrees_per_step.pan' = { value = 16.7, u = 0.1 }",
        2,
        "to 10",
    ),
    "log-normal 0": ("[rig.prior]\n'stop_sd_deg.up' = { value = 0, u = 1 }", 2, "number from"),
    "rotation in degrees": ("[rig.prior]\n'extrinsics.rotation_rad.x' = { value = 30, u = 1 }", 2, "3.15"),
    "convention": ("[rig]\naperture_convention = 'cone'", 2, "azimuth"),
    "rig is text": ("rig = 'a'", 1, "a table"),
    "prior is text": ("[rig]\nprior = 'a'", 2, "a table"),
}


@pytest.mark.parametrize("name", RIG_REFUSED)
def test_rig_table_refusals_teach(name):
    text, line, teaches = RIG_REFUSED[name]
    with pytest.raises(InputError, match=teaches) as caught:
        rig_table(text)
    assert caught.value.file == "rig.toml" and caught.value.column
    if line is not None:
        assert caught.value.line == line


RIG_FILE = """format = "tvsbayes-rig/1"
name = "bench"
stereo = "stereo.json"
[rig]
baseline_mm = { value = 199.0, u = 0.2 }
[rig.prior]
"mirror_offset_mm" = { value = 31.0, u = 1.0 }
[truth]
"backlash_deg.pan" = { value = 0.0, u = 0.3 }
focal_scale = { value = 1.002, u = 0.0 }
[sheets]
d1 = 175
"far wall" = 1000.5
[positioner]
driver = "teensy"
port = "/dev/ttyACM0"
baud = 115200
pan_min_steps = -2000
pan_max_steps = 2000
settle_s = 0.2
[cameras]
source = "opencv"
left = 0
right = "/dev/video2"
width = 1280
height = 720
exposure = -6
[costs]
move_s = 2.5
"""


def write_rig(folder: Path, text: str = RIG_FILE) -> Path:
    write_stereo(small_stereo(), folder / "stereo.json")
    (folder / "rig.toml").write_text(text)
    return folder / "rig.toml"


def test_rig_file(tmp_path):
    rig = read_rig(write_rig(tmp_path))
    assert rig.table.priors["baseline_mm"] == Prior(199.0, 0.2)
    assert rig.truth["mirror_offset_mm"] == Prior(31.0, 1.0)  # absent from [truth]: the prior
    assert rig.truth["backlash_deg.pan"] == Prior(0.0, 0.3, "half-normal")
    assert rig.table.priors["backlash_deg.pan"] == RIG_PRIORS["backlash_deg.pan"]
    assert rig.truth["focal_scale"] == Prior(1.002, 0.0)
    assert set(rig.truth) == set(RIG_PRIORS)
    assert rig.sheets_mm == {"d1": 175.0, "far wall": 1000.5}
    assert rig.positioner["baud"] == 115200 and rig.positioner["pan_min_steps"] == -2000
    assert rig.cameras == {
        "spot_sd_px": 0.08,
        "source": "opencv",
        "left": 0,
        "right": "/dev/video2",
        "width": 1280,
        "height": 720,
        "exposure": -6.0,
    }
    assert rig.costs_s == {"move_s": 2.5, "look_s": 1.0, "placement_s": 60.0}
    assert rig.header == {"name": "bench"}
    assert np.array_equal(rig.stereo.vector, small_stereo().vector)
    minimal = read_rig(write_rig(tmp_path, 'format = "tvsbayes-rig/1"\nstereo = "stereo.json"\n'))
    assert minimal.table == RigTable() and minimal.truth == minimal.table.priors and minimal.sheets_mm == {}


def test_a_true_rig_may_have_a_transmission_error_that_no_prior_admits(tmp_path):
    text = RIG_FILE.replace("[rig.prior]", "harmonic_period_deg.tilt = { value = 45.0, u = 0.0 }\n[rig.prior]")
    text = text.replace("[truth]", "[truth]\n'harmonic_deg.tilt.1.sin' = { value = 0.0, u = 0.1 }")
    rig = read_rig(write_rig(tmp_path, text))
    assert rig.truth["harmonic_deg.tilt.1.sin"] == Prior(0.0, 0.1)
    assert rig.table.priors["harmonic_deg.tilt.1.sin"] == Prior(0.0, 0.0)
    assert rig.table.harmonic_period_deg == {"tilt": 45.0}


RIG_FILE_REFUSED = {
    "true harmonic without period": (
        "[truth]",
        "[truth]\n'harmonic_deg.pan.1.sin' = { value = 0.1, u = 0 }",
        9,
        "truth.harmonic_deg.pan.1.sin",
    ),
    "true period": (
        "[truth]",
        "[truth]\n'harmonic_period_deg.pan' = { value = 30, u = 0 }",
        9,
        "truth.harmonic_period_deg.pan",
    ),
    "format": ('"tvsbayes-rig/1"', '"tvsbayes-campaign/1"', 1, "format"),
    "unknown key": ("name =", "title =", 2, "title"),
    "unknown table": ("[costs]", "[prices]", 28, "prices"),
    "absolute path": ('"stereo.json"', '"/etc/passwd"', 3, "stereo"),
    "windows path": ('"stereo.json"', "'C:\\stereo.json'", 3, "stereo"),
    "parent": ('"stereo.json"', '"../stereo.json"', 3, "stereo"),
    "parent below": ('"stereo.json"', '"a/../../stereo.json"', 3, "stereo"),
    "windows parent": ('"stereo.json"', "'..\\stereo.json'", 3, "stereo"),
    "empty path": ('"stereo.json"', '""', 3, "stereo"),
    "path with nul": ('"stereo.json"', '"a\\u0000b"', 3, "stereo"),
    "no path": ('stereo = "stereo.json"', "", None, "stereo"),
    "truth name": ("focal_scale", "focal_scal", 10, "truth.focal_scal"),
    "sheet close": ("d1 = 175", "d1 = 5", 12, "sheets.d1"),
    "sheet text": ("d1 = 175", "d1 = '175'", 12, "sheets.d1"),
    "sheet name": ("d1 = 175", '"d\\u001b" = 175', 11, "sheets.d\\x1b"),
    "port": ('"/dev/ttyACM0"', "'spy:///dev/ptmx?file=a'", 16, "positioner.port"),
    "baud": ("115200", "-1", 17, "positioner.baud"),
    "limits": ("pan_max_steps = 2000", "pan_max_steps = -2001", 19, "positioner.pan_max_steps"),
    "positioner key": ("settle_s", "settle_ms", 20, "positioner.settle_ms"),
    "camera size": ("width = 1280", "width = 640", 25, "cameras.width"),
    "camera device": ("left = 0", "left = -1", 23, "cameras.left"),
    "exposure": ("exposure = -6", "exposure = nan", 27, "cameras.exposure"),
    "cost": ("move_s = 2.5", "move_s = -1", 29, "costs.move_s"),
    "cost key": ("move_s = 2.5", "move_h = 1", 29, "costs.move_h"),
}


@pytest.mark.parametrize("name", RIG_FILE_REFUSED)
def test_rig_file_refusals(tmp_path, name):
    old, new, line, column = RIG_FILE_REFUSED[name]
    assert RIG_FILE.count(old) == 1
    with pytest.raises(InputError) as caught:
        read_rig(write_rig(tmp_path, RIG_FILE.replace(old, new)))
    error = caught.value
    assert (error.file, error.column) == ("rig.toml", column)
    assert error.line == line and error.message.isprintable()


def test_stereo_of_a_rig_must_not_link_outside(tmp_path):
    folder = tmp_path / "rig"
    folder.mkdir()
    path = write_rig(folder)
    (folder / "stereo.json").rename(tmp_path / "stereo.json")
    (folder / "stereo.json").symlink_to(tmp_path / "stereo.json")
    with pytest.raises(InputError, match="leaves the folder"):
        read_rig(path)
