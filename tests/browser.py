"""Chromium without a window, driven through a pipe by the Chrome DevTools Protocol."""

from __future__ import annotations

import base64
import io
import json
import os
import select
import shutil
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

BROWSERS = ("chromium", "chromium-browser", "google-chrome")
BROWSER = next((found for name in BROWSERS if (found := shutil.which(name))), None)
TIMEOUT_S = 180
"""For one answer: a software renderer on a busy machine takes a minute for what takes a second on a free one."""
FLAGS = (
    "--headless",
    "--no-sandbox",
    "--remote-debugging-pipe",
    "--disable-background-networking",
    "--disable-dev-shm-usage",
    "--use-angle=swiftshader",
    "--enable-unsafe-swiftshader",
    "--host-resolver-rules=MAP * ~NOTFOUND",
)

START = """
import fcntl, os, sys
ends = [fcntl.fcntl(int(end), fcntl.F_DUPFD, 10) for end in sys.argv[1:3]]
for place, end in zip((3, 4), ends):
    os.dup2(end, place)
os.execv(sys.argv[3], sys.argv[3:])
"""
"""The browser reads commands from descriptor 3 and writes answers to 4."""


class Browser:
    """A browser process; close it with `close`."""

    def __init__(self, folder: Path) -> None:
        assert BROWSER is not None
        commands, answers = os.pipe(), os.pipe()
        ends = (commands[0], answers[1])
        command = [BROWSER, *FLAGS, f"--user-data-dir={folder}"]
        quiet: dict[str, Any] = {"stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL}
        self._process = subprocess.Popen(
            [sys.executable, "-c", START, *map(str, ends), *command], pass_fds=ends, **quiet
        )
        for end in ends:
            os.close(end)
        self._commands, self._answers, self._buffer, self._number = commands[1], answers[0], b"", 0
        self._events: list[dict[str, Any]] = []

    def close(self) -> None:
        self.call("Browser.close")
        self._process.wait(TIMEOUT_S)
        for end in (self._commands, self._answers):
            os.close(end)

    def call(self, method: str, session: str | None = None, **parameters: Any) -> dict[str, Any]:
        """Send a command and wait for its answer; events are kept."""
        self._number += 1
        message: dict[str, Any] = {"id": self._number, "method": method, "params": parameters}
        text = json.dumps(message | ({} if session is None else {"sessionId": session}))
        os.write(self._commands, text.encode() + b"\0")
        end = time.monotonic() + TIMEOUT_S
        while True:
            while b"\0" not in self._buffer:
                if not select.select([self._answers], [], [], max(end - time.monotonic(), 0))[0]:
                    raise TimeoutError(f"{method}: no answer from the browser in {TIMEOUT_S} s")
                part = os.read(self._answers, 1 << 20)
                if not part:
                    raise ConnectionError(f"{method}: the browser ended")
                self._buffer += part
            line, _, self._buffer = self._buffer.partition(b"\0")
            answer = json.loads(line)
            if answer.get("id") == self._number:
                assert "error" not in answer, answer
                return dict(answer["result"])
            self._events.append(answer)

    def open(self, page: Path, width: int, height: int) -> Tab:
        """Open a page at a width and height in pixels."""
        self._events.clear()
        target = self.call("Target.createTarget", url="about:blank")["targetId"]
        session = self.call("Target.attachToTarget", targetId=target, flatten=True)["sessionId"]
        for domain in ("Page", "Runtime", "Log", "Network"):
            self.call(f"{domain}.enable", session)
        size = {"width": width, "height": height, "deviceScaleFactor": 1, "mobile": width < 600}
        self.call("Emulation.setDeviceMetricsOverride", session, **size)
        self.call("Page.navigate", session, url=page.as_uri())
        return Tab(self, session, target)


class Tab:
    """An open page."""

    def __init__(self, browser: Browser, session: str, target: str) -> None:
        self._browser, self._session, self._target = browser, session, target

    def run(self, script: str) -> Any:
        """The value of an expression, of which promises are awaited."""
        options = {"awaitPromise": True, "returnByValue": True}
        found = self._browser.call("Runtime.evaluate", self._session, expression=script, **options)
        assert "exceptionDetails" not in found, found["exceptionDetails"]
        return found["result"].get("value")

    def picture(self) -> np.ndarray:
        """What the page looks like [height, width, 3]."""
        data = self._browser.call("Page.captureScreenshot", self._session)["data"]
        return np.asarray(Image.open(io.BytesIO(base64.b64decode(data))).convert("RGB"))

    def events(self, *methods: str) -> list[dict[str, Any]]:
        """Parameters of the events of some kinds so far."""
        return [event["params"] for event in self._browser._events if event.get("method") in methods]

    def requests(self) -> list[str]:
        """Addresses of all requests."""
        return [event["request"]["url"] for event in self.events("Network.requestWillBeSent")]

    def complaints(self) -> list[dict[str, Any]]:
        """Exceptions, errors and warnings of the console, and errors that the browser logs.

        Its warnings are advice on the performance of plotly.js.
        """
        logged = [event["entry"] for event in self.events("Log.entryAdded")]
        found = [entry for entry in logged if entry["level"] == "error"]
        found += [call for call in self.events("Runtime.consoleAPICalled") if call["type"] in ("error", "warning")]
        return found + self.events("Runtime.exceptionThrown")

    def close(self) -> None:
        self._browser.call("Target.closeTarget", targetId=self._target)
