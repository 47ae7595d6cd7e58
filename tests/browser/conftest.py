"""Opens the page in Chromium, from a file, and records errors, dialogs and requests to other addresses."""

import os
import shutil
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import pytest

FLAGS = (
    *("--no-sandbox", "--disable-gpu", "--disable-quic", "--no-first-run", "--disable-background-networking"),
    *("--disable-component-update", "--disable-sync"),
    *("--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader"),  # WebGL without a GPU
)
# Messages about screenshots of software WebGL, and about how Plotly measures letters.
HARMLESS = ("GPU stall due to ReadPixels", "Canvas2D: Multiple readback operations")
TIMEOUT_MILLISECONDS = 60_000  # for a busy machine


@dataclass
class Tab:
    """A tab of the browser with a page of a results folder, and what went wrong in it."""

    page: Any
    results: Path
    wrong: list[str] = field(default_factory=list)

    def open(self, address: str = "") -> Any:
        """Goes to an address of the page, such as #/runs."""
        self.page.goto("about:blank")
        self.page.goto((self.results / "index.html").as_uri() + address)
        return self.page

    def watch(self) -> None:
        page, inside = self.page, self.results.as_uri()
        page.on("console", lambda message: self._log(message))
        page.on("pageerror", lambda error: self.wrong.append(f"error: {error}"))
        page.on("dialog", lambda dialog: (self.wrong.append(f"dialog: {dialog.message}"), dialog.dismiss()))
        page.on("requestfailed", lambda request: self.wrong.append(f"failed: {request.url}"))
        page.on("request", lambda request: self._request(request.url, inside))
        page.on("popup", lambda popup: self.wrong.append(f"popup: {popup.url}"))

    def _log(self, message: Any) -> None:
        if message.type in ("error", "warning") and not any(words in message.text for words in HARMLESS):
            self.wrong.append(f"{message.type}: {message.text}")

    def _request(self, url: str, inside: str) -> None:
        if not url.startswith((inside, "data:", "blob:", "about:")):
            self.wrong.append(f"request: {url}")


@pytest.fixture(scope="session")
def browser() -> Iterator[Any]:
    """Chromium; the test is skipped where it or Playwright is missing."""
    playwright = pytest.importorskip("playwright.sync_api", reason="needs Playwright: `make test-browser` installs it")
    chromium = os.environ.get("CHROMIUM") or shutil.which("chromium") or shutil.which("google-chrome")
    if chromium is None:
        pytest.skip("needs Chromium: `make test-browser` installs it, or CHROMIUM=/path/to/chromium names it")
    with playwright.sync_playwright() as driver:
        opened = driver.chromium.launch(
            executable_path=chromium, args=list(FLAGS), headless=True, timeout=TIMEOUT_MILLISECONDS
        )
        yield opened
        opened.close()


@pytest.fixture
def tab(browser) -> Iterator[Callable[..., Tab]]:
    """Makes a tab of a results folder; at the end of the test nothing may have gone wrong in it."""
    opened = []

    def make(results: Path, *, width: int = 1400, height: int = 900, dark: bool = False) -> Tab:
        scheme = "dark" if dark else "light"
        context = browser.new_context(viewport={"width": width, "height": height}, color_scheme=scheme)
        context.set_default_timeout(TIMEOUT_MILLISECONDS)
        opened_tab = Tab(context.new_page(), results)
        opened_tab.watch()
        opened.append((opened_tab, context))
        return opened_tab

    yield make
    for opened_tab, context in opened:
        context.close()
        assert opened_tab.wrong == []
