"""Stereo calibrations, rotations, the `[rig]` table and rig files."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest
from support.small_campaign import small_stereo

from tvsbayes.errors import InputError
from tvsbayes.files.documents import parse_toml
from tvsbayes.instrument.mechanisms import TWO_MIRROR
from tvsbayes.instrument.parameters import AMPLITUDE_NAMES, HARMONIC_NAMES, Prior
from tvsbayes.instrument.rig import PERIODIC_NAMES, RigTable, parse_rig_table, read_rig, rig_table_toml
from tvsbayes.instrument.stereo_pair import write_stereo


def rig_table(text: str) -> RigTable:
    return parse_rig_table(parse_toml(text.encode(), "rig.toml").table("rig"))


def test_rig_table_round_trip():
    priors = {
        name: Prior(p.value if p.distribution == "half-normal" else p.value * 1.1 + 0.001, p.u / 3, p.distribution)
        for name, p in TWO_MIRROR.priors.items()
        if name not in PERIODIC_NAMES
    }
    table = RigTable(priors, "azimuth")
    assert rig_table(rig_table_toml(table)) == table
    assert "harmonic" not in rig_table_toml(table), "a table without a period has nothing to say of them"
    stated = {name: Prior(0.01 * i, 0.02) for i, name in enumerate(HARMONIC_NAMES)}
    for periods in ({"pan": (22.5,)}, {"tilt": (360.0, 36.0)}, {"pan": (360.0, 0.1, 30.0), "tilt": (1.25,)}):
        waves = {name: prior for name, prior in stated.items() if name.split(".")[1] in periods}
        for axis, known in periods.items():
            for number in range(1, len(known) + 1):
                waves[f"harmonic_amplitude_deg.{axis}.{number}"] = Prior(0.0, 0.01 * number, "half-normal")
        table = RigTable({**priors, **waves}, "azimuth", periods)
        assert rig_table(rig_table_toml(table)) == table
        assert {name for name in AMPLITUDE_NAMES if f'"{name}"' in rig_table_toml(table)} == waves.keys() - {*stated}


@pytest.mark.parametrize(
    "stated",
    [
        {"look_scatter_deg.tilt": Prior(0.0, 0.0, "half-normal")},
        {"look_scatter_deg.tilt": Prior(0.0, 0.02, "half-normal")},
        {"home_sd_deg.tilt": Prior(0.002, 0.5, "log-normal")},
        {
            "creep_deg.pan": Prior(-0.02, 0.01),
            "creep_minutes": Prior(45.0, 0.3, "log-normal"),
            "thermal_deg_per_K.tilt": Prior(0.0, 0.0),
        },
    ],
)
def test_scatter_of_looks_and_shifts_of_zeros_are_written_where_they_are_stated(stated):
    """At their defaults the text of the table, and so the hash of campaigns, is that of earlier versions."""
    later = "look_scatter|creep|thermal|home_sd"
    assert not re.search(later, rig_table_toml(RigTable(dict(TWO_MIRROR.priors))))
    table = RigTable({**TWO_MIRROR.priors, **stated})
    text = rig_table_toml(table)
    assert rig_table(text) == table and len(re.findall(later, text)) == len(stated)


def test_periods_in_every_spelling():
    for text, periods in (
        ("30", (30.0,)),
        ("{ value = 30, u = 0 }", (30.0,)),
        ("[360.0, 36, 1.5]", (360.0, 36.0, 1.5)),
        ("{ value = [36.0, 360.0], u = 0.0 }", (36.0, 360.0)),
    ):
        table = rig_table(f"[rig]\nharmonic_period_deg.tilt = {text}\n")
        assert table.harmonic_period_deg == {"tilt": periods}
        assert table.first_period_deg == {"tilt": periods[0]}
        assert rig_table(rig_table_toml(table)) == table


def test_a_table_completes_its_priors_and_refuses_harmonics_without_a_period():
    assert RigTable({"mirror_offset_mm": Prior(31.0, 1.0)}).priors == {
        **TWO_MIRROR.priors,
        **dict.fromkeys(AMPLITUDE_NAMES, Prior(0.0, 0.0, "half-normal")),
        "mirror_offset_mm": Prior(31.0, 1.0),
    }
    assert RigTable(TWO_MIRROR.priors) == RigTable()
    assert RigTable(harmonic_period_deg={"pan": (360.0, 36.0)}).priors == {
        **RigTable().priors,
        **{
            f"harmonic_amplitude_deg.pan.{number}": TWO_MIRROR.priors["harmonic_amplitude_deg.pan.1"]
            for number in (1, 2)
        },
    }
    for prior in (Prior(0.05, 0.0), Prior(0.0, 0.1)):
        with pytest.raises(InputError, match=r"harmonic_deg\.tilt\.1\.cos has no period") as caught:
            RigTable({"harmonic_deg.tilt.1.cos": prior}, harmonic_period_deg={"pan": (360.0,)})
        assert '"harmonic_period_deg.tilt" = { value = P, u = 0.0 }' in caught.value.remedy
    with pytest.raises(InputError, match=r"harmonic_amplitude_deg\.pan\.2 has no period") as caught:
        RigTable(
            {f"harmonic_amplitude_deg.pan.{number}": Prior(0.0, 0.1, "half-normal") for number in (1, 2)},
            harmonic_period_deg={"pan": (360.0,)},
        )
    assert "value = [P1, P2]" in caught.value.remedy


PRIORS_REFUSED = {
    "derived ratio": ("'degrees_per_step.left' = { value = 0.06, u = 0 }", "it is derived: state degrees"),
    "derived ratio, dotted": ("degrees_per_step.up = { value = 0.06, u = 0 }", "ratio_contrast_deg_per_step.tilt"),
    "derived offset": ("effective_mirror_offset_mm = { value = 30, u = 0 }", "state mirror_offset_mm"),
    "stereo": ("'stereo.left.fx' = { value = 800, u = 1 }", "come from stereo.json"),
    "stereo, dotted": ("stereo.left.fx = { value = 800, u = 1 }", "come from stereo.json"),
    "harmonic without period": (
        "'harmonic_deg.pan.1.cos' = { value = 0, u = 0.1 }",
        r'add "harmonic_period_deg.pan" = \{ value = P, u = 0.0 \} to \[rig\]',
    ),
    "amplitude without period": (
        "'harmonic_amplitude_deg.pan.1' = { value = 0, u = 0.1 }",
        r'add "harmonic_period_deg.pan" = \{ value = P, u = 0.0 \} to \[rig\]',
    ),
    "fourth amplitude": (
        "'harmonic_amplitude_deg.pan.4' = { value = 0, u = 0.1 }",
        r"harmonic_amplitude_deg.pan\|tilt.1\|2\|3",
    ),
    "period in prior": ("'harmonic_period_deg.pan' = { value = 30, u = 0 }", r"belongs in \[rig\] itself"),
    "third harmonic": ("'harmonic_deg.pan.3.cos' = { value = 0, u = 0.1 }", "did you mean harmonic_deg.pan."),
    "harmonic in radians or steps": ("'harmonic_deg.pan.1.cos' = { value = 0, u = 100 }", "from 0 to 10"),
    "misspelt prior": ("'backlash.pan' = { value = 0, u = 1 }", "did you mean backlash_deg.pan"),
    "empty": ("mirror_offset_mm = {}", "u = 0 states"),
    "empty group": ("degrees_per_step = {}", "only degrees_per_step.pan"),
    "half-normal": ("'backlash_deg.pan' = { value = 0.2, u = 0.1 }", "exactly 0; write value = 0: it is the size"),
    "ratio 0": ("'degrees_per_step.pan' = { value = 0, u = 0.1 }", "number from"),
    "ratio in steps per degree": ("'degrees_per_step.pan' = { value = 16.7, u = 0.1 }", "to 10"),
    "log-normal 0": ("'stop_sd_deg.up' = { value = 0, u = 1 }", "number from"),
    "rotation in degrees": ("'extrinsics.rotation_rad.x' = { value = 30, u = 1 }", "3.15"),
}
"""An entry of [rig.prior], and what its message says."""
ENTRIES_REFUSED = {
    "uncertain period": ("'harmonic_period_deg.pan' = { value = 30, u = 0.1 }", "tooth counts give the period exactly"),
    "period 0": ("'harmonic_period_deg.pan' = { value = 0, u = 0 }", "to 360"),
    "period of two turns": ("'harmonic_period_deg.pan' = { value = 720, u = 0 }", "to 360"),
    "period as text": ("'harmonic_period_deg.pan' = '30'", "a list of up to 3"),
    "no periods": ("'harmonic_period_deg.pan' = []", "a list of up to 3"),
    "four periods": ("'harmonic_period_deg.pan' = [360, 36, 12, 1]", "a list of up to 3"),
    "a period twice": ("'harmonic_period_deg.pan' = [36, 36.0]", "different"),
    "period of two turns in a list": ("'harmonic_period_deg.pan' = [36, 720]", "to 360"),
    "uncertain periods": (
        "'harmonic_period_deg.pan' = { value = [36, 12], u = 1 }",
        "tooth counts give the period exactly",
    ),
    "period and sd": ("'harmonic_period_deg.pan' = { value = 36, sd = 0 }", "u = 0 states"),
    "period of no axis": ("'harmonic_period_deg.pen' = { value = 30, u = 0 }", "did you mean harmonic_period_deg.pan"),
    "harmonic in rig": ("'harmonic_deg.pan.1.cos' = { value = 0, u = 0 }", r"belongs in \[rig.prior\]"),
    "prior in rig": ("mirror_offset_mm = { value = 30, u = 0 }", r"belongs in \[rig.prior\]"),
    "misspelt": ("baselin_mm = { value = 200, u = 0 }", "did you mean baseline_mm"),
    "plain number": ("baseline_mm = 200.0", "u = 0 states"),
    "no u": ("baseline_mm = { value = 200.0 }", "u = 0 states"),
    "sigma": ("baseline_mm = { value = 200.0, u = 0.1, sigma = 1 }", "u = 0 states"),
    "negative u": ("baseline_mm = { value = 200.0, u = -0.1 }", "from 0 to"),
    "infinite u": ("baseline_mm = { value = 200, u = inf }", "finite number"),
    "baseline 0": ("baseline_mm = { value = 0, u = 0.1 }", "from 1 to"),
    "focal scale": ("focal_scale = { value = -1, u = 0.1 }", "from 0.5 to 2"),
    "C0": ("pan_zero_emission_deg = { value = 181, u = 0.1 }", "from 0 to 180"),
    "convention": ("aperture_convention = 'cone'", "azimuth"),
    "prior is text": ("prior = 'a'", "a table"),
}
"""The same of [rig]."""
TABLES_REFUSED = {
    "fixed harmonic without period, dotted": (
        "[rig]\nharmonic_period_deg.pan = 360\n[rig.prior]\nharmonic_deg.tilt.2.sin = { value = 0.1, u = 0 }",
        4,
        "harmonic_period_deg.tilt",
    ),
    "both spellings of a period": (
        "[rig]\n'harmonic_period_deg.pan' = 36\nharmonic_period_deg.pan = 36",
        None,
        "remove one",
    ),
    "second amplitude of one period": (
        "[rig]\nharmonic_period_deg.pan = 36\n[rig.prior]\n'harmonic_amplitude_deg.pan.2' = { value = 0, u = 0.1 }",
        4,
        r"value = \[P1, P2\]",
    ),
    "declared twice": (
        "[rig]\nbaseline_mm = { value = 200, u = 0 }\n[rig.prior]\nbaseline_mm = { value = 201, u = 0 }",
        4,
        "remove one",
    ),
    "both spellings": (
        "[rig.prior]\n'backlash_deg.pan' = { value = 0, u = 1 }\nbacklash_deg.pan = { value = 0, u = 1 }",
        None,
        "remove one",
    ),
    "nan": ("[rig]\n\nbaseline_mm = { value = nan, u = 0.1 }", 3, "finite number"),
    "rig is text": ("rig = 'a'", 1, "a table"),
}
"""A whole file, the line that is named (not where TOML has none), and what is said."""
RIG_REFUSED = {
    **{name: (f"[rig.prior]\n{entry}", 2, said) for name, (entry, said) in PRIORS_REFUSED.items()},
    **{name: (f"[rig]\n{entry}", 2, said) for name, (entry, said) in ENTRIES_REFUSED.items()},
    **TABLES_REFUSED,
}


@pytest.mark.parametrize("name", RIG_REFUSED)
def test_rig_table_refusals_state_a_remedy(name):
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
    assert rig.table.priors["backlash_deg.pan"] == TWO_MIRROR.priors["backlash_deg.pan"]
    assert rig.truth["focal_scale"] == Prior(1.002, 0.0)
    assert set(rig.truth) == set(TWO_MIRROR.priors)
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
    "sheet name": ("d1 = 175", '"d\\u001b" = 175', 12, "sheets.d\\x1b"),
    "port": ('"/dev/ttyACM0"', "'spy:///dev/ptmx?file=a'", 16, "positioner.port"),
    "baud": ("115200", "-1", 17, "positioner.baud"),
    "limits": ("pan_max_steps = 2000", "pan_max_steps = -2001", 19, "positioner.pan_max_steps"),
    "positioner key": ("settle_s", "settle_ms", 20, "positioner.settle_ms"),
    "watchdog": ("settle_s = 0.2", "laser_watchdog_s = 60", 20, "positioner.laser_watchdog_s"),
    "home": ("settle_s = 0.2", "tilt_home_steps = 1.5", 20, "positioner.tilt_home_steps"),
    "option": ("settle_s = 0.2", "options = { laser = [1] }", 20, "positioner.options.laser"),
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


def test_options_of_drivers_stand_beside_the_other_entries(tmp_path):
    options = (
        "settle_s = 0.2\n[positioner.options]\nlaser = 'M8'\nunwatched = true\npower = 0.5\n[cameras.options]\nn = 3"
    )
    rig = read_rig(write_rig(tmp_path, RIG_FILE.replace("settle_s = 0.2", options)))
    entries = {key: value for key, value in rig.positioner.items() if key.startswith("options.")}
    assert entries == {"options.laser": "M8", "options.unwatched": 1, "options.power": 0.5}
    assert rig.cameras["options.n"] == 3 and rig.cameras["source"] == "opencv"


def test_stereo_of_a_rig_must_not_link_outside(tmp_path):
    folder = tmp_path / "rig"
    folder.mkdir()
    path = write_rig(folder)
    (folder / "stereo.json").rename(tmp_path / "stereo.json")
    (folder / "stereo.json").symlink_to(tmp_path / "stereo.json")
    with pytest.raises(InputError, match="leaves the folder"):
        read_rig(path)


def test_absolute_encoders_are_read_written_and_part_of_the_rig():
    both = rig_table('[rig]\nabsolute = ["tilt", "pan"]\n')
    assert both.absolute == ("pan", "tilt")
    assert rig_table(rig_table_toml(both)) == both
    plain = rig_table("[rig]\n")
    assert plain.absolute == () and "absolute" not in rig_table_toml(plain)


@pytest.mark.parametrize("value", ['"pan"', "[]", '["pan", "pan"]', '["azimuth"]', "[1]", "true"])
def test_other_words_for_absolute_encoders_are_refused(value):
    with pytest.raises(InputError, match=r'absolute.*list of "pan" and "tilt", or of one of them'):
        rig_table(f"[rig]\nabsolute = {value}\n")


@pytest.mark.parametrize(
    ("entries", "words"),
    [
        (
            'absolute = ["pan"]\n[rig.prior]\nhome_sd_deg.pan = { value = 0.1, u = 0 }',
            "no homing sets an absolute",
        ),
        ("[rig.prior]\nhome_sd_deg.tilt = { value = 0.0, u = 0 }", "home_sd_deg"),
        ("home_sd_deg.tilt = { value = 0.1, u = 0 }", r"\[rig.prior\]"),
    ],
)
def test_other_scatters_of_homings_are_refused(entries, words):
    with pytest.raises(InputError, match=words):
        rig_table(f"[rig]\n{entries}\n")
