"""Positioners and cameras by the name of their driver in the rig file, and the bench of them.

A driver is an entry point of the group `tvsbayes.positioners` or `tvsbayes.cameras`: a function that takes the `Rig`
and returns a connected `Positioner` or an open `StereoCamera` (data/docs/instrument.md, "Your own hardware"). Drivers
of this package need no entry point, so that a source tree without an installation has them.
"""

from __future__ import annotations

import datetime
import importlib
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from functools import partial
from importlib import metadata
from typing import Any

from tvsbayes.acquisition.bench import Bench
from tvsbayes.acquisition.observation import CameraObserver, Detector
from tvsbayes.acquisition.operator import Operator
from tvsbayes.cameras.capture import StereoCamera
from tvsbayes.errors import InputError, TvsError, closest, entry_refusal, escaped, fault
from tvsbayes.instrument.rig import Rig
from tvsbayes.positioner.interface import DEFAULT_DRIVER, Positioner, Triggering
from tvsbayes.results.records import plain

POSITIONERS = "tvsbayes.positioners"
CAMERAS = "tvsbayes.cameras"
DEFAULT_CAMERAS = "opencv"
OWN: Mapping[str, Mapping[str, str]] = {
    POSITIONERS: {
        "serial": "tvsbayes.positioner.serial_port:serial_positioner",
        "grbl": "tvsbayes.positioner.serial_port:grbl_positioner",
        "simulated": "tvsbayes.acquisition.simulated_bench:simulated_positioner",
    },
    CAMERAS: {
        "opencv": "tvsbayes.cameras.capture:opencv_cameras",
        "genicam": "tvsbayes.cameras.genicam:genicam_cameras",
        "simulated": "tvsbayes.acquisition.simulated_bench:simulated_cameras",
    },
}
"""Drivers of this package by the group of entry points: "module:function" by name."""
_TABLES = {POSITIONERS: "positioner", CAMERAS: "cameras"}


def positioner_of(rig: Rig) -> Positioner:
    """The positioner that `[positioner]` of a rig file names, connected.

    Raises:
        InputError: no such driver, or it does not support the settings of the rig file.
        DeviceFault: it cannot be reached.
    """
    positioner: Positioner = _connected(POSITIONERS, str(rig.positioner.get("driver", DEFAULT_DRIVER)), rig)
    return positioner


def cameras_of(rig: Rig) -> StereoCamera:
    """The cameras that `[cameras]` of a rig file names, open.

    Raises:
        InputError: no such driver, or it does not support the settings of the rig file.
        DeviceFault: they cannot be opened or set.
    """
    camera: StereoCamera = _connected(CAMERAS, str(rig.cameras.get("driver", DEFAULT_CAMERAS)), rig)
    return camera


def connect_trigger(positioner: Positioner, camera: StereoCamera) -> None:
    """Connects a positioner's trigger line to cameras that expose on a pulse.

    Raises:
        InputError: the cameras need a pulse, and the positioner has no such line.
    """
    if not getattr(camera, "wants_pulse", False):
        return
    if not isinstance(positioner, Triggering):
        message, remedy = "this positioner offers no trigger line", "leave out [cameras.options] trigger"
        raise InputError("trigger", f"{message}; {remedy}", column="cameras.options.trigger", remedy=remedy)
    camera.use_trigger(positioner.trigger)  # type: ignore[attr-defined]


@contextmanager
def hardware(rig: Rig, detector: Detector, operator: Operator) -> Iterator[Bench]:
    """Positioner and cameras of a rig file; closed at the end.

    Raises:
        InputError: the rig file names no device.
        DeviceFault: they cannot be opened or set.
    """
    positioner = positioner_of(rig)
    try:
        camera = cameras_of(rig)
    except BaseException:
        positioner.close()
        raise
    try:
        connect_trigger(positioner, camera)
        settings = camera.settings()
        details = {"device": dict(positioner.identity), "cameras": plain(settings)}
        observer = CameraObserver(camera, detector)
        warnings = (*getattr(positioner, "warnings", ()), *settings.warnings)
        utc = partial(datetime.datetime.now, datetime.UTC)
        yield Bench(positioner, observer, operator, time, utc, details, warnings=warnings)
    finally:
        positioner.close()
        camera.close()


def known(group: str) -> dict[str, str]:
    """Drivers of a group as "module:function" by name; those of this package come first and cannot be replaced."""
    installed = {entry.name: entry.value for entry in metadata.entry_points(group=group)}
    return {**OWN[group], **{name: value for name, value in installed.items() if name not in OWN[group]}}


def _connected(group: str, name: str, rig: Rig) -> Any:
    """Make a device from a rig file by its driver, whose errors become faults with its name."""
    factory = _factory(group, name)
    try:
        return factory(rig)
    except TvsError:
        raise
    except Exception as error:
        found = f"driver {escaped(name)} failed: {type(error).__name__}: {escaped(str(error), 200)}"
        raise fault("driver", found, "see the manual of the package that provides it") from error


def _factory(group: str, name: str) -> Callable[[Rig], Any]:
    drivers = known(group)
    if name not in drivers:
        remedy = f"{closest(name, tuple(drivers))}, or install the package that provides it"
        raise entry_refusal("driver", _TABLES[group], "driver", escaped(name), ", ".join(drivers), remedy)
    module, _, function = drivers[name].partition(":")
    try:
        factory: Callable[[Rig], Any] = getattr(importlib.import_module(module), function)
    except (ImportError, AttributeError) as error:
        found = f"driver {escaped(name)} cannot be loaded: {escaped(str(error), 200)}"
        remedy = "install the package that provides it again, with its dependencies"
        raise InputError(
            "driver", f"{found}; {remedy}", column=f"{_TABLES[group]}.driver", found=found, remedy=remedy
        ) from error
    return factory
