"""A headless Chromium that opens pages as a person's browser does, and tells what went wrong in them.

It is spoken to through a pipe, by its DevTools protocol. It resolves no name but this machine's, so that a page that
wants something from elsewhere fails here.
"""

import base64
import fcntl
import json
import os
import select
import shutil
import subprocess
import time
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

CHROMIUM = next(
    (path for name in ("chromium", "chromium-browser", "google-chrome") if (path := shutil.which(name))), None
)
FLAGS = (
    "--headless",
    "--no-sandbox",
    "--disable-gpu",
    "--no-first-run",
    "--disable-background-networking",
    "--disable-component-update",
    "--disable-dev-shm-usage",
    "--host-resolver-rules=MAP * ~NOTFOUND, EXCLUDE 127.0.0.1",
    "--remote-debugging-pipe",
)


@dataclass
class Page:
    """A page that is open.

    Attributes:
        browser: that shows it.
        session: the protocol's name for it.
        errors: what went wrong so far: uncaught exceptions, errors on the console, what could not be loaded.
        requested: addresses of all that it asked for.
    """

    browser: "Browser"
    session: str
    errors: list[str] = field(default_factory=list)
    requested: list[str] = field(default_factory=list)

    def heard(self, method: str, told: dict[str, Any]) -> None:
        """Keep what an event tells."""
        if method == "Runtime.exceptionThrown":
            details = told["exceptionDetails"]
            self.errors.append(details.get("exception", {}).get("description") or details["text"])
        elif method == "Runtime.consoleAPICalled" and told["type"] in ("error", "assert"):
            self.errors.append(" ".join(str(one.get("value", one.get("description"))) for one in told["args"]))
        elif method == "Log.entryAdded" and told["entry"]["level"] == "error":
            self.errors.append(f"{told['entry']['text']} {told['entry'].get('url', '')}")
        elif method == "Network.loadingFailed" and not told.get("canceled"):
            self.errors.append(f"not loaded: {told['errorText']}")
        elif method == "Network.requestWillBeSent":
            self.requested.append(told["request"]["url"])

    def evaluate(self, expression: str) -> Any:
        """Return what a JavaScript expression is in the page."""
        told = self.browser.call(
            "Runtime.evaluate", self.session, expression=expression, returnByValue=True, awaitPromise=True
        )
        assert "exceptionDetails" not in told, told["exceptionDetails"]
        return told["result"].get("value")

    def wait_until(self, expression: str, longest_s: float = 30.0) -> None:
        """Wait until a JavaScript expression is true."""
        end = time.monotonic() + longest_s
        while not self.evaluate(expression):
            assert time.monotonic() < end, f"never true: {expression}; errors so far: {self.errors}"
            time.sleep(0.05)

    def text(self) -> str:
        """Return the words that are shown, with single spaces."""
        return " ".join(self.evaluate("document.body.innerText").split())

    def elsewhere(self) -> list[str]:
        """Return the addresses it asked for that are not on this machine."""
        local = ("file", "data", "blob", "about")
        return [
            url for url in self.requested if urlsplit(url).scheme not in local and urlsplit(url).hostname != "127.0.0.1"
        ]

    def picture(self, file: Path) -> None:
        """Write what is seen of it as a PNG."""
        file.write_bytes(base64.b64decode(self.browser.call("Page.captureScreenshot", self.session)["data"]))

    def is_wider_than_the_window(self) -> bool:
        """Return whether one would have to scroll to the side."""
        return bool(self.evaluate("document.documentElement.scrollWidth > window.innerWidth + 1"))


class Browser:
    """The process; `with Browser(folder) as browser`, where `folder` takes its profile."""

    def __init__(self, folder: Path) -> None:
        self.pages: dict[str, Page] = {}
        self.calls = 0
        to_browser, ours = os.pipe()
        from_browser, theirs = os.pipe()
        self.writing, self.reading = ours, from_browser
        # It reads from descriptor 3 and writes to 4; copied beyond these, neither end takes the other's place.
        ends = [fcntl.fcntl(end, fcntl.F_DUPFD, 10) for end in (to_browser, theirs)]
        command = 'exec "$@" 3<&{} 4>&{}'.format(*ends)
        arguments = ["bash", "-c", command, "bash", str(CHROMIUM), *FLAGS, f"--user-data-dir={folder}"]
        silent = subprocess.DEVNULL
        self.process = subprocess.Popen(arguments, pass_fds=ends, stdout=silent, stderr=silent)
        for end in (to_browser, theirs, *ends):
            os.close(end)
        self.received = b""

    def __enter__(self) -> "Browser":
        return self

    def __exit__(self, *_: object) -> None:
        self.process.terminate()
        self.process.wait(10)
        os.close(self.writing)
        os.close(self.reading)

    def call(self, method: str, session: str | None = None, **parameters: Any) -> dict[str, Any]:
        """Ask for something, and return the answer; events that come in between are kept by their pages."""
        self.calls += 1
        asked = {"id": self.calls, "method": method, "params": parameters} | ({"sessionId": session} if session else {})
        os.write(self.writing, json.dumps(asked).encode() + b"\0")
        while True:
            told = self._next(60.0)
            if told.get("id") == asked["id"]:
                assert "error" not in told, f"{method}: {told['error']}"
                return dict(told["result"])
            self._keep(told)

    def listen(self, longest_s: float) -> None:
        """Take in events for a while."""
        end = time.monotonic() + longest_s
        while (left := end - time.monotonic()) > 0:
            if not select.select([self.reading], [], [], left)[0] and b"\0" not in self.received:
                return
            self._keep(self._next(left))

    def _keep(self, told: dict[str, Any]) -> None:
        if page := self.pages.get(told.get("sessionId", "")):
            page.heard(told["method"], told["params"])

    def _next(self, longest_s: float) -> dict[str, Any]:
        while b"\0" not in self.received:
            assert select.select([self.reading], [], [], longest_s)[0], "the browser does not answer"
            came = os.read(self.reading, 1 << 20)
            assert came, "the browser has ended"
            self.received += came
        message, _, self.received = self.received.partition(b"\0")
        return dict(json.loads(message))

    def open(self, address: str | Path, width: int = 1280, height: int = 900) -> Page:
        """Open an address, or a file, in a window of so many pixels; return the page once it is loaded."""
        url = address.resolve().as_uri() if isinstance(address, Path) else address
        target = self.call("Target.createTarget", url="about:blank")["targetId"]
        session = self.call("Target.attachToTarget", targetId=target, flatten=True)["sessionId"]
        page = self.pages[session] = Page(self, session)
        for domain in ("Page", "Runtime", "Log", "Network"):
            self.call(f"{domain}.enable", session)
        metrics = {"width": width, "height": height, "deviceScaleFactor": 1, "mobile": False}
        self.call("Emulation.setDeviceMetricsOverride", session, **metrics)
        self.call("Page.navigate", session, url=url)
        page.wait_until("document.readyState === 'complete' && location.href !== 'about:blank'")
        self.listen(0.2)
        return page
