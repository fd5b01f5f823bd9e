"""Pages in a browser: Chromium without a window, driven by Playwright."""

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path

from playwright.sync_api import Browser, ConsoleMessage, Page, sync_playwright
from programs import installed

BROWSERS = ("chromium", "chromium-browser", "google-chrome")
LAPTOP, PHONE = (1366, 768), (390, 844)
"""Widths and heights of windows in pixels."""
TIMEOUT_MS = 180_000
"""For one answer: a software renderer on a busy machine takes a minute for what takes a second on a free one."""
FLAGS = ("--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--host-resolver-rules=MAP * ~NOTFOUND")
"""WebGL without a graphics card, and no name of a host resolved: pages are files, and the browser asks no server."""


@contextmanager
def started() -> Iterator[Browser]:
    """A running browser, without a sandbox, which root cannot have."""
    program = installed(*BROWSERS)
    with sync_playwright() as playwright:
        running = playwright.chromium.launch(executable_path=program, args=FLAGS, timeout=TIMEOUT_MS)
        yield running
        running.close()


@dataclass
class OpenPage:
    """An open page, with the addresses that it requested and what the browser's console complains of."""

    page: Page
    requests: list[str] = field(default_factory=list)
    complaints: list[str] = field(default_factory=list)


def open_page(browser: Browser, file: Path, size: tuple[int, int]) -> OpenPage:
    """Open a file in a window of a width and height in pixels, a telephone's below 600; close ``page`` afterwards."""
    width, height = size
    page = browser.new_page(viewport={"width": width, "height": height}, is_mobile=width < 600)
    page.set_default_timeout(TIMEOUT_MS)
    opened = OpenPage(page)

    def hear(message: ConsoleMessage) -> None:
        # Warnings without arguments are the browser's own: advice on the performance of plotly.js.
        if message.type == "error" or (message.type == "warning" and message.args):
            opened.complaints.append(message.text)

    page.on("console", hear)
    page.on("pageerror", lambda error: opened.complaints.append(str(error)))
    page.on("request", lambda request: opened.requests.append(request.url))
    page.goto(file.as_uri())
    return opened
