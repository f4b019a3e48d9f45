"""One look: no old picture, no strange light and no lying camera becomes a spot."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from tvsbayes.acquisition.engine import ATTEMPTS_PER_LOOK
from tvsbayes.acquisition.observation import CameraObserver, DetectedSpot, live_detector, rises_dn
from tvsbayes.acquisition.simulated_bench import SimulatedCamera
from tvsbayes.acquisition.simulated_instrument import Instrument
from tvsbayes.cameras.capture import StereoImage
from tvsbayes.errors import DeviceFault


@pytest.fixture
def homed(mounted_rig):
    """A simulated instrument and its positioner after homing."""
    instrument = Instrument(mounted_rig, 1)
    positioner = instrument.positioner()
    positioner.home()
    return instrument, positioner


class Scripted:
    """A camera whose n-th pair is `level(n)` grey all over, after `seconds` of exposure."""

    def __init__(self, clock, level, seconds=0.1):
        self.clock, self.level, self.seconds, self.count = clock, level, seconds, 0

    def grab(self):
        self.clock.sleep(self.seconds)
        self.count += 1
        picture = np.full((4, 4, 3), self.level(self.count), np.uint8)
        return StereoImage(picture, picture)


def test_pictures_that_are_no_pair_are_refused(small_rig):
    dark = np.zeros((small_rig.stereo.image_height, small_rig.stereo.image_width, 3), np.uint8)
    light = Instrument(small_rig, 7)
    light.place("d1", 0)
    light.mechanics.laser_on = True
    pair = SimulatedCamera(light).grab()
    detector = live_detector(small_rig.stereo)
    assert detector(pair, pair).status == "ok"
    assert detector(StereoImage(dark, dark), pair).status == "no-spot both"
    assert detector(StereoImage(pair.left, dark), pair).status == "no-spot right"
    lifted = np.roll(pair.right, 20, axis=0)
    assert detector(StereoImage(pair.left, lifted), pair).status == "epipolar"
    # The same light in 12 bits, a quarter of it on the right: one scale for both, though the right one's peak fits 10.
    dim = StereoImage(pair.left, pair.right // 4)
    deep = StereoImage(*(picture.astype(np.uint16) * 16 for picture in (dim.left, dim.right)))
    shallow, spot = detector(dim, pair), detector(deep, deep)
    # 4080 of 4095 are 254 of 255 grey levels: a pixel at the edge of the spot may count in one of them.
    assert spot.status == shallow.status == "ok" and spot.sds_px == pytest.approx(shallow.sds_px, rel=0.05)
    assert detector(replace(deep, white=65535), deep).status == "no-spot both"


@pytest.mark.parametrize(
    ("level", "seconds", "code"),
    [
        (lambda n: 7, 0.1, "frozen"),
        (lambda n: n % 30, 2.5, "watchdog"),
        (lambda n: 0 if n == 1 else 100, 0.1, "light"),
    ],
)
def test_camera_that_lies_is_a_fault_and_the_laser_is_off(homed, level, seconds, code):
    instrument, positioner = homed
    with pytest.raises(DeviceFault) as caught:
        CameraObserver(Scripted(instrument.clock, level, seconds)).observe(positioner, 0)
    assert caught.value.code == code and not instrument.mechanics.laser_on


def test_pictures_without_a_visible_spot_wait_for_detection(homed):
    instrument, positioner = homed
    camera = Scripted(instrument.clock, lambda n: n % 30)
    observation = CameraObserver(camera).observe(positioner, 3)
    assert observation.spot.status == "undetected" and camera.count == 22
    assert sorted(observation.pictures)[0] == "dark/000003_left.png" and len(observation.pictures) == 4


class AlwaysLit:
    """Cameras of a twin whose laser never goes off, whatever the device reports."""

    def __init__(self, instrument):
        self.instrument, self.camera = instrument, SimulatedCamera(instrument)

    def grab(self):
        on, self.instrument.mechanics.laser_on = self.instrument.mechanics.laser_on, True
        pair = self.camera.grab()
        self.instrument.mechanics.laser_on = on
        return pair


def test_a_spot_that_is_there_without_the_laser_is_a_fault(small_rig):
    instrument = Instrument(small_rig, 7)
    instrument.place("d1", 0)
    positioner = instrument.positioner()
    positioner.home()
    positioner.move_to(0, 0)
    observer = CameraObserver(AlwaysLit(instrument), live_detector(small_rig.stereo))
    with pytest.raises(DeviceFault, match="off, too") as caught:
        observer.observe(positioner, 0)
    assert caught.value.code == "light" and not instrument.mechanics.laser_on


@pytest.mark.parametrize("depth", range(0, 12))
def test_old_frames_never_become_a_spot_whatever_the_buffer(homed, depth):
    """A camera without any flushing, with a buffer `depth` frames deep: light alone identifies new frames."""
    instrument, positioner = homed
    rng = np.random.default_rng(depth)
    queue, moved_to = [], [0]

    def expose():
        picture = rng.integers(0, 6, (3, 40, 3)).astype(np.uint8)
        if instrument.mechanics.laser_on:
            picture[1, moved_to[0]] = 200
        queue.append(picture)

    class Camera:
        def grab(self):
            expose()
            while len(queue) <= depth:
                expose()
            picture = queue.pop(0)
            return StereoImage(picture, picture)

    def detector(lit, dark):
        light = lit.left[1].astype(int).sum(axis=1) - dark.left[1].astype(int).sum(axis=1)
        u = float(light.argmax())
        return DetectedSpot("ok", (u,) * 4, (0.1,) * 4) if light.max() > 300 else DetectedSpot("no-spot")

    observer, columns = CameraObserver(Camera(), detector, keep_pictures=False), []
    for step in range(12):
        positioner.move_to(3 * step, 0)
        # The spot is where the positioner is.
        moved_to[0] = 3 * step
        for _ in range(ATTEMPTS_PER_LOOK):
            spot = observer.observe(positioner, step).spot
            if spot.status == "ok":
                columns.append(spot.pixels_px[0])
                assert spot.pixels_px[0] == 3 * step
                break
    assert columns == [3.0 * step for step in range(12)]


@pytest.mark.parametrize("known", [None, 4095])
def test_noise_of_twelve_bits_is_no_light(homed, known):
    """Dark pictures below 256 counts do not show the bit depth: the driver or the first light does."""
    instrument, positioner = homed
    rng, stated = np.random.default_rng(1), [] if known is None else [known]

    class Camera:
        def grab(self):
            # 100 counts of 4095 are 6 grey levels.
            pair = rng.integers(90, 190, (2, 4, 4, 3)).astype(np.uint16)
            if instrument.mechanics.laser_on:
                pair[:, 1, 1] = 3000
            return StereoImage(*pair, *stated)

    observer, pairs = CameraObserver(Camera(), keep_pictures=False), []
    observer.detector = lambda lit, dark: pairs.append((lit.white, rises_dn(dark, lit))) or DetectedSpot("no-spot")
    for look in range(3):
        assert observer.observe(positioner, look).spot.status == "no-spot"
    # 3000 less 90 to 190 counts, in 255 of 4095.
    assert all(white == 4095 and 174 <= min(rises) <= max(rises) <= 181 for white, rises in pairs) and len(pairs) == 3
