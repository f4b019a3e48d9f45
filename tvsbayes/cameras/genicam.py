"""GenICam cameras (GigE Vision, USB3 Vision) through a GenTL producer, by `harvesters` (`driver = "genicam"`).

The extra `tvsbayes[genicam]` installs `harvesters`; the producer, a `.cti` file, comes from the camera's maker and is
named in `[cameras.options]`. Pictures are triggered, by software in one call or by a line that the positioner pulses,
so that each is exposed after the request. A camera without a trigger runs freely; then its buffers are emptied first,
and the next frames, which may be older than the request, are left out.

Mono8 to Mono16 and colour of 8 bits are used at full depth. Names with `_s` are in seconds.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from tvsbayes.cameras.capture import PIPELINE_FRAMES, CameraSettings, StereoImage
from tvsbayes.errors import DeviceFault, InputError, entry_refusal, escaped, fault
from tvsbayes.instrument.campaign import CAMERAS
from tvsbayes.instrument.rig import Rig, Setting, driver_options

FETCH_S = 5.0
"""Longest wait for a picture after its trigger."""
OPTIONS = ("producer", "pixel_format", "gain", "trigger")
PIXEL_BITS = {"Mono8": 8, "Mono10": 10, "Mono12": 12, "Mono14": 14, "Mono16": 16, "BGR8": 8, "RGB8": 8}
"""Accepted formats by their PFNC name, with the bits of their grey levels."""
SOFTWARE = "Software"
DRAIN_BUFFERS_MAX = 64
"""Largest number of buffers to empty; producers use about five."""
STEP_SHARE = 0.05
STEPS = {"ExposureTime": 1.0, "Gain": 0.1}
"""Largest relative and absolute deviation of a value that is read back, since cameras round: in us, and in the camera's
unit of gain, mostly dB."""
_refused = partial(entry_refusal, "cameras", "cameras")


@dataclass(frozen=True)
class GenicamSettings:
    """Settings in the rig file.

    Attributes:
        producer: the `.cti` file.
        cameras: serial numbers or user-defined names of left and right.
        pixel_format: one of `PIXEL_BITS`.
        exposure_us: microseconds; None keeps the camera's value.
        gain: in the camera's unit; None keeps the camera's value.
        trigger: source of the trigger, a `TriggerSource` of the camera: "Software", or a line.
    """

    producer: str
    cameras: tuple[str, str]
    pixel_format: str = "Mono8"
    exposure_us: float | None = None
    gain: float | None = None
    trigger: str = SOFTWARE

    @classmethod
    def of(cls, table: Mapping[str, Setting]) -> GenicamSettings:
        """The settings of the table `[cameras]`.

        Raises:
            InputError: an entry that is missing or does not belong to GenICam cameras.
        """
        options = driver_options(table, "cameras", OPTIONS)
        if "producer" not in options:
            remedy = "name the maker's GenTL producer, a .cti file, in [cameras.options]"
            raise _refused("options.producer", "nothing", "the path of a .cti file", remedy)
        if "left" not in table or "right" not in table:
            remedy = 'write left = "SERIAL" and right = "SERIAL"'
            raise _refused("left", "no pair", "serial numbers or names of both cameras", remedy)
        pixel_format = str(options.get("pixel_format", "Mono8"))
        if pixel_format not in PIXEL_BITS:
            raise _refused("options.pixel_format", escaped(pixel_format), ", ".join(PIXEL_BITS), "choose one of these")
        exposure, gain = table.get("exposure"), options.get("gain")
        return cls(
            str(options["producer"]),
            (str(table["left"]), str(table["right"])),
            pixel_format,
            None if exposure is None else float(exposure),
            None if gain is None else float(gain),
            str(options.get("trigger", SOFTWARE)),
        )


def genicam_cameras(rig: Rig) -> GenicamCamera:
    """The driver `genicam`.

    Raises:
        InputError: `harvesters` is not installed, or `[cameras]` does not fit.
        DeviceFault: a camera is missing or refuses a setting.
    """
    stated = GenicamSettings.of(rig.cameras)
    try:
        from harvesters.core import Harvester
    except ImportError as error:
        remedy = "pip install 'tvsbayes[genicam]'"
        raise InputError("genicam", f"GenICam cameras need harvesters; {remedy}", remedy=remedy) from error
    if not Path(stated.producer).is_file():
        # Harvesters would continue without it, and find no cameras.
        allowed, remedy = "the GenTL producer of the cameras' maker", "install it, or correct the path of its .cti file"
        raise _refused("options.producer", f"no file {escaped(stated.producer, 200)}", allowed, remedy)
    return GenicamCamera(Harvester(), stated, rig.stereo_pair.image_width, rig.stereo_pair.image_height)


class GenicamCamera:
    """See `StereoCamera`.

    Args:
        harvester: a `harvesters.core.Harvester` without files; this object closes it.
        stated: settings of the rig file.
        width: width of one picture, px.
        height: height of one picture, px.

    Raises:
        DeviceFault: the producer cannot be used, or a camera is missing or refuses a setting.
    """

    def __init__(self, harvester: Any, stated: GenicamSettings, width: int, height: int):
        self._harvester, self._stated = harvester, stated
        self._size = width, height
        self._acquirers: list[Any] = []
        self._warnings: list[str] = []
        self._pulse: Callable[[], object] | None = None
        try:
            self._open()
        except Exception as error:
            self.close()
            if isinstance(error, DeviceFault):
                raise
            raise fault(
                "camera", f"the GenTL producer: {_error_text(error)}", "check the .cti file and the cables"
            ) from error

    def _open(self) -> None:
        self._harvester.add_file(self._stated.producer)
        self._harvester.update()
        for name, key in zip(CAMERAS, self._stated.cameras, strict=True):
            devices = self._harvester.device_info_list
            matches = [
                n for n, d in enumerate(devices) if key in (_text(d, "serial_number"), _text(d, "user_defined_name"))
            ]
            if len(matches) != 1:
                serials = ", ".join(_text(d, "serial_number") for d in devices) or "none"
                found = f"{name}: {len(matches)} cameras are {escaped(key)}; there are: {escaped(serials, 200)}"
                raise fault("camera", found, "correct [cameras], check cable and supply, close other programs")
            acquirer = self._harvester.create(matches[0])
            self._acquirers.append(acquirer)
            self._fix(name, acquirer.remote_device.node_map)
            acquirer.start()

    def _fix(self, name: str, nodes: Any) -> None:
        """Set size, format, software trigger and exposure; switch automatic modes off."""
        stated, (width, height) = self._stated, self._size
        features: dict[str, object] = {"PixelFormat": stated.pixel_format, "Width": width, "Height": height}
        if hasattr(nodes, "TriggerMode"):
            features |= {"TriggerSelector": "FrameStart", "TriggerMode": "On", "TriggerSource": stated.trigger}
        elif stated.trigger == SOFTWARE:
            self._warnings.append(f"{name}: runs freely, without a trigger; buffers are emptied before every look")
        else:
            raise fault("camera-setting", f"{name}: no trigger", "leave out [cameras.options] trigger")
        if stated.exposure_us is not None:
            features["ExposureTime"] = stated.exposure_us
        if stated.gain is not None:
            features["Gain"] = stated.gain
        for automatic in ("ExposureAuto", "GainAuto", "BalanceWhiteAuto"):
            if not _set(nodes, automatic, "Off") and hasattr(nodes, automatic):
                self._warnings.append(f"{name}: {automatic} cannot be switched off; fix it with the maker's program")
        for node, value in features.items():
            if not _set(nodes, node, value):
                found = f"{name}: {node} = {value} was not taken"
                raise fault("camera-setting", found, "see what the maker's program allows, correct [cameras]")

    @property
    def wants_pulse(self) -> bool:
        """Whether exposures wait for a pulse on a line."""
        return self._stated.trigger != SOFTWARE

    def use_trigger(self, pulse: Callable[[], object]) -> None:
        """Set the function that pulses the trigger line of the cameras."""
        self._pulse = pulse

    def settings(self) -> CameraSettings:
        """See `StereoCamera.settings`."""
        values = {}
        for name, acquirer in zip(CAMERAS, self._acquirers, strict=True):
            nodes = acquirer.remote_device.node_map
            for key, node in {"exposure_us": "ExposureTime", "gain": "Gain"}.items():
                if hasattr(nodes, node):
                    values[f"{name}.{key}"] = float(getattr(nodes, node).value)
            values[f"{name}.bits"] = float(PIXEL_BITS[self._stated.pixel_format])
        return CameraSettings(values, tuple(self._warnings))

    def grab(self) -> StereoImage:
        """See `StereoCamera.grab`: triggers both cameras in immediate succession.

        Raises:
            DeviceFault: no picture, a picture of another size, or no pulse for the trigger line.
        """
        if self.wants_pulse and self._pulse is None:
            remedy = "use a positioner that offers one (driver serial), or leave out [cameras.options] trigger"
            raise fault("trigger", f"the cameras wait for {self._stated.trigger}, which is not driven", remedy)
        try:
            for acquirer in self._acquirers:
                _drain(acquirer)
            free = [not hasattr(acquirer.remote_device.node_map, "TriggerMode") for acquirer in self._acquirers]
            self._expose(free)
            left, right = (
                self._picture(name, acquirer, PIPELINE_FRAMES if free_running else 0)
                for name, acquirer, free_running in zip(CAMERAS, self._acquirers, free, strict=True)
            )
        except DeviceFault:
            raise
        except Exception as error:
            raise fault("no-frame", f"a camera delivers no frame: {_error_text(error)}", "check its cable") from error
        return StereoImage(left, right, 2 ** PIXEL_BITS[self._stated.pixel_format] - 1)

    def _expose(self, free: Sequence[bool]) -> None:
        """Trigger the cameras that do not run freely."""
        if self._pulse is not None:
            self._pulse()
            return
        for acquirer, free_running in zip(self._acquirers, free, strict=True):
            if not free_running:
                acquirer.remote_device.node_map.TriggerSoftware.execute()

    def _picture(self, name: str, acquirer: Any, skipped: int) -> np.ndarray:
        """The next picture after `skipped` others: (height, width, 3), uint8 or uint16, blue, green, red."""
        for _ in range(skipped):
            acquirer.fetch(timeout=FETCH_S).queue()
        with acquirer.fetch(timeout=FETCH_S) as buffer:
            component = buffer.payload.components[0]
            size = int(component.width), int(component.height)
            if size != self._size:
                found = f"{name}: pictures of {size[0]} x {size[1]} px"
                raise fault("image-size", found, f"{self._size[0]} x {self._size[1]} px were calibrated")
            # The memory returns to the producer with the buffer, so the data are copied.
            data = np.array(component.data)
        return _as_bgr(data, self._size, self._stated.pixel_format)

    def close(self) -> None:
        """See `StereoCamera.close`."""
        for release in [*(a.destroy for a in self._acquirers), self._harvester.reset]:
            try:
                release()
            except Exception:
                # A disconnected camera cannot be released.
                continue
        self._acquirers = []


def _as_bgr(data: np.ndarray, size: tuple[int, int], pixel_format: str) -> np.ndarray:
    """Pixels of a format as (height, width, 3), blue, green, red; values unchanged."""
    if pixel_format.startswith("Mono"):
        grey = data.reshape(size[1], size[0])
        return np.repeat(grey[..., None], 3, axis=2)
    colour = data.reshape(size[1], size[0], 3)
    return colour if pixel_format == "BGR8" else colour[..., ::-1].copy()


def _drain(acquirer: Any) -> None:
    """Drop pictures that were not fetched."""
    for _ in range(DRAIN_BUFFERS_MAX):
        buffer = acquirer.try_fetch(timeout=0.001)
        if buffer is None:
            return
        buffer.queue()


def _set(nodes: Any, name: str, value: object) -> bool:
    """Set a feature and read it back; returns whether the camera accepted it."""
    try:
        node = getattr(nodes, name)
        node.value = value
        reported = node.value
    except Exception:
        return False
    if isinstance(value, float) and isinstance(reported, (int, float)):
        return abs(reported - value) <= max(STEP_SHARE * abs(value), STEPS[name])
    return bool(reported == value)


def _text(device: Any, name: str) -> str:
    """An entry of the device list, "" if none: producers raise errors of any type."""
    try:
        return str(getattr(device, name) or "")
    except Exception:
        return ""


def _error_text(error: Exception) -> str:
    return f"{type(error).__name__}: {escaped(str(error), 200)}"
