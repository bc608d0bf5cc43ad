"""What a web page says, read in a headless Chromium over its debugging protocol."""

import json
import shutil
import subprocess
import time
import urllib.request
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from websockets.sync.client import connect
from websockets.sync.connection import Connection

NAMES = ("chromium", "chromium-browser", "google-chrome")
OPTIONS = (
    "--headless=new", "--no-sandbox", "--disable-gpu", "--enable-unsafe-swiftshader", "--disable-dev-shm-usage",
    "--no-first-run", "--remote-debugging-port=0", "--window-size=1280,800",
)  # fmt: skip
PATIENCE = 90.0
"""Time for anything to appear [s]."""
LARGEST = 1 << 26
"""Longest message of the browser [bytes]."""


def find_browser() -> str | None:
    """Path of a Chromium, if there is one."""
    return next((path for name in NAMES if (path := shutil.which(name))), None)


@contextmanager
def open_page(browser: str, url: str, profile: Path) -> Iterator["Page"]:
    """A page in a new browser with an empty profile."""
    command = [browser, *OPTIONS, f"--user-data-dir={profile}", url]
    process = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    try:
        port = until(lambda: _first_line(profile / "DevToolsActivePort"))
        targets = until(lambda: _pages(port))
        with connect(targets[0], max_size=LARGEST, compression=None) as connection:
            yield Page(connection)
    finally:
        process.terminate()
        process.wait()


class Page:
    """An open page."""

    def __init__(self, connection: Connection) -> None:
        self._connection, self._number = connection, 0

    def call(self, method: str, **parameters: Any) -> dict[str, Any]:
        """Result of a command of the debugging protocol."""
        self._number += 1
        self._connection.send(json.dumps({"id": self._number, "method": method, "params": parameters}))
        while (answer := json.loads(self._connection.recv(PATIENCE))).get("id") != self._number:
            pass
        return answer["result"]

    def evaluate(self, script: str) -> Any:
        """Value of a JavaScript expression."""
        return self.call("Runtime.evaluate", expression=script, returnByValue=True)["result"].get("value")

    def text(self) -> str:
        """All visible text."""
        return self.evaluate("document.body ? document.body.innerText : ''") or ""

    def press(self, label: str) -> None:
        """Clicks the button with this label, once it is there."""
        find = f"[...document.querySelectorAll('button')].find(b => b.innerText.trim() === {json.dumps(label)})"
        until(lambda: self.evaluate(f"!!{find}"))
        self.evaluate(f"{find}.click()")

    def wait_for(self, words: str, patience: float = PATIENCE) -> str:
        """The text once it has these words, which it has within so many seconds."""
        return until(lambda: text if words in (text := self.text()) else None, patience)


def until(found: Any, patience: float = PATIENCE) -> Any:
    """The first true value that `found` returns; AssertionError if there is none for so many seconds."""
    end = time.monotonic() + patience
    while time.monotonic() < end:
        if value := found():
            return value
        time.sleep(0.1)
    raise AssertionError("nothing appeared")


def _first_line(path: Path) -> str:
    return path.read_text().partition("\n")[0] if path.is_file() else ""


def _pages(port: str) -> list[str]:
    with urllib.request.urlopen(f"http://127.0.0.1:{port}/json/list") as answer:
        return [target["webSocketDebuggerUrl"] for target in json.load(answer) if target["type"] == "page"]
