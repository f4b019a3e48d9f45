"""The page in headless Chromium, opened as a file: every control, the linked selection, what is saved."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import fields, replace
from pathlib import Path

import numpy as np
import pytest
from support.viewed_twin import PICTURED, UNDETECTED

pytest.importorskip("selenium", reason="selenium is not installed")
from selenium import webdriver
from selenium.webdriver.common.by import By
from selenium.webdriver.support.ui import Select, WebDriverWait
from support.browsers import CHROMIUM, DRIVER, SECONDS_MAX, Browsed, browser

from tvsbayes.instrument.campaign import read_campaign, with_pixels
from tvsbayes.view.page import document, page_html
from tvsbayes.view.pictures import look_pictures
from tvsbayes.view.scene import LookColumns, Looked, look_at, scene

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(not (CHROMIUM and DRIVER), reason="needs `apt install chromium chromium-driver`"),
    # Selenium's own sockets to its driver.
    pytest.mark.filterwarnings("ignore::ResourceWarning"),
]
MANY = 50_000
PLOTS = ("rig", "pictures", "residuals", "stops", "correlation", "changes")
ASK = "const i = document.getElementById('look'); i.value = arguments[0]; i.dispatchEvent(new Event('change'))"
PATH = "return document.querySelector(`#${arguments[0]} path[data-name='${arguments[1]}']`).getAttribute('d')"
REACH = "((box) => box.xs[1] - box.xs[0])(document.page.plots.pictures.panels[0].box)"
"""Pixels from the left to the right end of the left picture."""


@pytest.fixture(scope="module")
def browsed(tmp_path_factory) -> Iterator[Browsed]:
    with browser(tmp_path_factory.mktemp("saved")) as opened:
        yield opened


def page_of(place: Path, looked: Looked, *folders: Path) -> str:
    """The address of the page of scenes, with the pictures in their folders."""
    pictures = [look_pictures(folder, one.looks) for folder, one in zip(folders, looked.scenes, strict=True)]
    place.write_bytes(page_html(document(looked, pictures)))
    return place.as_uri()


@pytest.fixture(scope="module")
def both(viewed, tmp_path_factory) -> str:
    """The campaign beside itself, the last of its looks suspect."""
    looked = look_at(viewed.folder, viewed.folder)
    first = looked.scenes[0]
    suspect = first.looks.suspect.copy()
    suspect[-1] = True
    doubted = replace(first, looks=replace(first.looks, suspect=suspect))
    place = tmp_path_factory.mktemp("page") / "both.html"
    return page_of(place, replace(looked, scenes=(doubted, looked.scenes[1])), viewed.folder, viewed.folder)


@pytest.fixture
def page(both, browsed) -> Iterator[Browsed]:
    browsed.complaints(), browsed.requested_hosts()
    assert browsed.opened(both) == "ready"
    yield browsed
    assert browsed.complaints() == []
    assert browsed.requested_hosts() == set()


def test_page_shows_everything_and_requests_no_host(page):
    assert page.one("name").text == "paper twin beside paper twin"
    for plot in PLOTS:
        assert page.js("return document.querySelectorAll(`#${arguments[0]} svg.chart *`).length", plot) > 10
    assert page.layers("rig", "spots") == [383, 383] and page.layers("residuals", "looks") == [383] * 4
    assert page.layers("rig", "sheets") == [8, 8]
    written = page.one("rig").text
    assert all(text in written for text in ("left camera", "right camera", "positioner", "sheet d1"))
    assert page.one("verdict").text == "no significant change"
    assert page.one("parameters-figure").text.startswith("Parameters of the first, paper twin")
    assert len(page.driver.find_elements(By.CSS_SELECTOR, "#changes-table tbody tr")) == 6


def test_every_switch_of_the_rig(page):
    for name in ("spots", "ellipsoids", "beams", "mirrors", "cameras", "sheets"):
        assert len(page.layers("rig", f"{name} ")) == 2
        page.click(f"show-{name}")
        assert page.layers("rig", f"{name} ") == []
        page.click(f"show-{name}")
        assert len(page.layers("rig", f"{name} ")) == 2

    def path(name: str) -> str:
        return page.js(PATH, "rig", name)

    paths = set()
    for view in ("from-above", "from-side", "from-behind"):
        page.click(view)
        paths.add(path("spots 0"))
    before = path("ellipsoids 0")
    Select(page.one("ellipsoid-scale")).select_by_visible_text("100")
    assert path("ellipsoids 0") != before
    chart = page.driver.find_element(By.CSS_SELECTOR, "#rig svg")
    webdriver.ActionChains(page.driver).drag_and_drop_by_offset(chart, 80, 30).perform()
    paths.add(path("spots 0"))
    for button in ("larger-rig", "smaller-rig"):
        page.click(button)
        paths.add(path("spots 0"))
    assert len(paths) >= 5


def test_looks_are_walked_by_number(page):
    def look() -> str:
        return page.one("look").get_property("value")

    first = look()
    page.click("next")
    assert look() != first
    page.click("previous")
    assert look() == first
    page.click("unlikely")
    assert "the fit finds it unlikely" in page.one("facts").text
    page.js(ASK, "099999")
    assert "there is no look 99999" in page.one("chosen").text and look() == "99999"
    page.js(ASK, str(UNDETECTED))
    assert "undetected" in page.one("facts").text
    assert "No picture of this look is kept (left, right)" in page.one("pictures-remark").text
    Select(page.one("campaign")).select_by_value("1")
    assert page.one("chosen").text == ""
    page.click("none")
    assert page.chosen() == 0 and page.marks("stops") == page.marks("residuals") == [0, 0]


def test_picture_of_a_look_with_what_was_found(page):
    page.js(ASK, str(PICTURED))
    sources = page.js("return [...document.querySelectorAll('#pictures image')].map((i) => i.getAttribute('href'))")
    assert len(sources) == 1 and sources[0].startswith("data:image/jpeg;base64,")
    assert page.layers("pictures", "found") == page.layers("pictures", "fitted") == [1, 1]
    assert page.js(f"return {REACH}") == 48
    page.click("window-all")
    assert page.js(f"return {REACH}") == 1280
    page.click("window-spot")
    assert page.js(f"return {REACH}") == 48
    assert "(right)" in page.one("pictures-remark").text


def dragged(page: Browsed, plot: str, *way: tuple[float, float]) -> None:
    """Drag over the left chart of a plot, along places from (0, 0) at its upper left to (1, 1)."""
    page.js("document.getElementById(arguments[0]).scrollIntoView({block: 'center'})", plot)
    chart = page.driver.find_element(By.CSS_SELECTOR, f"#{plot} svg")
    box = page.js(f"return document.page.plots.{plot}.panels[0].box")
    width, height = chart.size["width"], chart.size["height"]
    mouse = webdriver.ActionChains(page.driver)
    left, top = box["left"] - width / 2, box["top"] - height / 2
    at = [(round(left + x * box["w"]), round(top + y * box["h"])) for x, y in way]
    mouse.move_to_element_with_offset(chart, *at[0]).click_and_hold()
    for place in at[1:]:
        mouse.move_to_element_with_offset(chart, *place)
    mouse.release().perform()


def test_what_is_framed_or_clicked_in_one_plot_is_selected_in_all(page):
    count = 2 * 383
    dragged(page, "residuals", (0.01, 0.01), (0.5, 0.5), (0.99, 0.99))
    assert page.chosen() == count and page.marks("stops") == page.marks("residuals") == [count, count]
    assert page.one("chosen").text == f"{count} looks are selected"
    assert page.layers("rig", "chosen")[0] == count
    # Nothing lies in this corner, so the selection stays.
    dragged(page, "residuals", (0.01, 0.9), (0.02, 0.98))
    assert page.chosen() == count
    # The left half: counters of one side.
    Select(page.one("mode-stops")).select_by_value("lasso")
    dragged(page, "stops", (0.01, 0.01), (0.01, 0.99), (0.55, 0.99), (0.55, 0.01))
    half = page.chosen()
    assert 0 < half < count and page.marks("residuals") == [half, half]
    Select(page.one("mode-stops")).select_by_value("move")
    before = page.js("return document.page.plots.stops.panels[0].box.xs")
    dragged(page, "stops", (0.4, 0.4), (0.5, 0.5))
    assert page.js("return document.page.plots.stops.panels[0].box.xs")[0] < before[0] and page.chosen() == half
    page.click("whole-stops")
    assert page.js("return document.page.plots.stops.panels[0].box.xs") == before
    at = page.js("const [p] = document.page.plots.rig.panels[0].picks; return p[0]")
    chart = page.driver.find_element(By.CSS_SELECTOR, "#rig svg")
    page.js("document.getElementById('rig').scrollIntoView({block: 'center'})")
    offset = [round(at[0] - chart.size["width"] / 2), round(at[1] - chart.size["height"] / 2)]
    webdriver.ActionChains(page.driver).move_to_element_with_offset(chart, *offset).click().perform()
    assert page.chosen() == 1 and page.marks("residuals") == [1, 1]
    assert page.driver.find_element(By.CSS_SELECTOR, ".hint").text.startswith("look ")


def test_arrows_bars_and_bands(page):
    def arrows() -> str:
        return page.js(PATH, "residuals", "arrows 0")

    before = arrows()
    Select(page.one("residual-scale")).select_by_visible_text("1000")
    assert arrows() != before
    for switch, name in (("show-gears", "gear"), ("show-u", "u ")):
        assert page.layers("stops", name)
        page.click(switch)
        assert page.layers("stops", name) == []
        page.click(switch)


def test_parameters_and_correlations_are_linked(page):
    rows = page.driver.find_elements(By.CSS_SELECTOR, "#parameters tbody tr")
    page.one("filter").send_keys("backlash_deg.pan")
    page.until("document.querySelectorAll('#parameters tbody tr:not([hidden])').length === 1")
    page.driver.find_element(By.CSS_SELECTOR, "#parameters tbody tr:not([hidden])").click()
    assert page.one("correlation-remark").text.startswith("backlash_deg.pan goes most with")
    assert page.layers("correlation", "marked") == [10]
    page.js("document.page.plots.correlation.panels[0].picked(['tilt_zero_deg', 'mirror_offset_mm'])")
    assert page.js("return document.querySelectorAll('#parameters tr.marked').length") == 2
    assert len(rows) > 50


@pytest.mark.parametrize("plot", PLOTS)
def test_plots_are_saved_as_they_are_seen(page, plot):
    begins = {"png": b"\x89PNG\r\n\x1a\n", "svg": b"<svg"}
    for kind, start in begins.items():
        page.click(f"save-{kind}-{plot}")
        place = Path(page.driver.saved) / f"paper-twin-{plot}.{kind}"
        WebDriverWait(page.driver, SECONDS_MAX).until(lambda _, place=place: place.exists() and place.stat().st_size)
        content = place.read_bytes()
        assert content.startswith(start) and len(content) > 2000
        assert kind == "png" or (b"var(" not in content and b"rgb(" in content)


@pytest.mark.parametrize("scheme", ["light", "dark"])
@pytest.mark.parametrize("width", [390, 1280])
def test_nothing_is_cut_off(page, scheme, width):
    """On a telephone and a screen, by day and by night: no sideways scrolling, and text that stands out."""
    with page.shown(width, scheme):
        page.driver.refresh()
        assert page.until("document.body?.dataset.state") == "ready"
        assert page.js("return document.documentElement.scrollWidth") <= width
        ink, ground = page.brightness("figure")
        assert (ground > 600 > ink + 150) if scheme == "light" else (ink > 350 > ground + 150)


def test_texts_of_a_campaign_are_texts(viewed, browsed, tmp_path):
    """Names that would end the script or begin one."""
    hostile = "</script><script>document.body.dataset.state = 'taken'</script><img src=x onerror=alert(1)>"
    one = look_at(viewed.bare).scenes[0]
    renamed = replace(one, name=hostile, looks=replace(one.looks, target=(hostile,) * len(one.looks.spot)))
    browsed.complaints()
    assert browsed.opened(page_of(tmp_path / "page.html", Looked((renamed,)), viewed.bare)) == "ready"
    assert browsed.one("name").text == hostile
    assert browsed.complaints() == [] and browsed.requested_hosts() == set()


def test_folder_without_results_and_one_without_spots(viewed, browsed, tmp_path):
    """The stated rig without residuals; then cameras alone."""
    campaign = read_campaign(viewed.bare)
    blind = replace(campaign, spots=tuple(with_pixels(spot, "undetected") for spot in campaign.spots))
    browsed.complaints()
    for looked, count in ((look_at(viewed.bare), 383), (Looked((scene(blind),)), 0)):
        assert browsed.opened(page_of(tmp_path / f"{count}.html", looked, viewed.bare)) == "ready"
        assert browsed.layers("rig", "spots") == [count] and len(browsed.layers("rig", "cameras")) == 1
        assert browsed.one("residuals-remark").text.startswith("No residuals without a fit")
        assert not browsed.one("correlation-figure").is_displayed()
        assert not browsed.one("changes-figure").is_displayed()
        browsed.click("next")
        assert browsed.one("look").get_property("value") == "1"
        browsed.click("unlikely")
        assert browsed.one("chosen").text == "the fit finds no look unlikely"
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


def test_fifty_thousand_looks(viewed, browsed, tmp_path):
    one = look_at(viewed.folder).scenes[0]
    looked = Looked((replace(one, looks=many(one.looks, MANY)),))
    browsed.complaints()
    assert browsed.opened(page_of(tmp_path / "page.html", looked, viewed.folder)) == "ready"
    assert browsed.layers("rig", "spots") == [3000]
    browsed.click("next")
    assert browsed.one("look").get_property("value") == "1"
    # All looks are selected, also those without a dot.
    dragged(browsed, "residuals", (0.001, 0.001), (0.999, 0.999))
    known = MANY - MANY // 384 - 1
    assert 0.9 * known < browsed.chosen() <= known
    assert browsed.one("chosen").text.endswith("looks are selected, 3000 are marked")
    assert browsed.marks("stops") == browsed.marks("residuals") != [0, 0]
    assert f"of {MANY} looks have a spot; dots of 3000" in browsed.one("rig-remark").text
    assert browsed.complaints() == []
