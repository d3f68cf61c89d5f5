"""Debian's Chromium, headless, spoken to through its debugging pipe: just what a test of a page needs."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import time
from base64 import b64decode
from contextlib import suppress
from pathlib import Path

FLAGS = (
    "--headless",
    "--no-sandbox",
    "--no-first-run",
    "--disable-background-networking",
    "--disable-component-update",
    "--disable-sync",
    "--window-size=1280,1400",
    "--remote-debugging-pipe",
)
# What draws: Chromium's own SwiftShader, or Mesa's llvmpipe, which is what the product's renderer runs on where there
# is no graphics card.
SWIFTSHADER = ("--disable-gpu",)
MESA = ("--use-gl=angle", "--use-angle=gl-egl", "--ignore-gpu-blocklist")
# What a browser answers to a script whose page is just being left: for whoever waits, as good as "not yet".
LEAVING = ("navigated or closed", "Execution context was destroyed", "Cannot find context")


class Left(AssertionError):
    """The page was left while a script ran in it."""


def chromium_path() -> str | None:
    return shutil.which("chromium")


class Page:
    """One page of a browser of its own, drawn by SWIFTSHADER or MESA."""

    def __init__(self, profile: Path, drawn_by: tuple[str, ...] = SWIFTSHADER) -> None:
        to_read, self._write = os.pipe()
        self._read, to_write = os.pipe()

        def as_three_and_four() -> None:
            low, high = os.dup(to_read), os.dup(to_write)
            os.dup2(low, 3)
            os.dup2(high, 4)
            os.set_inheritable(3, True)
            os.set_inheritable(4, True)

        self._process = subprocess.Popen(
            [chromium_path(), *FLAGS, *drawn_by, f"--user-data-dir={profile}", "about:blank"],
            env=os.environ | {"EGL_PLATFORM": "surfaceless"},
            preexec_fn=as_three_and_four,
            close_fds=False,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
        )
        os.close(to_read), os.close(to_write)
        self._buffer, self._id, self._session = b"", 0, None
        self.complaints: list[str] = []
        self.requests: list[dict] = []
        targets = self.call("Target.getTargets")["targetInfos"]
        page = next(t["targetId"] for t in targets if t["type"] == "page")
        self._session = self.call("Target.attachToTarget", targetId=page, flatten=True)["sessionId"]
        for domain in ("Page", "Runtime", "DOM", "Log", "Network"):
            self.call(f"{domain}.enable")

    def call(self, method: str, **parameters) -> dict:
        self._id += 1
        message = {"id": self._id, "method": method, "params": parameters}
        os.write(
            self._write, json.dumps(message | ({"sessionId": self._session} if self._session else {})).encode() + b"\0"
        )
        while (answer := self._message()).get("id") != self._id:
            self._listen(answer)
        if "error" in answer:
            left = any(words in answer["error"]["message"] for words in LEAVING)
            raise (Left if left else AssertionError)(f"{method}: {answer['error']}")
        return answer["result"]

    def _message(self) -> dict:
        while b"\0" not in self._buffer:
            block = os.read(self._read, 1 << 20)
            if not block:
                raise AssertionError("the browser ended")
            self._buffer += block
        text, _, self._buffer = self._buffer.partition(b"\0")
        return json.loads(text)

    def _listen(self, message: dict) -> None:
        """Errors of scripts, what a policy blocked, and hosts that were asked."""
        parameters = message.get("params", {})
        if message.get("method") == "Runtime.exceptionThrown":
            self.complaints.append(json.dumps(parameters["exceptionDetails"])[:500])
        if message.get("method") == "Log.entryAdded" and parameters["entry"]["level"] == "error":
            self.complaints.append(parameters["entry"]["text"] + " " + parameters["entry"].get("url", ""))
        if message.get("method") == "Network.requestWillBeSent":
            self.requests.append(parameters["request"])
            url = parameters["request"]["url"]
            if not url.startswith(("http://127.0.0.1:", "data:", "blob:", "about:")):
                self.complaints.append(f"asked {url}")

    def open(self, url: str) -> None:
        self.call("Page.navigate", url=url)

    def look(self, script: str):
        """The value of a JavaScript expression; None where it fails."""
        return self.call("Runtime.evaluate", expression=script, awaitPromise=True, returnByValue=True)["result"].get(
            "value"
        )

    def until(self, script: str, seconds: float = 300.0):
        """The value of an expression as soon as it is true, on this page or on that which follows it."""
        deadline = time.monotonic() + seconds
        while time.monotonic() < deadline:
            with suppress(Left):
                if found := self.look(script):
                    return found
            time.sleep(0.2)
        raise AssertionError(
            f"not within {seconds:g} s: {script}; {self.complaints}; page: {self.look('document.body.innerText')}"
        )

    def choose_file(self, selector: str, path: Path) -> None:
        root = self.call("DOM.getDocument")["root"]["nodeId"]
        node = self.call("DOM.querySelector", nodeId=root, selector=selector)["nodeId"]
        self.call("DOM.setFileInputFiles", nodeId=node, files=[str(path)])

    def picture(self, path: Path) -> None:
        path.write_bytes(b64decode(self.call("Page.captureScreenshot", captureBeyondViewport=True)["data"]))

    def close(self) -> None:
        self._process.terminate()
        try:
            self._process.wait(10)
        except subprocess.TimeoutExpired:
            self._process.kill()
        os.close(self._read), os.close(self._write)
