"""The page of a run in headless Chromium: what it shows, to whom, faults, a browser that is killed."""

from __future__ import annotations

import os
import signal
import threading
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from urllib.parse import urlsplit

import numpy as np
import pytest

pytest.importorskip("tornado", reason="the extra live is not installed")
pytest.importorskip("selenium", reason="selenium is not installed")
from support.bench_runs import Run
from support.browsers import CHROMIUM, DRIVER, SECONDS_MAX, Browsed, browser, foreign_page

from tvsbayes.acquisition.journal import read_journal
from tvsbayes.acquisition.journal_check import verify
from tvsbayes.acquisition.live_run import LiveRun
from tvsbayes.acquisition.observation import Observation
from tvsbayes.acquisition.recorder import recorded
from tvsbayes.acquisition.running_estimate import Estimate, RunningEstimate
from tvsbayes.acquisition.simulated_bench import TwinObserver
from tvsbayes.errors import DeviceFault
from tvsbayes.files.images import png_bytes
from tvsbayes.instrument.campaign import frame_name, read_campaign
from tvsbayes.view.live_server import LivePage

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(not (CHROMIUM and DRIVER), reason="needs `apt install chromium chromium-driver`"),
    # Selenium's own sockets to its driver.
    pytest.mark.filterwarnings("ignore::ResourceWarning"),
    pytest.mark.usefixtures("ctrl_c_works"),
]


class Gated(TwinObserver):
    """Looks with pictures, each taken when the test lets it: once `look(n)` is called, look n is waited for."""

    def __init__(self, instrument, gate: Gate):
        super().__init__(instrument, 0.08)
        self.gate = gate

    def observe(self, positioner, spot):
        positioner.laser(True)
        self.gate.reached(spot)
        observation = super().observe(positioner, spot)
        u_left, v_left, u_right, v_right = observation.spot.pixels_px
        pictures = {}
        for camera, (u, v) in (("left", (u_left, v_left)), ("right", (u_right, v_right))):
            image = np.full((720, 1280), 20, np.uint8)
            image[round(v) - 2 : round(v) + 3, round(u) - 2 : round(u) + 3] = 240
            pictures[frame_name(spot, camera)] = png_bytes(image)
        return Observation(observation.spot, pictures)


class Gate:
    """Where a run waits for the test, with the laser on, before look `at`; then it does what the test requests."""

    def __init__(self):
        self.at = 3
        self.there, self.go = threading.Event(), threading.Event()
        self.action: Callable[[], None] = lambda: None

    def reached(self, spot: int) -> None:
        if spot == self.at:
            self.at = -1
            self.there.set()
            assert self.go.wait(SECONDS_MAX)
            self.action()


class Fitted(RunningEstimate):
    """Estimates without fits: of a run that calms down."""

    def update(self, looks: int) -> bool:
        values = {"left": 0.06 + 1e-4 / looks, "right": 0.0601}
        self.latest = Estimate(looks, values, dict.fromkeys(values, 1e-3 / looks**0.5))
        return False


@dataclass
class Going:
    """A run that goes on in a thread, and its page."""

    run: Run
    live: LiveRun
    gate: Gate
    link: str
    page: LivePage
    thread: threading.Thread
    ended: list

    def finish(self) -> object:
        """Let it go on to its end: its outcome or its error."""
        self.gate.go.set()
        self.thread.join(SECONDS_MAX)
        assert not self.thread.is_alive() and self.run.dark()
        return self.ended[0]


@pytest.fixture
def going(mounted_rig, tmp_path) -> Iterator[Going]:
    live, gate, ended = LiveRun(), Gate(), []
    estimate = Fitted(tmp_path, ("none",), 1e-4, {"left", "right"})
    run = Run(mounted_rig, tmp_path / "c", observer=lambda i: Gated(i, gate), live=live, estimate=estimate)

    def work():
        try:
            ended.append(run.engine.run())
        except BaseException as error:
            ended.append(error)
        finally:
            gate.there.set()

    thread = threading.Thread(target=work)
    with estimate, LivePage(live, 0) as page:
        thread.start()
        assert gate.there.wait(SECONDS_MAX) and not ended, ended
        going = Going(run, live, gate, page.link, page, thread, ended)
        try:
            yield going
        finally:
            run.stop.requested = True
            gate.go.set()
            thread.join(SECONDS_MAX)


@pytest.fixture(scope="module")
def browsed(tmp_path_factory) -> Iterator[Browsed]:
    with browser(tmp_path_factory.mktemp("saved")) as opened:
        yield opened


@pytest.fixture(autouse=True)
def quiet(browsed) -> Iterator[None]:
    """No page may ask anybody but its own server."""
    browsed.complaints(), browsed.requested_hosts()
    yield
    browsed.complaints()


def text(browsed: Browsed, name: str) -> str:
    return browsed.js("return document.getElementById(arguments[0]).textContent", name)


def wait_for(browsed: Browsed, name: str, part: str) -> None:
    browsed.until(f"document.getElementById('{name}').textContent.includes({part!r})")


def test_page_shows_the_run_and_requests_no_other_host(going, browsed):
    assert browsed.opened(going.link) == "running"
    assert text(browsed, "name") == "test" and "simulated" in text(browsed, "notes")
    assert "3 of 8" in text(browsed, "facts")
    assert "min by [costs]" in text(browsed, "facts")
    browsed.until("document.querySelectorAll('.camera image').length === 4")
    assert browsed.js("return document.querySelectorAll('#left .trail').length") == 3
    centre = browsed.js("return Number(document.querySelector('#right .whole .centre').getAttribute('cx'))")
    assert centre == pytest.approx(going.live.latest.look.pixels_px[2])
    wait_for(browsed, "estimate-remark", "of 3 looks; wanted: u at most 0.00010 in left, right")
    assert "Temperature 0." in text(browsed, "estimate-remark") and "times the target" in text(browsed, "estimates")
    browsed.until("document.querySelectorAll('#history path[data-name=estimates]').length === 2")
    assert browsed.complaints() == [] and browsed.requested_hosts() == {urlsplit(going.link).netloc}


def test_only_the_link_opens_the_page(going, browsed):
    assert browsed.opened(going.link) == "running"
    browsed.driver.refresh()
    browsed.until("document.body?.dataset.state === 'running'")
    for wrong in (going.link + "x", going.link.partition("#")[0] + "#"):
        browsed.js("sessionStorage.clear()")
        assert browsed.opened(wrong) == "refused" and "403" in text(browsed, "notes")
    assert going.finish().ok == 8


def test_another_origin_reads_nothing(going, browsed):
    """Neither with a plain request nor by a name that leads here."""
    tried = """
      const [own, done] = [arguments[0], arguments[1]];
      const asks = (how) => fetch(own + "live", how).then((got) => got.type, () => "refused");
      Promise.all([asks({}), asks({headers: {"X-Tvsbayes-Token": "x"}})]).then(done);
    """
    with foreign_page() as foreign:
        assert browsed.opened(foreign) == "foreign"
        browsed.driver.set_script_timeout(SECONDS_MAX)
        address = going.link.partition("#")[0]
        assert browsed.driver.execute_async_script(tried, address) == ["refused"] * 2
        browsed.driver.get(address.replace("127.0.0.1", "localhost."))
        assert "403" in browsed.driver.page_source
    assert browsed.opened(going.link) == "running"


def test_browser_that_is_killed_changes_nothing(going, tmp_path_factory, tmp_path):
    """The run ends as it would have."""
    with browser(tmp_path_factory.mktemp("saved")) as doomed:
        assert doomed.opened(going.link) == "running"
        os.kill(doomed.driver.capabilities["goog:processID"], signal.SIGKILL)
    outcome = going.finish()
    assert (outcome.reason, outcome.ok) == ("done", 8)
    assert verify(tmp_path / "c").stopped == "done" and len(read_campaign(tmp_path / "c").spots) == 8


def test_page_says_when_its_server_is_gone(going, browsed):
    assert browsed.opened(going.link) == "running"
    going.page.end()
    browsed.until("document.body.dataset.state === 'gone'")
    assert "Ctrl-C" in text(browsed, "notes")
    assert going.finish().ok == 8


def camera_dies(going: Going) -> None:
    raise DeviceFault("no-frame", "the left camera delivers no picture", remedy="plug it in, then go on with --resume")


def device_reboots(going: Going) -> None:
    going.run.instrument.device.power_on()


def disk_is_full(going: Going) -> None:
    def full(descriptor, data):
        raise OSError(28, "No space left on device")

    going.run.engine.journal._disk.write = full


@pytest.mark.parametrize(
    ("fault", "words"),
    [(camera_dies, "delivers no picture"), (device_reboots, "was reset"), (disk_is_full, "No space left")],
)
def test_faults_are_shown_in_words_and_lose_nothing(going, browsed, tmp_path, fault, words):
    assert browsed.opened(going.link) == "running"
    going.gate.action = lambda: fault(going)
    assert isinstance(going.finish(), DeviceFault)
    browsed.until("document.body.dataset.state === 'ended'")
    assert (
        browsed.one("fault").is_displayed() and words in text(browsed, "fault") and "--resume" in text(browsed, "fault")
    )
    assert not going.run.instrument.mechanics.laser_on
    held = recorded(read_journal(tmp_path / "c").records)
    assert [spot.spot for spot in held.spots] == [0, 1, 2] and len(read_campaign(tmp_path / "c").spots) == 3


@pytest.mark.parametrize("scheme", ["light", "dark"])
@pytest.mark.parametrize("width", [390, 1280])
def test_nothing_is_cut_off(going, browsed, scheme, width):
    """On a telephone and a screen, by day and by night: no sideways scrolling, and text that stands out."""
    with browsed.shown(width, scheme):
        assert browsed.opened(going.link) == "running"
        browsed.until("document.querySelectorAll('#history path[data-name=estimates]').length === 2")
        assert browsed.js("return document.documentElement.scrollWidth") <= width
        ink, ground = browsed.brightness("figure")
        assert (ground > 600 > ink + 150) if scheme == "light" else (ink > 350 > ground + 150)
