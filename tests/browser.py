"""Chromium without a window, driven over the W3C WebDriver protocol by nothing but the standard library."""

from __future__ import annotations

import base64
import contextlib
import json
import re
import shutil
import subprocess
import tempfile
import urllib.request
from collections.abc import Iterator
from pathlib import Path
from typing import Any

FLAGS = [
    "--headless",
    "--no-sandbox",
    "--disable-gpu",
    "--disable-quic",
    "--disable-dev-shm-usage",
    "--no-first-run",
    "--disable-background-networking",
    "--disable-component-update",
    "--disable-sync",
    "--hide-scrollbars",
]
PATIENCE = 60  # seconds for one command, on a busy machine


def installed() -> tuple[str, str] | None:
    """Where Chromium and its driver are; None where one of them is not."""
    names = ("chromium", "chromium-browser", "google-chrome", "google-chrome-stable")
    browser = next(filter(None, map(shutil.which, names)), None)
    driver = shutil.which("chromedriver")
    return (browser, driver) if browser and driver else None


class Browser:
    """One window."""

    def __init__(self, address: str, binary: str, profile: str) -> None:
        self.address = address
        options = {"binary": binary, "args": [*FLAGS, f"--user-data-dir={profile}"]}
        wanted = {"browserName": "chrome", "goog:chromeOptions": options, "goog:loggingPrefs": {"browser": "ALL"}}
        self.session = self.ask("POST", "/session", {"capabilities": {"alwaysMatch": wanted}})["sessionId"]

    def ask(self, method: str, path: str, body: dict[str, Any] | None = None) -> Any:
        data = None if body is None else json.dumps(body).encode()
        request = urllib.request.Request(self.address + path, data, {"Content-Type": "application/json"}, method=method)
        with urllib.request.urlopen(request, timeout=PATIENCE) as answer:
            return json.load(answer)["value"]

    def do(self, what: str, **body: Any) -> Any:
        return self.ask("POST", f"/session/{self.session}/{what}", body)

    def open(self, file: Path) -> None:
        self.do("url", url=file.resolve().as_uri())

    def resize(self, width: int, height: int = 800) -> None:
        """The size of the page's window, which a real window could not make as narrow as a phone."""
        sizes = {"width": width, "height": height, "deviceScaleFactor": 1, "mobile": False}
        self.do("goog/cdp/execute", cmd="Emulation.setDeviceMetricsOverride", params=sizes)

    def run(self, script: str, *arguments: Any) -> Any:
        """What JavaScript returns."""
        return self.do("execute/sync", script=script, args=list(arguments))

    def press(self, *keys: str) -> None:
        """Real key strokes, to whatever has the focus; W3C's private code points for the named ones."""
        strokes = [{"type": kind, "value": key} for key in keys for kind in ("keyDown", "keyUp")]
        self.do("actions", actions=[{"type": "key", "id": "keyboard", "actions": strokes}])

    def click(self, selector: str) -> None:
        """A real click on the first such element."""
        element = self.do("element", using="css selector", value=selector)
        self.do(f"element/{next(iter(element.values()))}/click")

    def complaints(self) -> list[str]:
        """What the console says, since the last time."""
        return [entry["message"] for entry in self.do("se/log", type="browser")]

    def picture(self, path: Path) -> None:
        """Of the whole page."""
        shot = self.do("goog/cdp/execute", cmd="Page.captureScreenshot", params={"captureBeyondViewport": True})
        path.write_bytes(base64.b64decode(shot["data"]))


@contextlib.contextmanager
def browser() -> Iterator[Browser]:
    """A fresh browser with an empty profile; it and its driver are gone afterwards."""
    found = installed()
    assert found is not None, "no Chromium with a driver"
    with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as profile:
        driver = subprocess.Popen([found[1], "--port=0"], stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True)
        assert driver.stdout is not None
        try:
            port = next(m[1] for line in driver.stdout if (m := re.search(r"successfully on port (\d+)", line)))
            window = Browser(f"http://127.0.0.1:{port}", found[0], profile)
            try:
                yield window
            finally:
                window.ask("DELETE", f"/session/{window.session}")
        finally:
            driver.terminate()
            driver.wait(PATIENCE)
            driver.stdout.close()
