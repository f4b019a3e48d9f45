"""The twin as drivers: `driver = "simulated"` in `[positioner]` and `[cameras]` of a rig file.

They serve `doctor`, tests of code that drives an instrument, and as an example for other drivers. Positioner
and cameras of one rig file and seed (`options.seed`) share one twin, with the first sheet of `[sheets]` in front of its
cameras. `tvsbayes acquire --simulate` rehearses a whole run, in which sheets change places.
"""

from __future__ import annotations

from weakref import WeakValueDictionary

from tvsbayes.acquisition.observation import twin_renderer
from tvsbayes.acquisition.simulated_instrument import Instrument, Renderer
from tvsbayes.cameras.capture import CameraSettings, StereoImage
from tvsbayes.errors import entry_refusal
from tvsbayes.instrument.rig import Rig, Setting
from tvsbayes.positioner.driver import SerialPositioner

_TWINS: WeakValueDictionary[tuple[str, int], Instrument] = WeakValueDictionary()
"""Twins in use, by rig file and seed."""


def simulated_positioner(rig: Rig) -> SerialPositioner:
    """The package's driver on the device model, with its own virtual clock: homing takes no real time."""
    return _twin(rig, rig.positioner, "positioner").positioner()


def simulated_cameras(rig: Rig) -> SimulatedCamera:
    """The twin's cameras."""
    instrument = _twin(rig, rig.cameras, "cameras")
    return SimulatedCamera(instrument, twin_renderer(rig, instrument.seed))


class SimulatedCamera:
    """See `StereoCamera`: a new exposure of the twin for every pair."""

    def __init__(self, instrument: Instrument, renderer: Renderer):
        self._instrument, self._render, self._frame = instrument, renderer, 0

    def grab(self) -> StereoImage:
        """See `StereoCamera.grab`."""
        self._frame += 1
        return self._render(self._instrument.light(), self._instrument.motions, self._frame)

    def settings(self) -> CameraSettings:
        """See `StereoCamera.settings`."""
        return CameraSettings({})

    def close(self) -> None:
        """See `StereoCamera.close`."""


def _twin(rig: Rig, table: dict[str, Setting], name: str) -> Instrument:
    unknown = [key for key in table if key.startswith("options.") and key != "options.seed"]
    seed = table.get("options.seed", 0)
    if unknown or not isinstance(seed, int) or seed < 0:
        remedy = "leave out what a simulated instrument does not have"
        found, allowed = ", ".join(unknown) or f"seed {seed}", "options.seed, a whole number from 0"
        raise entry_refusal("options", name, "options", found, allowed, remedy)
    key = str(rig.path), seed
    twin = _TWINS.get(key)
    if twin is None:
        twin = _TWINS[key] = Instrument(rig, seed)
        if rig.sheets_mm:
            twin.place(next(iter(rig.sheets_mm)), 0)
    return twin
