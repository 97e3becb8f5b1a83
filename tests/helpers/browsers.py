"""A browser without a window, driven by selenium: for the tests of the page and its benchmark."""

from __future__ import annotations

import importlib.util
import json
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from selenium.webdriver import Chrome

BROWSERS = ("chromium", "chromium-browser", "google-chrome", "google-chrome-stable", "chrome")
READY_SECONDS = 60


class NoBrowser(Exception):
    """No page can be opened here, and why."""


@contextmanager
def open_browser(width: int = 1200, height: int = 800, *extra: str) -> Iterator[Chrome]:
    """A browser that reaches nothing but files, and writes down every request. It draws in software."""
    browser = next(filter(None, map(shutil.which, BROWSERS)), None)
    driver = shutil.which("chromedriver")  # never downloaded
    if importlib.util.find_spec("selenium") is None or browser is None or driver is None:
        raise NoBrowser("selenium, Chromium or Chrome, and chromedriver are needed (apt-get install chromium-driver)")
    from selenium.common.exceptions import WebDriverException
    from selenium.webdriver import Chrome, ChromeOptions
    from selenium.webdriver.chrome.service import Service

    options = ChromeOptions()
    options.binary_location = browser
    for argument in (
        "--headless=new",
        "--no-sandbox",  # which root, as in containers, cannot have
        "--disable-dev-shm-usage",
        "--use-angle=swiftshader",
        "--enable-unsafe-swiftshader",
        "--hide-scrollbars",
        "--force-device-scale-factor=1",
        "--host-resolver-rules=MAP * ~NOTFOUND, EXCLUDE 127.0.0.1",
        f"--window-size={width},{height}",
        *extra,
    ):
        options.add_argument(argument)
    options.set_capability("goog:loggingPrefs", {"browser": "ALL", "performance": "ALL"})
    try:
        chrome = Chrome(options=options, service=Service(driver))
    except WebDriverException as error:
        raise NoBrowser(f"{browser} does not start: {str(error).splitlines()[0]}") from None
    try:
        yield chrome
    finally:
        chrome.quit()


def open_page(chrome: Chrome, path: Path, frame: str | None = None) -> float:
    """Open a page of shapes, or one that has it in a frame; milliseconds from the navigation to its first picture."""
    from selenium.webdriver.support.ui import WebDriverWait

    chrome.get(path.absolute().as_uri())
    if frame:
        chrome.switch_to.frame(chrome.find_element("css selector", frame))
    # A message says that it is loading, is hidden, or says what is wrong.
    script = (
        "const message = document.querySelector('#message');"
        "if (window.torchModal?.readyAfter) return window.torchModal.readyAfter;"
        "return !message || message.hidden || message.innerText.startsWith('Loading') ? null : message.innerText"
    )
    ready = WebDriverWait(chrome, READY_SECONDS).until(lambda driver: driver.execute_script(script))
    if not isinstance(ready, (int, float)):
        raise AssertionError(f"the page says: {ready}; {console(chrome)}")
    return float(ready)


def console(chrome: Chrome) -> list[str]:
    """What the page has put on the console since it was last asked."""
    return [f"{entry['level']}: {entry['message']}" for entry in chrome.get_log("browser")]


def requests(chrome: Chrome) -> list[str]:
    """Addresses that the page has asked for since it was last asked."""
    events = (json.loads(entry["message"])["message"] for entry in chrome.get_log("performance"))
    return [event["params"]["request"]["url"] for event in events if event["method"] == "Network.requestWillBeSent"]
