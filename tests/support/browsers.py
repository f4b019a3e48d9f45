"""Headless Chromium for tests of pages, and a page of another origin."""

from __future__ import annotations

import json
import shutil
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from urllib.parse import urlsplit

from selenium import webdriver
from selenium.webdriver.common.by import By
from selenium.webdriver.support.ui import WebDriverWait

CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")
DRIVER = shutil.which("chromedriver")
SECONDS_MAX = 180
"""For the page to complete a request; reached only where it hangs."""
FLAGS = (
    *("--headless=new", "--no-sandbox", "--disable-dev-shm-usage", "--window-size=1400,1900"),
    *("--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader"),
)
"""No screen, perhaps root, no graphics card."""


class Browsed:
    """A browser with one page."""

    def __init__(self, driver: webdriver.Chrome):
        self.driver = driver

    def until(self, wanted: str):
        """Wait for a condition in JavaScript; its value."""
        return WebDriverWait(self.driver, SECONDS_MAX, 0.1).until(lambda d: d.execute_script(f"return {wanted}"))

    def opened(self, link: str) -> str:
        self.driver.get("about:blank")
        self.driver.get(link)
        return self.until("document.body?.dataset.state")

    def one(self, name: str):
        return self.driver.find_element(By.ID, name)

    def click(self, name: str) -> None:
        self.driver.execute_script("arguments[0].scrollIntoView({block: 'center'})", self.one(name))
        self.one(name).click()

    def js(self, code: str, *arguments):
        return self.driver.execute_script(code, *arguments)

    def layers(self, plot: str, name: str) -> list[int]:
        """Of a plot, the layers whose name begins so that are seen: how many points each has."""
        code = (
            "return [...document.querySelectorAll(`#${arguments[0]} path[data-name^='${arguments[1]}']`)]"
            ".map((path) => Number(path.dataset.count))"
        )
        return self.js(code, plot, name)

    def marks(self, plot: str) -> list[int]:
        """Of a plane plot, marks on what is selected: left and right."""
        code = (
            "return [...document.querySelectorAll(`#${arguments[0]} path[data-name=chosen]`)]"
            ".map((path) => Number(path.dataset.count))"
        )
        return self.js(code, plot)

    def chosen(self) -> int:
        return int(self.js("return document.body.dataset.chosen"))

    @contextmanager
    def shown(self, width: int, scheme: str) -> Iterator[None]:
        """On a screen so wide, "light" or "dark"."""
        metrics = {"width": width, "height": 1200, "deviceScaleFactor": 1, "mobile": False}
        self.driver.execute_cdp_cmd("Emulation.setDeviceMetricsOverride", metrics)
        media = {"features": [{"name": "prefers-color-scheme", "value": scheme}]}
        self.driver.execute_cdp_cmd("Emulation.setEmulatedMedia", media)
        try:
            yield
        finally:
            self.driver.execute_cdp_cmd("Emulation.clearDeviceMetricsOverride", {})
            self.driver.execute_cdp_cmd("Emulation.setEmulatedMedia", {"features": []})

    def brightness(self, place: str) -> list[float]:
        """Of text and ground of the first element of a kind: sums of red, green and blue."""
        code = (
            "return arguments[0].map((name) => getComputedStyle(document.querySelector(arguments[1]))[name]"
            ".match(/\\d+/g).slice(0, 3).reduce((sum, part) => sum + Number(part), 0))"
        )
        return self.js(code, ["color", "backgroundColor"], place)

    def complaints(self) -> list[str]:
        return [entry["message"] for entry in self.driver.get_log("browser") if entry["level"] == "SEVERE"]

    def requested_hosts(self) -> set[str]:
        """Hosts of all network requests since the last call."""
        events = [json.loads(entry["message"])["message"] for entry in self.driver.get_log("performance")]
        urls = [e["params"]["request"]["url"] for e in events if e["method"] == "Network.requestWillBeSent"]
        return {urlsplit(url).netloc for url in urls if urlsplit(url).scheme in ("http", "https", "ws", "wss")}


@contextmanager
def browser(saved: Path) -> Iterator[Browsed]:
    """A browser of its own, which saves files in a folder."""
    options = webdriver.ChromeOptions()
    options.binary_location = CHROMIUM
    for flag in FLAGS:
        options.add_argument(flag)
    options.set_capability("goog:loggingPrefs", {"browser": "ALL", "performance": "ALL"})
    options.add_experimental_option("prefs", {"download.default_directory": str(saved)})
    driver = webdriver.Chrome(options=options, service=webdriver.ChromeService(DRIVER))
    driver.saved = saved
    try:
        yield Browsed(driver)
    finally:
        driver.quit()


@contextmanager
def foreign_page() -> Iterator[str]:
    """An empty page of another origin."""

    class Page(BaseHTTPRequestHandler):
        def do_GET(self) -> None:
            self.send_response(200)
            self.send_header("Content-Type", "text/html")
            self.end_headers()
            self.wfile.write(b"<body data-state=foreign></body>")

        def log_message(self, *args: object) -> None:
            pass

    server = ThreadingHTTPServer(("127.0.0.1", 0), Page)
    threading.Thread(target=server.serve_forever).start()
    try:
        yield f"http://127.0.0.1:{server.server_port}/"
    finally:
        server.shutdown()
        server.server_close()
