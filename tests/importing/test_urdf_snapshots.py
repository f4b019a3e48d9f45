"""What `import --urdf` prints and writes, and the corrected URDF: snapshots, to be read as diffs."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from tvsbayes.head.urdf import HeadModel, ratios_of
from tvsbayes.importing.urdf import head_joints

DATA = Path(__file__).parents[1] / "data" / "urdf"
UNIT = DATA.parents[1] / "head" / "unit.urdf"


@pytest.mark.parametrize("name", ("unit.urdf", *(path.name for path in sorted(DATA.glob("*.urdf")))))
def test_import_of_a_urdf(say, tmp_path, snapshot, name):
    file = UNIT if name == "unit.urdf" else DATA / name
    code, text, error = say("import", "--urdf", file, "--steps-per-turn", 200, "--to", tmp_path / "head", "--yes")
    seen = {"code": code, "printed": f"{text}{error}".replace(str(tmp_path), "").splitlines()}
    if code == 0:
        lines = (tmp_path / "head" / "campaign.toml").read_text().splitlines()
        seen["stated"] = [line for line in lines if line and not line.startswith("#") and "created" not in line]
        seen["limits"] = (tmp_path / "head" / "rig.toml").read_text().partition("[positioner]")[2].splitlines()
    assert seen == snapshot


@pytest.mark.parametrize("name", ("unit.urdf", "comment.urdf", "charref.urdf", "u16.urdf"))
def test_the_corrected_urdf(snapshot, name):
    file = UNIT if name == "unit.urdf" else DATA / name
    head = head_joints(file.read_bytes(), name, {"pan": None, "tilt": None})
    off = {"azimuth_zero_deg": 3.0, "elevation_zero_deg": -2.0, "axes_not_square_deg": 0.25}
    values = {name: value + off.get(name, 0.0) for name, value in head.terms.items()}
    values |= {name: 1.01 * value for name, value in ratios_of(head, 200.0).items()}
    numbers, covariance = np.array(list(values.values())), np.eye(len(values))
    model = HeadModel(tuple(values), numbers, covariance, "a test", "ab12", 200.0)
    assert model.urdf(head).decode("utf-8", "backslashreplace").splitlines() == snapshot
    document = model.document(head)
    assert {key: document[key] for key in ("joints", "names", "unsaid")} == snapshot
