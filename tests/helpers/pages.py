"""Pages of shapes: what a test reads in their text, and does with them in a browser."""

import base64
import io
import json
import re
import time
import zlib
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from helpers.browsers import console, open_page, requests
from torch_modal.view.page import Page

NASTY = "</script><script>document.title='broken'</script><img src=x onerror=\"document.title='broken'\">&amp;'"


def data_of(page: Page) -> dict[str, Any]:
    """What the page's scripts find in it."""
    found = re.search(r'<script type="application/json" id="data">(.*?)</script>', page.html, re.S)
    assert found
    return json.loads(found.group(1))


def unpacked(text: str, width: int) -> np.ndarray:
    """Signed numbers from a page's text, as page_data.py describes it: one at a time, the plain way."""
    planes = zlib.decompress(base64.b64decode(text))
    count = len(planes) // width
    numbers = [sum(planes[p * count + i] << (8 * p) for p in range(width)) for i in range(count)]
    return np.array([n // 2 if n % 2 == 0 else -(n + 1) // 2 for n in numbers])


class Opened:
    """A page in the browser, and what is done with it."""

    def __init__(self, chrome: Any, path: Path, frame: str | None = None) -> None:
        self.chrome = chrome
        console(chrome), requests(chrome)  # of the page before
        open_page(chrome, path, frame)

    def script(self, text: str, *arguments: Any) -> Any:
        return self.chrome.execute_script(text, *arguments)

    def settle(self) -> None:
        """Wait until all is drawn and nothing moves, also after two more turns of the page's loop."""
        look = "const done = arguments[0]; requestAnimationFrame(() => requestAnimationFrame(() => setTimeout(() =>"
        for _ in range(200):
            if self.chrome.execute_async_script(f"{look} done(torchModal.idle))))"):
                return
            time.sleep(0.05)
        raise AssertionError("the page does not come to rest")

    def seek(self, frame: float) -> None:
        self.script("torchModal.seek(arguments[0])", frame)
        self.settle()

    def text(self, selector: str) -> str:
        return self.chrome.find_element("css selector", selector).text

    def click(self, selector: str) -> None:
        self.chrome.find_element("css selector", selector).click()
        self.settle()

    def choose(self, name: str, value: str) -> None:
        change = "const s = document.getElementById(arguments[0]); s.value = arguments[1];"
        self.script(change + "s.dispatchEvent(new Event('change'))", name, value)
        self.settle()

    def press(self, *keys: str) -> None:
        from selenium.webdriver import ActionChains

        ActionChains(self.chrome).send_keys(*keys).perform()
        self.settle()

    def click_at(self, x: float, y: float) -> None:
        from selenium.webdriver.common.actions.action_builder import ActionBuilder

        builder = ActionBuilder(self.chrome)
        builder.pointer_action.move_to_location(round(x), round(y)).click()
        builder.perform()
        self.settle()

    def pixels(self) -> np.ndarray:
        """The shapes as they are seen, without what lies over them. *Shape:* ``(height, width, 3)``."""
        png = self.chrome.find_element("id", "canvas").screenshot_as_png
        return np.asarray(Image.open(io.BytesIO(png)).convert("RGB")).astype(np.int64)

    def position(self, vertex: int, sequence: int = 0) -> np.ndarray:
        return np.array(self.script("return torchModal.positionOf(arguments[0], arguments[1])", vertex, sequence))

    def picks(self) -> list[int]:
        return [int(word) for word in self.script("return torchModal.text").split(",") if word.strip()]

    def drawn_area(self) -> int:
        """How many pixels are not background, which is nearly white."""
        return int((self.pixels().min(axis=-1) < 225).sum())

    def reddish(self) -> int:
        """How many pixels are of the warm colour of key-frames."""
        pixels = self.pixels()
        return int((pixels[..., 0] > pixels[..., 2] + 30).sum())
