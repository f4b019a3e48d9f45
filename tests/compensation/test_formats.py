"""Files for controllers: contents, sense, and results of a compiler and of LinuxCNC's rule."""

from __future__ import annotations

import shutil
import subprocess
import xml.etree.ElementTree as ElementTree

import numpy as np
import pytest
import yaml
from msgspec import structs
from support.compensated import results, table

from tvsbayes.compensation.correction import Correction
from tvsbayes.compensation.formats import CSV_COLUMNS, FORMATS, Origin, Wish, is_table_of
from tvsbayes.compensation.promise import compensation_of
from tvsbayes.errors import InputError
from tvsbayes.files.own_outputs import require_own

ORIGIN = Origin("tvsbayes of a test", "0123456789abcdef" * 4)
WISHES = {
    "grbl": {"in_force": 250.0},
    "grblhal": {"in_force": 250.0, "letter": "Y"},
    "klipper": {"in_force": 8.0},
    "pec": {"period": 25.0},
}


def written(target: str) -> str:
    return FORMATS[target].write(table(target, **WISHES.get(target, {})), ORIGIN)


def lines_of(text: str) -> list[str]:
    return [line for line in text.splitlines() if line and not line.startswith(("#", ";"))]


@pytest.mark.parametrize("target", FORMATS)
def test_every_file_states_source_sense_and_that_nothing_is_applied(target):
    text = written(target)
    for word in ("tvsbayes of a test", "applied to nothing", "sense:", "promise, arriving backward", "since homing"):
        assert word in text, word


@pytest.mark.parametrize("target", FORMATS)
def test_every_file_is_known_as_ours(target, tmp_path):
    """LinuxCNC's by its end, after a table of 2000 lines."""
    text = written(target)
    (tmp_path / "table").write_text("0.0 0.0 0.0\n" * 2000 * (target == "linuxcnc") + text)
    require_own(tmp_path / "table", "compensation")
    (tmp_path / "table").write_text(text.replace("tvsbayes", "somebody"))
    with pytest.raises(InputError, match="would be replaced"):
        require_own(tmp_path / "table", "compensation")


@pytest.mark.parametrize("target", FORMATS)
def test_a_file_without_id_is_known_by_the_digest_of_what_it_holds(target):
    """As those of 0.3.0, whatever their remarks say; not one of other data or of another table."""
    made, text = table(target, **WISHES.get(target, {})), written(target)
    old = "\n".join(line for line in text.splitlines() if "its promise is in results/" not in line)
    assert is_table_of(old, made, ORIGIN.data_sha256)
    shifted = [structs.replace(r, command=r.command + 1, forward=r.forward + 1) for r in made.table]
    settings = {name: 1.01 * value for name, value in made.settings.items()}
    other = structs.replace(made, table=tuple(shifted), settings=settings)
    assert not is_table_of(old, other, ORIGIN.data_sha256) and not is_table_of("", made, ORIGIN.data_sha256)


def test_csv_holds_the_readings_expected():
    header, *rows = lines_of(written("csv"))
    assert header.split(",") == [*CSV_COLUMNS]
    cells = np.array([[float(cell) for cell in row.split(",")] for row in rows])
    assert cells.shape == (17, 5) and np.all(np.diff(cells[:, 0]) > 0) and np.all(cells[:, 3:] > 0)
    # Lost motion: arriving forward the reading lags, by a play of 0.3 that varies by 0.02.
    assert np.mean(cells[:, 2] - cells[:, 1]) == pytest.approx(0.3, abs=0.06)


def test_linuxcnc_sends_the_corrected_command_by_its_rule():
    """It subtracts (forward - nominal) or (reverse - nominal), linear between lines."""
    result = table("linuxcnc")
    nominal, forward, reverse = np.array([[float(c) for c in line.split()] for line in lines_of(written("linuxcnc"))]).T
    at = np.array([-13.0, 4.4, 17.0])
    for side, column in ((1, forward), (-1, reverse)):
        by_rule = at - np.interp(at, nominal, column - nominal)
        # Seven decimals in the file.
        np.testing.assert_allclose(by_rule, Correction.of(result).sent(at, np.full(3, side)), atol=2e-7)


def test_linuxcnc_of_counters_that_run_backwards_exchanges_the_sides():
    """The unit falls as the command rises: LinuxCNC's forward is the campaign's backward."""
    result = compensation_of(results(-1.002), Wish("linuxcnc"))
    assert result.per_command == -1.0
    rows = np.array([[float(c) for c in line.split()] for line in lines_of(FORMATS["linuxcnc"].write(result, ORIGIN))])
    assert np.all(np.diff(rows[:, 0]) > 0)
    sent = Correction.of(result).sent(np.array([10.0]), np.array([1]))[0]
    at_unit = rows[np.argmin(np.abs(rows[:, 0] + 10.0))]
    assert at_unit[0] - (at_unit[2] - at_unit[0]) == pytest.approx(-sent, abs=2e-7)


def test_settings_hold_ratio_and_play():
    ratio = float(lines_of(written("grbl"))[0].removeprefix("$100="))
    # 250 steps per mm made 1.002 mm; the error by position of 0.05 mm turns the line over 40 mm by 0.3 %.
    assert ratio == pytest.approx(250 / 1.002, rel=0.004)
    hal = dict(line.split("=") for line in lines_of(written("grblhal")))
    assert set(hal) == {"$101", "$161"} and float(hal["$161"]) == pytest.approx(0.3, abs=0.06)
    klipper = float(lines_of(written("klipper"))[0].removeprefix("rotation_distance: "))
    assert klipper / 8.0 == pytest.approx(250 / ratio, rel=1e-4)


def test_urdf_states_covariance_and_what_it_corrects():
    """The YAML beside the xacro: the same numbers, their covariance, and the hash that keeps it from acting twice."""
    beside = FORMATS["urdf"].beside
    assert beside is not None and all(FORMATS[name].beside is None for name in FORMATS if name != "urdf")
    result = table("urdf")
    document = yaml.safe_load(beside(result, ORIGIN))
    assert document["axis_corrects"] == ORIGIN.data_sha256 and document["applied"] is False
    assert f'name="axis_corrects" value="{ORIGIN.data_sha256}"' in written("urdf")
    joint = document["joint"]
    assert joint["values"] == [result.settings["axis_zero"], result.settings["axis_reduction"]]
    sd = np.sqrt(np.diag(joint["covariance"]))
    np.testing.assert_allclose(sd, [result.settings["u_axis_zero"], result.settings["u_axis_reduction"]], rtol=1e-12)
    assert joint["covariance"][0][1] == joint["covariance"][1][0] == result.settings["covariance_zero_reduction"]
    assert set(document["left_after_applying_95"]) == {"forward", "backward"}


def test_urdf_is_xml_with_zero_and_reduction():
    tree = ElementTree.fromstring(written("urdf"))
    stated = {node.get("name"): node.get("value", "") for node in tree}
    assert stated.pop("axis_corrects") == ORIGIN.data_sha256
    values = {name: float(value) for name, value in stated.items()}
    assert values["axis_reduction"] == pytest.approx(1 / 1.002, rel=0.004) and values["u_axis_zero"] > 0
    bound = values["u_axis_zero"] * values["u_axis_reduction"]
    assert 0 < abs(values["covariance_zero_reduction"]) <= bound


def test_pec_repeats_and_names_cannot_end_a_comment():
    header, *rows = lines_of(written("pec"))
    assert header == "phase,add" and len(rows) == 64
    nasty = structs.replace(table("header"), machine="a */ int x; /* b\nc")
    assert "*/ int" not in FORMATS["header"].write(nasty, ORIGIN)


@pytest.mark.skipif(shutil.which("cc") is None, reason="no C compiler")
def test_header_adds_what_the_table_adds(tmp_path):
    (tmp_path / "axis.h").write_text(written("header"))
    at = [-30.0, -13.0, 4.4, 20.0, 31.0]
    calls = "".join(f'printf("%.9f %.9f\\n", axis_sent({c}, 1), axis_sent({c}, -1));' for c in at)
    (tmp_path / "try.c").write_text(f'#include <stdio.h>\n#include "axis.h"\nint main(void) {{ {calls} return 0; }}\n')
    subprocess.run(["cc", "-std=c99", "-Wall", "-Werror", "-o", "try", "try.c"], cwd=tmp_path, check=True)
    out = subprocess.run([tmp_path / "try"], capture_output=True, text=True, check=True).stdout
    cells = np.array([[float(cell) for cell in line.split()] for line in out.splitlines()])
    applied = Correction.of(table("header"))
    for column, side in enumerate((1, -1)):
        # Nine decimals printed; the table of the file has nine digits.
        np.testing.assert_allclose(cells[:, column], applied.sent(np.array(at), np.full(5, side)), atol=2e-8)
