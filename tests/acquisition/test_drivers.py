"""Drivers by their name in the rig file: our own, and one that another package brings."""

from __future__ import annotations

import importlib
import sys
from dataclasses import replace

import pytest
from support.bench_runs import RIG_FILE

from tvsbayes.acquisition.doctor import examine
from tvsbayes.acquisition.drivers import CAMERAS, OWN, POSITIONERS, cameras_of, known, positioner_of
from tvsbayes.errors import DeviceFault, InputError
from tvsbayes.instrument.rig import read_rig

FOREIGN = '''
"""A driver as another package would bring it: our device model, reached in its own way."""

from tvsbayes.acquisition.simulated_instrument import Instrument


def turntable(rig):
    if rig.positioner.get("options.address") != "10.0.0.7":
        raise RuntimeError("no table at this address")
    return Instrument(rig, 1).positioner()
'''
ENTRY_POINTS = "[tvsbayes.positioners]\nturntable = lab_turntable:turntable\nserial = lab_turntable:hostile\n"


@pytest.fixture
def rig():
    return read_rig(RIG_FILE)


def test_each_of_ours_can_be_loaded():
    for target in (target for drivers in OWN.values() for target in drivers.values()):
        module, _, function = target.partition(":")
        assert callable(getattr(importlib.import_module(module), function)), target


@pytest.fixture(params=["before", "behind"])
def installed(request, tmp_path, monkeypatch):
    """A package with a driver, as pip would leave it, before or behind our own: of two of one name the last counts."""
    (tmp_path / "lab_turntable.py").write_text(FOREIGN)
    info = tmp_path / "lab_turntable-1.0.dist-info"
    info.mkdir()
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: lab-turntable\nVersion: 1.0\n")
    (info / "entry_points.txt").write_text(ENTRY_POINTS)
    path = [str(tmp_path), *sys.path] if request.param == "before" else [*sys.path, str(tmp_path)]
    monkeypatch.setattr(sys, "path", path)
    importlib.invalidate_caches()
    yield
    sys.modules.pop("lab_turntable", None)


@pytest.mark.usefixtures("installed")
def test_a_driver_of_another_package_drives(rig):
    table = {"driver": "turntable", "options.address": "10.0.0.7"}
    positioner = positioner_of(replace(rig, positioner=table))
    positioner.home()
    assert positioner.move_to(20, -5).pan_steps == 20
    positioner.close()
    assert known(POSITIONERS)["serial"] == OWN[POSITIONERS]["serial"], "a shipped driver is not replaced"
    with pytest.raises(DeviceFault, match="turntable failed: RuntimeError: no table") as caught:
        positioner_of(replace(rig, positioner={"driver": "turntable"}))
    assert caught.value.code == "driver" and caught.value.exit_code == 5


@pytest.mark.parametrize(("group", "table"), [(POSITIONERS, "positioner"), (CAMERAS, "cameras")])
def test_unknown_drivers_are_refused_with_those_there_are(rig, group, table):
    make = {POSITIONERS: positioner_of, CAMERAS: cameras_of}[group]
    with pytest.raises(InputError) as caught:
        make(replace(rig, **{table: {"driver": "simulatd"}}))
    assert caught.value.column == f"{table}.driver" and "did you mean simulated?" in caught.value.remedy
    assert all(name in caught.value.allowed for name in OWN[group])


def test_a_driver_that_cannot_be_loaded_is_named(rig, monkeypatch):
    drivers = {**OWN, POSITIONERS: {**OWN[POSITIONERS], "gone": "tvsbayes.positioner.serial_port:no_such"}}
    monkeypatch.setattr("tvsbayes.acquisition.drivers.OWN", drivers)
    with pytest.raises(InputError, match="driver gone cannot be loaded"):
        positioner_of(replace(rig, positioner={"driver": "gone"}))


def test_a_board_without_a_port_has_the_remedy_to_name_one(rig):
    for driver in ("serial", "grbl"):
        with pytest.raises(InputError, match="names no serial port"):
            positioner_of(replace(rig, positioner={"driver": driver}))


def test_the_doctor_examines_a_simulated_bench(small_rig, tmp_path):
    """No port is needed, and both drivers show the same twin: the cameras see its laser."""
    simulated = {"driver": "simulated", "options.seed": 3}
    rig = replace(small_rig, positioner=dict(simulated), cameras={**simulated, "spot_sd_px": 0.08})
    checks = {check.name: check for check in examine(rig, tmp_path)}
    assert "port" not in checks and not [c for c in checks.values() if c.status == "fault"], checks
    assert checks["switches"].found == "pan: home free, limit closed; tilt: home free, limit closed"
    with pytest.raises(InputError, match="seed"):
        cameras_of(replace(rig, cameras={"driver": "simulated", "options.sed": 3}))
