"""The page in headless Chromium: every control, the linked selection, what is saved, and who is kept out."""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import fields, replace
from pathlib import Path
from urllib.parse import urlsplit

import numpy as np
import pytest
from support.viewed_twin import PICTURED, UNDETECTED

pytest.importorskip("tornado", reason="the extra view is not installed")
pytest.importorskip("plotly", reason="the extra view is not installed")
pytest.importorskip("selenium", reason="selenium is not installed")
from selenium import webdriver
from selenium.webdriver.common.by import By
from selenium.webdriver.support.ui import Select, WebDriverWait
from support.browsers import CHROMIUM, DRIVER, SECONDS_MAX, Browsed, browser, foreign_page
from support.served_pages import page_served

from tvsbayes.instrument.campaign import read_campaign, with_pixels
from tvsbayes.view.contents import Contents, page_files
from tvsbayes.view.document import document
from tvsbayes.view.gathering import look_at
from tvsbayes.view.scene import LookColumns, Looked, scene

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(not (CHROMIUM and DRIVER), reason="needs `apt install chromium chromium-driver`"),
    # Selenium's own sockets to its driver.
    pytest.mark.filterwarnings("ignore::ResourceWarning"),
]
MANY = 50_000
CLICK = (
    "const [plot, places] = arguments; document.getElementById(plot).emit('plotly_click',"
    " {points: places.map((place) => ({customdata: place}))})"
)
FRAME = "const [plot, range] = arguments; document.getElementById(plot).emit('plotly_selected', {range})"
LASSO = "const [plot, lassoPoints] = arguments; document.getElementById(plot).emit('plotly_selected', {lassoPoints})"
"""What Plotly tells the page when points are clicked or framed."""
PLOTS = ("rig", "pictures", "residuals", "stops", "correlation", "changes")


@pytest.fixture(scope="module")
def browsed(tmp_path_factory) -> Iterator[Browsed]:
    with browser(tmp_path_factory.mktemp("saved")) as opened:
        yield opened


def contents_of(looked: Looked, *folders: Path) -> Contents:
    kept = tuple(frozenset(one.looks.spot.tolist()) for one in looked.scenes)
    return Contents(document(looked), folders, kept, page_files())


@pytest.fixture(scope="module")
def both(viewed) -> Contents:
    """The campaign beside itself, the last of its looks suspect."""
    looked = look_at(viewed.folder, viewed.folder)
    first = looked.scenes[0]
    suspect = first.looks.suspect.copy()
    suspect[-1] = True
    doubted = replace(first, looks=replace(first.looks, suspect=suspect))
    return contents_of(replace(looked, scenes=(doubted, looked.scenes[1])), viewed.folder, viewed.folder)


@pytest.fixture
def page(both, browsed) -> Iterator[Browsed]:
    browsed.complaints(), browsed.asked()
    with page_served(both) as link:
        assert browsed.opened(link) == "ready"
        yield browsed
        assert browsed.complaints() == []
        assert browsed.asked() <= {urlsplit(link).netloc}


def test_page_shows_everything_and_sends_nothing(page):
    assert page.one("name").text == "paper twin beside paper twin"
    for plot in PLOTS:
        assert page.js("return document.getElementById(arguments[0]).querySelectorAll('.main-svg').length", plot) > 0
    assert [trace["count"] for trace in page.traces("rig", "spots")] == [383, 383]
    assert len(page.traces("rig", "sheets")) == 4 and len(page.traces("residuals", "looks")) == 4
    assert page.one("verdict").text == "no significant change"
    assert page.one("parameters-figure").text.startswith("Parameters of the first, paper twin")
    rows = page.driver.find_elements(By.CSS_SELECTOR, "#changes-table tbody tr")
    assert len(rows) == 6
    titles = page.js("return [...document.querySelectorAll('.modebar-btn')].map((b) => b.dataset.title ?? '')")
    assert titles and not [title for title in titles if "cloud" in title.lower() or "plotly" in title.lower()]


def test_every_switch_of_the_rig(page):
    for name in ("spots", "ellipsoids", "beams", "mirrors", "cameras", "sheets"):
        seen = page.traces("rig", name)
        assert seen and all(trace["visible"] is True for trace in seen)
        page.click(f"show-{name}")
        page.until(f"document.getElementById('rig').data.filter((t) => t.name === '{name}').every((t) => !t.visible)")
        page.click(f"show-{name}")
        page.until(f"document.getElementById('rig').data.filter((t) => t.name === '{name}').every((t) => t.visible)")
    eyes = []
    for view in ("from-above", "from-side", "from-behind"):
        page.click(view)
        eyes.append(page.js("return document.getElementById('rig').layout.scene.camera.eye"))
    assert len({json.dumps(eye) for eye in eyes}) == 3
    before = page.traces("rig", "ellipsoids")[0]["first"]
    Select(page.one("ellipsoid-scale")).select_by_visible_text("100")
    page.until(f"document.getElementById('rig').data.find((t) => t.name === 'ellipsoids').x[1] !== {before[1]}")


def test_looks_are_walked_by_number(page):
    def look() -> str:
        return page.one("look").get_property("value")

    first = look()
    page.click("next")
    page.until(f"document.getElementById('look').value !== '{first}'")
    page.click("previous")
    page.until(f"document.getElementById('look').value === '{first}'")
    page.click("unlikely")
    page.until("document.getElementById('facts').textContent.includes('the fit doubts it')")
    page.js("const i = document.getElementById('look'); i.value = '99999'; i.dispatchEvent(new Event('change'))")
    assert "there is no look 99999" in page.one("chosen").text
    asked = "const i = document.getElementById('look'); i.value = arguments[0]; i.dispatchEvent(new Event('change'))"
    page.js(asked, str(UNDETECTED))
    page.until("document.getElementById('facts').textContent.includes('undetected')")
    assert "No picture of this look is kept (left, right)" in page.one("pictures-remark").text
    Select(page.one("campaign")).select_by_value("1")
    page.until("document.getElementById('chosen').textContent === ''")
    page.click("none")
    page.until("document.body.dataset.chosen === '0'")
    assert page.marks("stops") == page.marks("residuals") == [0, 0]


def test_picture_of_a_look_with_what_was_found(page):
    asked = "const i = document.getElementById('look'); i.value = arguments[0]; i.dispatchEvent(new Event('change'))"
    page.js(asked, str(PICTURED))
    page.until("document.getElementById('pictures').layout.images.length === 1")
    page.until("document.querySelectorAll('#pictures image').length === 1")
    # Pixels stay square: an axis may reach further than asked.
    reach = "((r) => r[1] - r[0])(document.getElementById('pictures').layout.xaxis.range)"
    assert 50 <= page.js(f"return {reach}") < 100
    page.click("window-all")
    page.until(f"{reach} >= 1280")
    page.click("window-spot")
    page.until(f"{reach} < 100")
    assert "(right)" in page.one("pictures-remark").text


def test_what_is_framed_in_one_plot_is_selected_in_all(page):
    page.js(CLICK, "rig", [4, 5, 390])
    page.until("document.body.dataset.chosen === '3'")
    assert page.traces("rig", "chosen")[0]["count"] == 3
    assert page.marks("stops") == page.marks("residuals") == [3, 3]
    assert page.one("chosen").text == "3 looks are selected"
    page.js(FRAME, "residuals", {"x2": [0, 1280], "y2": [720, 0]})
    seen = 2 * 383
    page.until(f"document.body.dataset.chosen === '{seen}'")
    assert page.marks("stops") == [seen, seen]
    # A triangle around the looks at the counter 200, whatever their deviation.
    page.js(LASSO, "stops", {"x": [190, 210, 200], "y": [-50, -50, 50]})
    page.until(f"document.body.dataset.chosen !== '{seen}'")
    assert 0 < page.chosen() < seen and page.marks("residuals") == [page.chosen()] * 2
    page.js(CLICK, "stops", [9])
    page.until("document.body.dataset.chosen === '1'")
    assert page.marks("residuals") == [1, 1]
    page.js(FRAME, "stops", {"x": [1e6, 2e6], "y": [0, 1]})
    assert page.chosen() == 1


def test_a_frame_drawn_by_hand_selects(page):
    page.js("document.getElementById('stops').scrollIntoView({block: 'center'})")
    box = page.driver.find_element(By.CSS_SELECTOR, "#stops .nsewdrag")
    mouse = webdriver.ActionChains(page.driver)
    width, height = box.size["width"], box.size["height"]
    mouse.move_to_element_with_offset(box, -width // 2 + 5, -height // 2 + 5).click_and_hold()
    mouse.move_by_offset(width // 2, height // 2).move_by_offset(width // 2 - 12, height // 2 - 12).release().perform()
    page.until("Number(document.body.dataset.chosen) > 100")
    assert page.marks("stops") == [page.chosen()] * 2


def test_arrows_bars_and_bands(page):
    def first() -> float:
        return page.traces("residuals", "arrows")[0]["first"][1]

    before = first()
    Select(page.one("residual-scale")).select_by_visible_text("1000")
    page.until(f"document.getElementById('residuals').data.find((t) => t.name === 'arrows').x[1] !== {before}")
    for switch, name in (("show-gears", "gears"), ("show-u", "u")):
        assert page.traces("stops", name)
        page.click(switch)
        page.until(f"document.getElementById('stops').data.filter((t) => t.name === '{name}').every((t) => !t.visible)")
        page.click(switch)


def test_parameters_and_correlations_are_linked(page):
    rows = page.driver.find_elements(By.CSS_SELECTOR, "#parameters tbody tr")
    page.one("filter").send_keys("backlash_deg.pan")
    page.until("document.querySelectorAll('#parameters tbody tr:not([hidden])').length === 1")
    page.driver.find_element(By.CSS_SELECTOR, "#parameters tbody tr:not([hidden])").click()
    page.until(
        "document.getElementById('correlation-remark').textContent.startsWith('backlash_deg.pan goes most with')"
    )
    assert len(page.js("return document.getElementById('correlation').layout.shapes")) == 2
    page.one("filter").clear()
    page.one("filter").send_keys("d")
    event = (
        "document.getElementById('correlation').emit('plotly_click', {points: [{x: arguments[0], y: arguments[1]}]})"
    )
    page.js(event, "tilt_zero_deg", "mirror_offset_mm")
    page.until("document.querySelectorAll('#parameters tr.marked').length === 2")
    assert len(rows) > 50


@pytest.mark.parametrize("plot", PLOTS)
def test_plots_are_saved_as_they_are_seen(page, plot):
    begins = {"png": b"\x89PNG\r\n\x1a\n", "svg": b"<svg"}
    for kind, start in begins.items():
        page.click(f"save-{plot}-{kind}")
        place = Path(page.driver.saved) / f"paper-twin-{plot}.{kind}"
        WebDriverWait(page.driver, SECONDS_MAX).until(lambda _, place=place: place.exists() and place.stat().st_size)
        content = place.read_bytes()
        assert content.startswith(start) and len(content) > 2000


def test_reload_goes_on_and_a_second_browser_is_refused(both, browsed):
    with page_served(both) as link:
        assert browsed.opened(link) == "ready"
        assert browsed.js("return location.hash") == ""
        browsed.driver.refresh()
        assert browsed.until("document.body?.dataset.state") == "ready"
        browsed.driver.switch_to.new_window("tab")
        for wrong in (link, link + "x", link.partition("#")[0]):
            assert browsed.opened(wrong) == "refused"
            assert "403" in browsed.one("notes").text
            assert browsed.js("return document.querySelectorAll('.main-svg').length") == 0
        browsed.driver.close()
        browsed.driver.switch_to.window(browsed.driver.window_handles[0])
    browsed.complaints()


def test_another_origin_reaches_nothing(both, browsed):
    """Neither by reading, nor blindly, nor as a picture, a script or a frame."""
    tried = """
      const [own, done] = [arguments[0], arguments[1]];
      const loads = (kind, path) => new Promise((tell) => {
        const made = document.createElement(kind);
        made.onload = () => tell(kind === "iframe" ? "frame" : "loaded");
        made.onerror = () => tell("refused");
        made.src = own + path;
        document.body.append(made);
      });
      const asks = (path, how) => fetch(own + path, how).then((got) => got.type, () => "refused");
      Promise.all([
        asks("scene", {}), asks("scene", {headers: {"X-Tvsbayes-Key": "x"}}), asks("key", {method: "POST", body: "{}"}),
        loads("img", "picture/0/3/left"), loads("script", "page.js"), loads("script", "scene"),
      ]).then(done);
    """
    with page_served(both) as link, foreign_page() as foreign:
        assert browsed.opened(foreign) == "foreign"
        browsed.driver.set_script_timeout(SECONDS_MAX)
        own = link.partition("#")[0]
        assert browsed.driver.execute_async_script(tried, own) == ["refused"] * 6
        # A name of somebody else's that leads here, as by DNS rebinding: localhost. with its dot is such a name.
        browsed.driver.get(own.replace("127.0.0.1", "localhost."))
        assert "403" in browsed.driver.page_source and "tvsbayes view" not in browsed.driver.page_source
        # The link is still good for its own browser.
        assert browsed.opened(link) == "ready"
    browsed.complaints()


def test_folder_without_results_and_one_without_spots(viewed, browsed):
    """The stated rig without residuals; then cameras alone."""
    campaign = read_campaign(viewed.bare)
    blind = replace(campaign, spots=tuple(with_pixels(spot, "undetected") for spot in campaign.spots))
    browsed.complaints()
    for looked, seen in ((look_at(viewed.bare), 383), (Looked((scene(blind),)), 0)):
        with page_served(contents_of(looked, viewed.bare)) as link:
            assert browsed.opened(link) == "ready"
            assert browsed.traces("rig", "spots")[0]["count"] == seen
            assert len(browsed.traces("rig", "cameras")) == 1
            assert browsed.one("residuals-remark").text.startswith("No residuals without a fit")
            assert not browsed.one("correlation-figure").is_displayed()
            assert not browsed.one("changes-figure").is_displayed()
            browsed.click("next")
            browsed.until("document.getElementById('look').value === '1'")
            browsed.click("unlikely")
            browsed.until("document.getElementById('chosen').textContent === 'the fit doubts no look'")
            browsed.driver.find_element(By.CSS_SELECTOR, "#parameters tbody tr").click()
    assert browsed.complaints() == []


def many(looks: LookColumns, count: int) -> LookColumns:
    """The same looks again and again, each a little aside."""
    rows = np.arange(count) % len(looks.spot)
    generator = np.random.default_rng(4)
    values = {field.name: getattr(looks, field.name) for field in fields(looks)}
    again = {
        name: value[rows] if isinstance(value, np.ndarray) else tuple(value[row] for row in rows)
        for name, value in values.items()
    }
    again["spot"] = np.arange(count)
    again["point_mm"] = again["point_mm"] + generator.normal(0.0, 3.0, (count, 3))
    again["pixels_px"] = again["pixels_px"] + generator.normal(0.0, 30.0, (count, 4))
    return LookColumns(**again)


def test_fifty_thousand_looks(viewed, browsed):
    one = look_at(viewed.folder).scenes[0]
    contents = contents_of(Looked((replace(one, looks=many(one.looks, MANY)),)), viewed.folder)
    browsed.complaints()
    with page_served(contents) as link:
        assert browsed.opened(link) == "ready"
        assert browsed.traces("rig", "spots")[0]["count"] == 3000
        browsed.click("next")
        browsed.until("document.getElementById('look').value === '1'")
        # All looks are selected, also those without a dot.
        browsed.js(FRAME, "residuals", {"x": [-1e4, 1e4], "y": [-1e4, 1e4]})
        known = MANY - MANY // 384 - 1
        browsed.until(f"Number(document.body.dataset.chosen) >= {known - 1}")
        assert browsed.chosen() < MANY
        assert browsed.one("chosen").text.endswith("looks are selected, 3000 are marked")
        assert browsed.marks("stops") == browsed.marks("residuals") != [0, 0]
        assert f"of {MANY} looks have a spot; dots of 3000" in browsed.one("rig-remark").text
    assert browsed.complaints() == []
