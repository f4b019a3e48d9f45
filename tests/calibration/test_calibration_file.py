"""Calibrations on disk: draws, JSON and C header brought back, damage refused."""

from __future__ import annotations

import io
import json
import math
import shutil
from collections.abc import Mapping
from dataclasses import fields, replace
from itertools import product

import numpy as np
import pytest
from support.bent_rig import (
    BENT,
    PERIODS_DEG,
    POSES,
    ROUNDING,
    ROUNDING_MM,
    WOBBLE,
    calibration,
)
from support.c_headers import answers_of_header, needs_compiler
from support.geared_rig import geared
from support.refusals import refusal
from support.small_campaign import small_campaign
from support.stored_fits import calibration_bytes, edit_fit, store

from tvsbayes.calibration.c_header import calibration_header
from tvsbayes.calibration.calibration_file import (
    CALIBRATION_FORMAT,
    FORMATS,
    NO_CALIBRATION,
    Origin,
    calibration_json,
    content_sha256,
    expected_error,
)
from tvsbayes.calibration.optics import GEAR_INPUTS
from tvsbayes.calibration.pointing import INPUT_NAMES, NOISE_NAMES, Calibration
from tvsbayes.instrument.campaign import input_hashes
from tvsbayes.instrument.parameters import HARMONIC_NAMES
from tvsbayes.pipeline import StoredOrFitted, load_calibration

PRINTED = 5e-15
"""Of numbers with fifteen significant digits, as exports have them: half a unit of the last one of 1.00..."""


def differing(one: Calibration, other: Calibration, without: tuple[str, ...] = (), rel: float = 0.0) -> list[str]:
    """Names of the fields that are not the same, to the last bit or to `rel`, arrays in float64."""

    def equal(a: object, b: object) -> bool:
        if isinstance(a, np.ndarray):
            return b.dtype == np.float64 and np.allclose(a, b, rtol=rel, atol=0.0)
        if isinstance(a, Mapping):
            return a.keys() == b.keys() and all(equal(a[key], b[key]) for key in a)
        return math.isclose(a, b, rel_tol=rel) if isinstance(a, float) else a == b

    names = (f.name for f in fields(Calibration) if f.name not in without)
    return [name for name in names if not equal(getattr(one, name), getattr(other, name))]


def complete() -> Calibration:
    """Every field holds something that could get lost."""
    one = calibration(BENT | WOBBLE, azimuth=True, period_deg=PERIODS_DEG, draws=60)
    parts = np.stack([0.25 * one.covariance, 0.75 * one.covariance])
    return replace(one, causes=("pixel noise", "stereo"), cause_covariance=parts, estimator="laplace")


def geared_complete() -> Calibration:
    """The same with gears that vary."""
    one = geared(complete())
    parts = np.stack([0.25 * one.covariance, 0.75 * one.covariance])
    return replace(one, cause_covariance=parts)


def test_files_of_the_first_format_are_of_gears_without_errors(tmp_path):
    """Neither its draws.npz nor its JSON has a table: they are read as they were written."""
    one, path = complete(), tmp_path / "draws.npz"
    arrays = arrays_of(one)
    tables = json.loads(str(arrays["tables"]))
    del tables["gear_steps"]
    np.savez(path, **arrays | {"format": np.array(FORMATS[0]), "tables": np.array(json.dumps(tables))})
    assert differing(one, load_calibration(path)) == []
    document = {**calibration_json(one), "format": FORMATS[0]}
    del document["gear_errors"]
    (tmp_path / "robot.json").write_text(json.dumps(document))
    loaded = load_calibration(tmp_path / "robot.json")
    assert differing(one, loaded, without=MOMENTS_ALONE, rel=PRINTED) == []


def test_json_export_tells_the_gears_errors():
    one = geared_complete()
    table, count = calibration_json(one)["gear_errors"], len(one.mean) - one.gears.size
    assert calibration_json(complete())["gear_errors"] == {}
    for axis, nodes in zip(("pan", "tilt"), one.gears.steps, strict=True):
        assert table[axis]["steps"] == list(nodes)
        part = one.gears.parts[f"play_variation_at_deg.{axis}"]
        u = np.sqrt(np.diag(one.covariance)[count:][part])
        np.testing.assert_allclose(table[axis]["play_variation_deg"], one.mean[count:][part][:-1], rtol=PRINTED)
        told_u = [*table[axis]["u_play_variation_deg"], table[axis]["beyond_u_play_variation_deg"]]
        np.testing.assert_allclose(told_u, u, rtol=PRINTED)


def test_exports_print_what_a_double_keeps_and_say_what_they_are(bent):
    """No residue of binary fractions; campaign, day, version and a digest that only the calibration changes."""
    one = replace(bent, range_steps=np.array([[0.1 + 0.2, 300.0], [40.0, 60.0]]))
    old, new = (Origin(name, "2026-01-15", day, "1.0") for name, day in (("a", "2026-02-01"), ("b", "2026-02-02")))
    document, other = calibration_json(one, old), calibration_json(one, new)
    assert document["range_steps"]["pan"] == [0.3, 300.0] and "0000000000004" not in json.dumps(document)
    meta = document["origin"]
    assert meta["campaign"] == "a" and meta["sha256"] == other["origin"]["sha256"] == content_sha256(document)
    assert content_sha256(calibration_json(bent)) != meta["sha256"]
    header = calibration_header(one, old)
    assert "#define TVS_SEEN_PAN_LOW 0.3\n#define TVS_SEEN_PAN_HIGH 300.0\n" in header
    first = header.split("#ifndef")[0]
    assert "Campaign: a, measured 2026-01-15; exported 2026-02-01 by tvsbayes 1.0" in first and meta["sha256"] in first


@pytest.mark.parametrize("name", ["*/ int x; /*", "??/", "a\\\nb", "\u00fc"])
def test_a_strangers_name_ends_no_comment(bent, name):
    """Nor what a results file calls its estimator."""
    one = replace(bent, estimator=f"laplace {name}")
    head = calibration_header(one, Origin(name, "", "2026-02-01", "1.0")).split("#ifndef")[0]
    assert head.count("*/") == head.count("/*") == 1 and "??" not in head and "\\" not in head and head.isascii()


@pytest.mark.parametrize("vary", [False, True])
def test_draws_file_brings_everything_back(tmp_path, vary):
    one = geared_complete() if vary else complete()
    store(tmp_path / "results", one)
    path = tmp_path / "results" / "draws.npz"
    for place in (tmp_path, str(tmp_path), tmp_path / "results", path):
        assert differing(one, load_calibration(place)) == []
    path.write_bytes(calibration_bytes(one, physical=np.zeros((3, 65))))
    lone = shutil.copy(path, tmp_path)
    assert differing(one, load_calibration(lone)) == []


def test_results_without_a_calibration_are_no_damage(tmp_path):
    """A fit that did not converge, or an older version, leaves draws alone: such results count as none."""
    campaign = replace(small_campaign(), path=tmp_path)
    store(tmp_path / "results", None)
    assert StoredOrFitted(campaign).stored_calibration is None
    error = refusal(lambda: load_calibration(tmp_path))
    assert error.code == NO_CALIBRATION and error.remedy and "did not converge" in error.message
    edit_fit(tmp_path / "results", fit_id=None)
    np.savez_compressed(tmp_path / "results" / "draws.npz", names=np.array(INPUT_NAMES))
    assert refusal(lambda: StoredOrFitted(campaign).stored_calibration).code == "damaged-results"


@pytest.mark.parametrize("vary", [False, True])
def test_json_export_brings_back_all_but_the_draws(tmp_path, vary):
    one = geared_complete() if vary else complete()
    path = tmp_path / "robot.json"
    path.write_text(json.dumps(calibration_json(one), allow_nan=False))
    other = load_calibration(path)
    assert differing(one, other, without=MOMENTS_ALONE, rel=PRINTED) == []
    assert len(other.inputs) == len(other.noise) == len(other.causes) == 0
    assert other.locate(100, 50, 75.0).u95_mm == pytest.approx(one.locate(100, 50, 75.0).u95_mm, rel=ROUNDING)
    after, before = (each.steps_for((600, 0, 0)) for each in (other, one))
    assert (after.pan_steps, after.tilt_steps, after.approach) == (before.pan_steps, before.tilt_steps, before.approach)
    np.testing.assert_allclose(after.xyz_mm, before.xyz_mm, rtol=ROUNDING, atol=ROUNDING_MM)


def test_expected_error_is_that_of_the_middle():
    one = replace(complete(), range_steps=np.array([[-100.0, 300.0], [40.0, 60.0]]))
    error = expected_error(one)
    assert (error.pan_steps, error.tilt_steps) == (100, 50)
    d = one.ray(100, 50).direction
    there = one.steps_for(azimuth_deg=math.degrees(math.atan2(d[1], d[0])), elevation_deg=math.degrees(math.asin(d[2])))
    assert [error.u95_azimuth_deg, error.u95_elevation_deg] == pytest.approx(there.u95_deg, rel=ROUNDING)
    at_1_m = one.steps_for(one.ray(100, 50).origin_mm + 1000.0 * d)
    assert error.u95_at_1_m_mm == pytest.approx(at_1_m.u95_mm, rel=1e-9)


def arrays_of(one: Calibration) -> dict[str, np.ndarray]:
    with np.load(io.BytesIO(calibration_bytes(one))) as file:
        return {name: file[name] for name in file.files}


def table(arrays: dict[str, np.ndarray], name: str, value: object) -> dict[str, np.ndarray]:
    return arrays | {"tables": np.array(json.dumps(json.loads(str(arrays["tables"])) | {name: value}))}


def poisoned(array: np.ndarray, value: float) -> np.ndarray:
    array = array.copy()
    array.flat[3] = value
    return array


DAMAGES = {
    "another format": lambda a: a | {"format": np.array("tvsbayes-calibration/9")},
    "no format": lambda a: {name: value for name, value in a.items() if name != "format"},
    "other columns": lambda a: a | {"input_names": a["input_names"][::-1]},
    "other noises": lambda a: a | {"noise_names": a["noise_names"][::-1]},
    "no mean": lambda a: {name: value for name, value in a.items() if name != "mean"},
    "no tables": lambda a: {name: value for name, value in a.items() if name != "tables"},
    "nan in the mean": lambda a: a | {"mean": poisoned(a["mean"], np.nan)},
    "inf in the covariance": lambda a: a | {"covariance": poisoned(a["covariance"], np.inf)},
    "nan in the draws": lambda a: a | {"inputs": poisoned(a["inputs"], np.nan)},
    "a short mean": lambda a: a | {"mean": a["mean"][:-1]},
    "fewer noises": lambda a: a | {"noise": a["noise"][:-1]},
    "narrow draws": lambda a: a | {"inputs": a["inputs"][:, 1:]},
    "causes without parts": lambda a: a | {"cause_covariance": a["cause_covariance"][:1]},
    "integers": lambda a: a | {"mean": a["mean"].astype(int)},
    "objects": lambda a: a | {"mean": a["mean"].astype(object)},
    "text": lambda a: a | {"covariance": np.array("covariance")},
    "tables no json": lambda a: a | {"tables": np.array("{")},
    "tables a list": lambda a: a | {"tables": np.array("[]")},
    "noise variance missing": lambda a: table(a, "noise_variance", {"aperture_sd_deg": 1.0}),
    "noise variance nan": lambda a: table(a, "noise_variance", dict.fromkeys(NOISE_NAMES, math.nan)),
    "noise variance negative": lambda a: table(a, "noise_variance", dict.fromkeys(NOISE_NAMES, -1.0)),
    "noise variance text": lambda a: table(a, "noise_variance", dict.fromkeys(NOISE_NAMES, "1")),
    "overshoot missing": lambda a: table(a, "overshoot_steps", {"pan": 3}),
    "overshoot text": lambda a: table(a, "overshoot_steps", {"pan": "3", "tilt": 3}),
    "period zero": lambda a: table(a, "period_deg", {"pan": 0.0}),
    "period text": lambda a: table(a, "period_deg", {"pan": "360"}),
    "periods a list": lambda a: table(a, "period_deg", [360.0]),
    "a gear table without columns": lambda a: table(a, "gear_steps", {"pan": [0, 1, 2, 3], "tilt": [0, 1, 2, 3]}),
    "no gear table": lambda a: table(a, "gear_steps", None),
    "gear counters text": lambda a: table(a, "gear_steps", {"pan": ["a"], "tilt": ["b"]}),
}


@pytest.mark.parametrize("damage", DAMAGES)
def test_damaged_draws_are_refused(damage, tmp_path):
    buffer = io.BytesIO()
    np.savez_compressed(buffer, **DAMAGES[damage](arrays_of(complete())))
    path = tmp_path / "draws.npz"
    path.write_bytes(buffer.getvalue())
    error = refusal(lambda: load_calibration(path))
    assert (error.code, error.file) == ("damaged-results", "draws.npz")
    assert error.remedy and CALIBRATION_FORMAT in error.allowed


JSON_DAMAGES = {
    "format": lambda d: d | {"format": "tvsbayes-calibration/9"},
    "no estimates": lambda d: {k: v for k, v in d.items() if k != "estimates"},
    "estimate missing": lambda d: d | {"estimates": {k: v for k, v in d["estimates"].items() if k != "baseline_mm"}},
    "estimate text": lambda d: d | {"estimates": d["estimates"] | {"baseline_mm": "wide"}},
    "estimate null": lambda d: d | {"estimates": d["estimates"] | {"baseline_mm": None}},
    "estimates a list": lambda d: d | {"estimates": [1.0]},
    "other names": lambda d: d | {"covariance": d["covariance"] | {"names": ["x"]}},
    "ragged": lambda d: d | {"covariance": d["covariance"] | {"matrix": [[1.0], [1.0, 2.0]]}},
    "small": lambda d: d | {"covariance": d["covariance"] | {"matrix": [[1.0]]}},
    "noise missing": lambda d: d | {"noise_variance_deg2": {}},
    "noise negative": lambda d: d | {"noise_variance_deg2": dict.fromkeys(NOISE_NAMES, -1.0)},
    "noise null": lambda d: d | {"noise_variance_deg2": None},
    "overshoot missing": lambda d: d | {"overshoot_steps": {}},
    "overshoot text": lambda d: d | {"overshoot_steps": {"pan": "x", "tilt": 1}},
    "overshoot negative": lambda d: d | {"overshoot_steps": {"pan": -1, "tilt": 1}},
    "range": lambda d: d | {"range_steps": {"pan": [0, 1]}},
    "period": lambda d: d | {"harmonic_period_deg": {"pan": 0}},
    "convention": lambda d: d | {"aperture_convention": "sideways"},
    "gears a number": lambda d: d | {"gear_errors": 3},
    "gears of one axis": lambda d: d | {"gear_errors": {"pan": {"steps": [0, 1, 2, 3]}}},
    "a list": lambda d: [d],
}


@pytest.mark.parametrize("damage", JSON_DAMAGES)
def test_damaged_json_is_refused(damage, tmp_path):
    path = tmp_path / "robot.json"
    path.write_text(json.dumps(JSON_DAMAGES[damage](calibration_json(complete()))))
    assert refusal(lambda: load_calibration(path)).file == "robot.json"
    path.write_text(path.read_text()[:-40])
    assert refusal(lambda: load_calibration(path)).file == "robot.json"


def test_stored_calibration_is_that_of_these_data(tmp_path):
    campaign = replace(small_campaign(), path=tmp_path)
    assert StoredOrFitted(replace(campaign, path=None)).stored_calibration is None
    assert StoredOrFitted(campaign).stored_calibration is None
    one = replace(complete(), inputs_sha256=input_hashes(campaign))
    store(tmp_path / "results", one)
    assert differing(one, StoredOrFitted(campaign).stored_calibration) == []
    for name in one.inputs_sha256:
        store(tmp_path / "results", one, **{name: "f" * 64})
        assert StoredOrFitted(campaign).stored_calibration is None, name
    store(tmp_path / "results", one)
    (tmp_path / "results" / "draws.npz").write_bytes(b"no archive")
    assert refusal(lambda: StoredOrFitted(campaign).stored_calibration).code == "damaged-results"


MOMENTS_ALONE = ("inputs", "noise", "causes", "cause_covariance")
"""What JSON leaves out."""
CODES = ("diverging", "grazing", "behind")


MAIN = """
#include <stdio.h>
#include "tvs_calibration.h"
int main(void)
{
    double pan, tilt, reading, o[3], d[3], p[3];
    int left, up;
    while (scanf("%lf %lf %d %d %lf", &pan, &tilt, &left, &up, &reading) == 5) {
        tvs_beam(pan, tilt, left, up, o, d);
        int found = tvs_locate(pan, tilt, left, up, reading, p);
        printf("%d %.17g %.17g", found, tvs_error_u_deg(0, pan), tvs_error_u_deg(1, tilt));
        for (int i = 0; i < 3; i++)
            printf(" %.17g %.17g %.17g", o[i], d[i], found ? p[i] : 0.0);
        puts("");
    }
    return 0;
}
"""


@needs_compiler
@pytest.mark.parametrize("periods", [{}, PERIODS_DEG, {"pan": 25.0, "tilt": 360.0}])
@pytest.mark.parametrize(("azimuth", "vary"), [(False, False), (True, False), (False, True)])
def test_the_c_header_computes_the_same(tmp_path, periods, azimuth, vary):
    one = calibration(BENT | (WOBBLE if periods else {}), period_deg=periods, azimuth=azimuth)
    one = geared(one) if vary else one
    poses = (*POSES, (2600, 90, 110.0), (350, 10, 120.0), (-799.5, 3, 95.0), (-850, 500.25, 100.0), (-400, 300, 95.0))
    # The last one meets the other nappe of the cone, which no reading is of.
    poses = (*poses, (-50, 200, 179.8))
    requests = [(pan, tilt, left, up, reading) for (pan, tilt, reading), left, up in product(poses, (1, -1), (1, -1))]
    answers = answers_of_header(tmp_path, calibration_header(one), MAIN, requests)
    rows = [list(map(float, line.split())) for line in answers]
    refused, count = 0, len(INPUT_NAMES)
    for (pan, tilt, left, up, reading), (code, u_pan, u_tilt, *numbers) in zip(requests, rows, strict=True):
        approach = ("left" if left > 0 else "right", "up" if up > 0 else "down")
        origin, direction, point = np.array(numbers).reshape(3, 3).T
        ray = one.ray(pan, tilt, approach)
        u = dict.fromkeys(GEAR_INPUTS, 0.0)
        u |= one.gears.at(np.sqrt(np.diag(one.covariance))[count:], (float(pan), float(tilt)))
        for axis, u_axis in (("pan", u_pan), ("tilt", u_tilt)):
            wanted = math.hypot(u[f"transmission_error_at_deg.{axis}"], 0.5 * u[f"play_variation_at_deg.{axis}"])
            assert u_axis == pytest.approx(wanted, abs=ROUNDING)
        np.testing.assert_allclose(origin, ray.origin_mm, atol=ROUNDING_MM)
        np.testing.assert_allclose(direction, ray.direction, atol=ROUNDING_MM / 1000)
        if code:
            there = one.locate(pan, tilt, reading, approach)
            np.testing.assert_allclose(point, there.xyz_mm, atol=ROUNDING_MM)
            assert code == (2 if there.extrapolated else 1)
        else:
            assert refusal(lambda a=(pan, tilt, reading, approach): one.locate(*a)).code in CODES
            refused += 1
    assert refused >= 4


def test_the_c_header_states_its_error_and_overshoot(bent):
    text = calibration_header(bent)
    error = expected_error(bent)
    assert f"azimuth {error.u95_azimuth_deg:.3f} deg, elevation {error.u95_elevation_deg:.3f} deg" in text
    assert f"at 1 m {max(error.u95_at_1_m_mm):.2f} mm" in text
    assert f"#define TVS_OVERSHOOT_PAN_STEPS {bent.overshoot_steps['pan']}\n" in text
    assert "@" not in text
    for name in (*INPUT_NAMES, *HARMONIC_NAMES):
        assert f"#define TVS_{name.replace('.', '_').upper()} " in text
