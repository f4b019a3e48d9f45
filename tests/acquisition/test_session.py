"""From files and options to a finished run: the command, what it refuses, and what a kill leaves."""

from __future__ import annotations

import json
import random
import signal
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import pytest
from support.bench_runs import HEADER, RIG_FILE, Run, ctrl_c, events, small_plan

from tvsbayes.acquisition.journal import LOG, read_journal
from tvsbayes.acquisition.journal_check import verify
from tvsbayes.acquisition.recorder import recorded
from tvsbayes.acquisition.run_identity import check_same, identity, setup_changes, setup_entries
from tvsbayes.acquisition.session import acquire, begin
from tvsbayes.cli.main import run
from tvsbayes.errors import InputError
from tvsbayes.instrument.campaign import read_campaign
from tvsbayes.instrument.parameters import Prior
from tvsbayes.instrument.plan import write_plan

pytestmark = pytest.mark.usefixtures("ctrl_c_works")


def test_same_seed_same_bytes(mounted_rig, tmp_path):
    for name in "ab":
        acquire(mounted_rig, small_plan(1), tmp_path / name, simulate=True, seed=9)
    for file in ("moves.csv", "spots.csv", "campaign.toml", "truth.json", LOG):
        assert (tmp_path / "a" / file).read_bytes() == (tmp_path / "b" / file).read_bytes(), file
    acquire(mounted_rig, small_plan(1), tmp_path / "other", simulate=True, seed=10)
    assert (tmp_path / "other" / "spots.csv").read_bytes() != (tmp_path / "a" / "spots.csv").read_bytes()


def test_resume_with_another_plan_rig_or_seed_is_refused(mounted_rig, tmp_path):
    folder, plan = tmp_path / "c", small_plan()
    Run(mounted_rig, folder, plan, at=2, then=ctrl_c).engine.run()
    size = (folder / LOG).stat().st_size
    other_plan = [*plan[:-1], replace(plan[-1], point=None, experiment=None)]
    other_rig = replace(mounted_rig, sheets_mm={**mounted_rig.sheets_mm, "d1": 180.0})
    for arguments, word in (
        ((mounted_rig, other_plan, True, HEADER), "another plan"),
        ((other_rig, plan, True, HEADER), "another rig"),
        ((mounted_rig, plan, True, {**HEADER, "seed": 6}), "seed"),
    ):
        with pytest.raises(InputError, match=word):
            begin(folder, *arguments)
    assert (folder / LOG).stat().st_size == size
    begin(folder, mounted_rig, plan, True, HEADER).close()
    with pytest.raises(InputError, match="no journal"):
        acquire(mounted_rig, plan, tmp_path / "nowhere", simulate=True, resume=True)


def test_a_run_begun_before_looks_scattered_goes_on(mounted_rig):
    """Its journal does not hold them; a scatter stated since then is another rig."""
    plan, header = small_plan(), {"synthetic": True, "seed": 5}
    before = {**identity(mounted_rig, plan, True), **header}
    before["rig"] = {key: value for key, value in before["rig"].items() if "look_scatter" not in key}
    check_same(before, mounted_rig, plan, header)
    name, wide = "look_scatter_deg.pan", Prior(0.0, 0.02, "half-normal")
    table = replace(mounted_rig.table, priors={**mounted_rig.table.priors, name: wide})
    for other in (replace(mounted_rig, table=table), replace(mounted_rig, truth={**mounted_rig.truth, name: wide})):
        with pytest.raises(InputError, match="another rig"):
            check_same(before, other, plan, header)


def test_a_rig_that_is_reached_or_driven_otherwise_goes_on(mounted_rig, tmp_path):
    """What has no effect on the measurement may change; the change is recorded, except for costs."""
    plan, folder = small_plan(1), tmp_path / "c"
    Run(mounted_rig, folder, plan, at=2, then=ctrl_c).engine.run()
    positioner = {"port": "/dev/ttyACM1", "speed_steps_per_s": 400.0, "pan_max_steps": 500, "settle_s": 0.5}
    setup = {"positioner": positioner, "cameras": {"right": "/dev/video2", "exposure": -5.0}}
    new = {name: {**getattr(mounted_rig, name), **entries} for name, entries in setup.items()}
    changed = replace(mounted_rig, **new, costs_s={**mounted_rig.costs_s, "move_s": 9.0})
    lines = setup_changes(read_journal(folder).records, changed, synthetic=True)
    assert len(lines) == 6 and all("was not stated and is" in line for line in lines), lines
    assert Run(changed, folder, plan, resume=True, start=1).engine.run().reason == "done"
    before, after = (start["setup"] for start in events(folder, "start"))
    stated = {f"{name}.{key}": value for name, entries in setup.items() for key, value in entries.items()}
    assert stated.items() <= after.items() and not stated.keys() & before.keys()


def test_what_changes_the_data_is_refused_by_name(mounted_rig, tmp_path):
    """With the old and the new value; on the bench a sheet may stand elsewhere, in the twin not."""
    folder, plan = tmp_path / "c", small_plan(1)
    Run(mounted_rig, folder, plan, at=2, then=ctrl_c).engine.run()
    table, stereo = mounted_rig.table, mounted_rig.stereo
    priors = {**table.priors, "mirror_offset_mm": replace(table.priors["mirror_offset_mm"], value=31.5)}
    positioners = {"driver": {"driver": "grbl"}, "home": {"pan_home_steps": -900}}
    changed = {
        "[rig] mirror_offset_mm": (replace(mounted_rig, table=replace(table, priors=priors)), "31.5", "value = 30"),
        "stereo": (replace(mounted_rig, stereo=replace(stereo, rms_px=0.5)), '"', '"'),
        "[positioner] driver": (replace(mounted_rig, positioner=positioners["driver"]), '"grbl"', '"serial"'),
        "[positioner] pan_home_steps": (replace(mounted_rig, positioner=positioners["home"]), "-900", "not stated"),
        "[sheets] d1": (replace(mounted_rig, sheets_mm={**mounted_rig.sheets_mm, "d1": 180.0}), "180.0", "175.0"),
        "[cameras] spot_sd_px": (replace(mounted_rig, cameras={"spot_sd_px": 0.2}), "0.2", "0.08"),
    }
    for place, (rig, new, old) in changed.items():
        with pytest.raises(InputError, match="begin a new campaign") as caught:
            begin(folder, rig, plan, True, HEADER)
        assert caught.value.column == place and new in caught.value.found and old in caught.value.allowed, place
    bench = {"name": "test", "created": HEADER["created"]}
    begin(tmp_path / "bench", mounted_rig, plan, False, bench).close()
    begin(tmp_path / "bench", changed["[sheets] d1"][0], plan, True, bench).close()
    with pytest.raises(InputError, match="mirror_offset_mm"):
        begin(tmp_path / "bench", changed["[rig] mirror_offset_mm"][0], plan, True, bench)


def test_commands(mounted_rig, tmp_path, capsys):
    write_plan(small_plan(1), tmp_path / "plan.csv")
    arguments = [str(RIG_FILE), str(tmp_path / "plan.csv"), str(tmp_path / "c")]
    assert run(["acquire", *arguments, "--dry-run", "--json"]) == 0
    assert len(json.loads(capsys.readouterr().out)["steps"]) == 11 and not (tmp_path / "c").exists()
    assert run(["acquire", *arguments, "--simulate", "--centroids", "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["ok"] == 4
    files = {"campaign.toml", "moves.csv", "spots.csv", "stereo.json"} | {LOG, "truth.json"}
    assert {path.name for path in (tmp_path / "c").iterdir()} == files, "no empty folders for pictures"
    assert run(["acquire", *arguments, "--simulate", "--centroids", "--json"]) == 2
    assert json.loads(capsys.readouterr().out)["error"]["code"] == "occupied"
    assert run(["acquire", *arguments[:2], str(tmp_path / "d"), "--json"]) == 2
    assert json.loads(capsys.readouterr().out)["error"]["code"] == "usage" and not (tmp_path / "d").exists()
    assert run(["acquire", *arguments[:2], str(tmp_path / "d"), "--laser-class", "3B", "--json"]) == 2
    assert json.loads(capsys.readouterr().out)["error"]["code"] == "positioner"
    assert run(["check", str(tmp_path / "c"), "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["journal"]["stopped"] == "done"
    log = tmp_path / "c" / LOG
    lines = log.read_bytes().splitlines(keepends=True)
    log.write_bytes(b"".join([*lines[:9], lines[9].replace(b"0", b"1", 1), *lines[10:]]))
    assert run(["check", str(tmp_path / "c"), "--json"]) == 2
    assert json.loads(capsys.readouterr().out)["error"]["line"] == 10
    assert run(["check", str(tmp_path / "c"), "--repair-to", str(tmp_path / "fixed"), "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["lost_lines"] == [10]
    assert run(["check", str(tmp_path / "fixed"), "--json"]) == 0
    assert len(read_campaign(tmp_path / "fixed").moves) >= 1
    capsys.readouterr()
    assert run(["check", str(RIG_FILE.parent), "--repair-to", str(tmp_path / "x"), "--json"]) == 2
    assert "acquire" in json.loads(capsys.readouterr().out)["error"]["message"]


def test_command_tells_reference_looks_from_those_of_the_plan(mounted_rig, tmp_path, capsys):
    plan, folder = small_plan(), tmp_path / "c"
    write_plan(plan, tmp_path / "plan.csv")
    Run(mounted_rig, folder, plan, at=5, then=ctrl_c).engine.run()
    arguments = ["acquire", str(RIG_FILE), str(tmp_path / "plan.csv"), str(folder), "--simulate", "--centroids"]
    assert run([*arguments, "--resume", "--seed", "5"]) == 0
    first = capsys.readouterr().out.splitlines()[0]
    assert first.endswith("done, 10 of 10 looks count (8 of the plan, 2 reference looks of resumed runs)"), first
    assert run([*arguments[:3], str(tmp_path / "whole"), *arguments[4:]]) == 0
    assert capsys.readouterr().out.splitlines()[0].endswith("done, 8 of 8 looks count")


KILLED = """
import os, signal, sys

calls, left = sys.argv[1].split(","), int(sys.argv[2])

def mortal(name, call):
    def called(*arguments):
        global left
        left -= 1
        if left == 0:
            if name == "write":
                call(arguments[0], arguments[1][: len(arguments[1]) // 2])
            os.kill(os.getpid(), signal.SIGKILL)
        return call(*arguments)
    return called

for name in calls:
    setattr(os, name, mortal(name, getattr(os, name)))

from tvsbayes.cli.main import run

sys.exit(run(sys.argv[3:]))
"""
"""A command that is killed at the n-th of some calls of `os`, in the middle of a write; 0: never.

By itself, since a clock would kill another call in every run, or none.
"""
CALLS_PER_LOOK = 2
"""At least: the lines of a placement or a motion and of the look are written one by one, and flushed."""


def killed_runs(tmp_path: Path, kills: int, seed: int, experiments: int) -> int:
    """Kill `acquire --simulate` again and again, resuming each time, then let it finish: looks of the plan."""
    rng = random.Random(seed)
    calls_max = 4 * experiments * CALLS_PER_LOOK // max(kills, 1)
    plan = small_plan(experiments)
    write_plan(plan, tmp_path / "plan.csv")
    folder = tmp_path / "c"
    command = ["acquire", str(RIG_FILE), str(tmp_path / "plan.csv"), str(folder)]
    before = 0
    for number in range(kills + 1):
        resume = ["--resume"] if number else []
        # Without a whole first line there is nothing to go on with.
        call = rng.randint(2, calls_max) if number < kills else 0
        calls = "fsync,replace" if number % 2 else "write"
        process = subprocess.run(
            [sys.executable, "-c", KILLED, calls, str(call), *command, "--simulate", "--centroids", *resume],
            capture_output=True,
            cwd=Path(__file__).parents[2],
            check=False,
        )
        assert process.returncode == (-signal.SIGKILL if call else 0), (call, process.stderr.decode())
        reading = read_journal(folder)
        # Centroids: all that a run writes through a descriptor are lines of its log.
        assert bool(reading.torn) == (call > 0 and calls == "write")
        record = recorded(reading.records)
        assert len(record.spots) >= before, "a look is gone"
        before = len(record.spots)
        verify(folder)
        if record.moves and (folder / "campaign.toml").exists():
            assert len(read_campaign(folder).spots) >= 0.99 * len(record.spots) - 1
    campaign = read_campaign(folder)
    points = [(s.experiment, s.point) for s in campaign.spots if s.experiment is not None]
    assert points == [(s.experiment, s.point) for s in plan if s.action == "look"]
    return len(points)


def test_killed_acquisition_is_resumed_without_a_loss(tmp_path):
    assert killed_runs(tmp_path, 3, seed=1, experiments=15) == 60


def test_passwords_of_cameras_stay_out_of_the_journal(mounted_rig):
    """A campaign folder is handed on; the address identifies the camera."""
    sources = {"left": "rtsp://eye:secret@10.0.0.2/1", "right": "http://eye:secret@10.0.0.3/a?x=1@2"}
    entries = setup_entries(replace(mounted_rig, cameras={**sources, "exposure": -6.0}), synthetic=False)
    assert entries["cameras.left"] == "rtsp://10.0.0.2/1" and entries["cameras.right"] == "http://10.0.0.3/a?x=1@2"
    assert entries["cameras.exposure"] == -6.0
