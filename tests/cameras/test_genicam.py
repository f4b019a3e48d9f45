"""GenICam cameras: the virtual ones that `genicam` ships, and triggered ones of a fake with harvesters' interface."""

from __future__ import annotations

from contextlib import contextmanager
from dataclasses import replace
from importlib.util import find_spec
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from support.bench_runs import RIG_FILE

from tvsbayes.acquisition.driver_contract import camera_violations
from tvsbayes.acquisition.drivers import cameras_of, connect_trigger
from tvsbayes.acquisition.simulated_instrument import Instrument
from tvsbayes.cameras.genicam import GenicamCamera, GenicamSettings
from tvsbayes.errors import DeviceFault, InputError
from tvsbayes.instrument.rig import read_rig

WIDTH, HEIGHT = 12, 10
STATED = GenicamSettings("maker.cti", ("A1", "right eye"))


@pytest.fixture
def viky() -> Path:
    """The GenTL producer of `genicam`'s virtual cameras, which run freely and have no exposure."""
    pytest.importorskip("harvesters.core", reason="the extra genicam is not installed")
    spec = find_spec("genicam")
    place = Path(spec.origin).parent / "viky.cti"
    if not place.is_file():
        pytest.skip("this wheel of genicam ships no virtual camera")
    return place


def test_virtual_cameras_of_a_producer(viky, mounted_rig):
    """Producer, harvesters, device list, features and buffers as with real cameras."""
    stereo = replace(mounted_rig.stereo, image_width=400, image_height=400)
    table = {"driver": "genicam", "left": "0", "right": "2", "options.producer": str(viky)}
    rig = replace(mounted_rig, stereo=stereo, cameras=table)
    assert camera_violations(cameras_of(rig), 400, 400) == []
    camera = cameras_of(rig)
    assert all("runs freely" in warning for warning in camera.settings().warnings)
    assert camera.settings().values["left.bits"] == 8.0
    camera.close()
    refused = {"left": ("9", "0, 1, 2"), "exposure": (100.0, "ExposureTime"), "options.gain": (2.0, "Gain")}
    for key, (value, word) in refused.items():
        with pytest.raises(DeviceFault, match=word):
            cameras_of(replace(rig, cameras={**table, key: value}))
    with pytest.raises(InputError, match="GenTL producer"):
        cameras_of(replace(rig, cameras={**table, "options.producer": str(viky.with_name("no.cti"))}))


class Feature:
    """A feature that takes only some values."""

    def __init__(self, value, allowed=None):
        self._value, self.allowed = value, allowed

    @property
    def value(self):
        return self._value

    @value.setter
    def value(self, new):
        if self.allowed is not None and new not in self.allowed:
            raise ValueError(f"{new} is not allowed")
        self._value = new


class Kept(Feature):
    """A feature with a constant value."""

    value = property(lambda self: self._value, lambda self, new: None)


class Acquirer:
    """The part of `harvesters.core.ImageAcquirer` that is used, for a camera with a trigger."""

    def __init__(self, maker, kind=np.uint8):
        self.maker, self.kind, self.ready, self.exposures = maker, kind, [], 0
        self.started, self.destroyed = False, False
        nodes = {name: Feature("Continuous") for name in ("ExposureAuto", "GainAuto")}
        nodes |= {"PixelFormat": Feature("Mono8", ("Mono8", "Mono12", "RGB8")), "Width": Feature(WIDTH)}
        nodes |= {"Height": Feature(HEIGHT, (HEIGHT,)), "ExposureTime": Feature(1000.0), "Gain": Feature(0.0)}
        nodes |= {"TriggerSelector": Feature("FrameStart"), "TriggerMode": Feature("Off", ("Off", "On"))}
        nodes |= {"TriggerSource": Feature("Line0", ("Line0", "Software"))}
        nodes |= {"TriggerSoftware": SimpleNamespace(execute=self.expose)}
        self.nodes = SimpleNamespace(**nodes)
        self.remote_device = SimpleNamespace(node_map=self.nodes)

    def expose(self):
        self.exposures += 1
        self.ready.append(self.exposures)

    def start(self):
        self.started = self.nodes.TriggerMode.value == "On"

    def try_fetch(self, timeout):
        return SimpleNamespace(queue=lambda: self.ready.pop(0)) if self.ready else None

    @contextmanager
    def fetch(self, timeout):
        if not self.ready:
            raise TimeoutError("no buffer")
        number = self.ready.pop(0)
        depth = {"Mono8": (np.uint8, 1), "Mono12": (np.uint16, 1), "RGB8": (np.uint8, 3)}
        kind, channels = depth[self.nodes.PixelFormat.value]
        data = np.arange(WIDTH * HEIGHT * channels) % 200 + number
        part = SimpleNamespace(width=WIDTH, height=self.maker.height, data=data.astype(kind))
        yield SimpleNamespace(payload=SimpleNamespace(components=[part]))

    def destroy(self):
        self.destroyed = True


class Maker:
    """The part of `harvesters.core.Harvester` that is used."""

    def __init__(self, height=HEIGHT):
        self.height, self.files, self.reset_done = height, [], False
        self.device_info_list = [
            SimpleNamespace(serial_number="A1", user_defined_name=None),
            SimpleNamespace(serial_number="A2", user_defined_name="right eye"),
        ]
        self.acquirers = [Acquirer(self), Acquirer(self)]

    def add_file(self, name):
        self.files.append(name)

    def update(self):
        pass

    def create(self, number):
        return self.acquirers[number]

    def reset(self):
        self.reset_done = True


def opened(maker: Maker, **changes) -> GenicamCamera:
    return GenicamCamera(maker, replace(STATED, **changes), WIDTH, HEIGHT)


def test_pictures_are_triggered_after_the_request():
    maker = Maker()
    camera = opened(maker, exposure_us=4000.0, gain=3.0)
    nodes = maker.acquirers[1].nodes
    assert maker.files == ["maker.cti"] and all(a.started for a in maker.acquirers)
    assert (nodes.TriggerSource.value, nodes.ExposureAuto.value, nodes.Gain.value) == ("Software", "Off", 3.0)
    assert camera.settings().values["right.exposure_us"] == 4000.0 and camera.settings().warnings == ()
    for acquirer in maker.acquirers:
        # A picture left in the buffer, as after a fault: it is older than the next request.
        acquirer.expose()
    image = camera.grab()
    assert image.left[0, 0].tolist() == image.right[0, 0].tolist() == [2, 2, 2]
    assert image.left.shape == (HEIGHT, WIDTH, 3) and image.left.dtype == np.uint8
    camera.close()
    assert maker.reset_done and all(a.destroyed for a in maker.acquirers)


def test_colour_has_the_channel_order_of_opencv():
    picture = opened(Maker(), pixel_format="RGB8").grab().left
    assert picture[0, 0].tolist() == [3, 2, 1]


def test_a_line_is_pulsed_by_the_positioner(mounted_rig):
    maker, instrument = Maker(), Instrument(mounted_rig, 1)
    camera, positioner = opened(maker, trigger="Line0"), instrument.positioner()
    with pytest.raises(DeviceFault, match="which is not driven"):
        camera.grab()
    connect_trigger(positioner, camera)
    with pytest.raises(DeviceFault, match="no frame"):
        camera.grab()
    assert instrument.mechanics.trigger_on, "the line is high, and these cameras do not depend on it"

    def pulse():
        for acquirer in maker.acquirers:
            acquirer.expose()

    camera.use_trigger(pulse)
    assert camera.grab().left[0, 0, 0] == 1
    with pytest.raises(InputError, match="no trigger line"):
        connect_trigger(SimpleNamespace(), camera)


@pytest.mark.parametrize(
    ("changes", "height", "code", "word"),
    [
        ({"cameras": ("A1", "A3")}, HEIGHT, "camera", "right: 0 cameras are A3; there are: A1, A2"),
        ({"pixel_format": "Mono16"}, HEIGHT, "camera-setting", "PixelFormat = Mono16"),
        ({"trigger": "Line7"}, HEIGHT, "camera-setting", "TriggerSource = Line7"),
        ({}, HEIGHT + 1, "image-size", "12 x 11 px"),
    ],
)
def test_cameras_that_ignore_settings_are_named(changes, height, code, word):
    maker = Maker(height)
    with pytest.raises(DeviceFault, match=word) as caught:
        opened(maker, **changes).grab()
    assert caught.value.code == code and caught.value.remedy


@pytest.mark.parametrize(("kept", "taken"), [(0.0, False), (0.6, False), (0.95, True), (1.04, True)])
def test_a_gain_that_the_camera_does_not_take_is_named(kept, taken):
    """1 dB is 12 % of the grey levels."""
    maker = Maker()
    for acquirer in maker.acquirers:
        acquirer.nodes.Gain = Kept(kept)
    if taken:
        assert opened(maker, gain=1.0).settings().values["left.gain"] == kept
    else:
        with pytest.raises(DeviceFault, match=r"left: Gain = 1\.0 was not taken"):
            opened(maker, gain=1.0)


@pytest.mark.parametrize(
    ("change", "column"),
    [
        ({"options.producer": None}, "cameras.options.producer"),
        ({"left": None}, "cameras.left"),
        ({"options.pixel_format": "YUV422"}, "cameras.options.pixel_format"),
        ({"options.fps": 30}, "cameras.options.fps"),
    ],
)
def test_entries_that_do_not_fit_are_refused(change, column):
    table = {"left": "A1", "right": "A2", "options.producer": "maker.cti", **change}
    with pytest.raises(InputError) as caught:
        GenicamSettings.of({key: value for key, value in table.items() if value is not None})
    assert caught.value.column == column


def test_without_harvesters_the_extra_is_named(monkeypatch):
    monkeypatch.setitem(__import__("sys").modules, "harvesters.core", None)
    table = {"driver": "genicam", "left": "A1", "right": "A2", "options.producer": "maker.cti"}
    with pytest.raises(InputError, match=r"tvsbayes\[genicam\]"):
        cameras_of(replace(read_rig(RIG_FILE), cameras=table))
