"""A headless browser that tests steer: the DevTools protocol over a pipe, without a library."""

import base64
import contextlib
import json
import os
import select
import shutil
import subprocess
import time
from pathlib import Path

NAMES = ("chromium", "chromium-browser", "google-chrome", "chrome")
#: WebGL without a GPU.
FLAGS = (
    "--headless",
    "--no-sandbox",
    "--use-angle=swiftshader",
    "--enable-unsafe-swiftshader",
    "--hide-scrollbars",
    "--force-device-scale-factor=1",
    "--disable-extensions",
    "--no-first-run",
    "--remote-debugging-pipe",
)


class Browser:
    """One page of a browser.

    Attributes:
        problems: errors and warnings of the page's console, and exceptions, as text.
        requests: addresses that the page asked for.
    """

    def __init__(self, profile, size=(640, 480)):
        program = next((name for name in NAMES if shutil.which(name)), None)
        assert program, "no browser to open the page with: install chromium, as make test does"
        to_browser, self._write = os.pipe()
        self._read, from_browser = os.pipe()
        command = [program, *FLAGS, f"--user-data-dir={profile}"]
        command += [f"--window-size={size[0]},{size[1]}", "about:blank"]
        # The browser reads file 3 and writes file 4; the pipes' own numbers may be these.
        shell = f'exec "$@" 3<&{to_browser} 4>&{from_browser}'
        self._process = subprocess.Popen(
            ["bash", "-c", shell, "browser", *command],
            pass_fds=(to_browser, from_browser),
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
        )
        os.close(to_browser)
        os.close(from_browser)
        self._number = 0
        self._buffer = b""
        self._session = None
        self.problems = []
        self.requests = []
        self._loaded = False
        found = self._ask("Target.getTargets")["targetInfos"]
        target = next(one["targetId"] for one in found if one["type"] == "page")
        attached = self._ask("Target.attachToTarget", targetId=target, flatten=True)
        self._session = attached["sessionId"]
        for domain in ("Page", "Runtime", "Log", "Network"):
            self._ask(f"{domain}.enable")
        lens = {"width": size[0], "height": size[1], "deviceScaleFactor": 1, "mobile": False}
        self._ask("Emulation.setDeviceMetricsOverride", **lens)

    def __enter__(self):
        return self

    def __exit__(self, *_):
        with contextlib.suppress(OSError):
            os.close(self._write)
        os.close(self._read)
        self._process.terminate()
        try:
            self._process.wait(20)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()

    def open(self, page, timeout=60.0):
        """Open a file or an address, and wait until its script has started or failed."""
        self.load(page, timeout)
        self.run("window.igsr.ready.then(() => true)", timeout)

    def leave(self):
        """Leave the page: one that asks a server would go on with it."""
        self._load("about:blank", 60.0)

    def load(self, page, timeout=60.0):
        """Open a file or an address, of any page, and wait until it has loaded."""
        self.problems.clear()
        self.requests.clear()
        self._load(page.as_uri() if isinstance(page, Path) else page, timeout)

    def _load(self, address, timeout):
        self._loaded = False
        self._ask("Page.navigate", url=address)
        end = time.monotonic() + timeout
        while not self._loaded:
            self._receive(end)

    def run(self, expression, timeout=60.0):
        """The value of JavaScript; a promise is waited for."""
        options = {"expression": expression, "awaitPromise": True, "returnByValue": True}
        answer = self._ask("Runtime.evaluate", timeout, **options)
        assert "exceptionDetails" not in answer, answer["exceptionDetails"]
        return answer["result"].get("value")

    def mouse(self, kind, x, y, **more):
        """A mouse event, such as "mousePressed"."""
        self._ask("Input.dispatchMouseEvent", type=kind, x=x, y=y, **more)

    def drag(self, start, end, button):
        """A drag with the "left" or "right" mouse button."""
        buttons = {"left": 1, "right": 2}[button]
        self.mouse("mousePressed", *start, button=button, buttons=buttons, clickCount=1)
        self.mouse("mouseMoved", *end, button=button, buttons=buttons)
        self.mouse("mouseReleased", *end, button=button)

    def touch(self, kind, points):
        """A touch event, such as "touchStart", with the fingers that are down."""
        fingers = [{"x": x, "y": y, "id": k} for k, (x, y) in enumerate(points)]
        self._ask("Input.dispatchTouchEvent", type=kind, touchPoints=fingers)

    def key(self, key, code, kind="keyDown"):
        """A key goes down, or up with ``kind`` "keyUp"."""
        self._ask("Input.dispatchKeyEvent", type=kind, key=key, code=code)

    def wait_for(self, expression, timeout=60.0):
        """Wait until JavaScript gives a true value, and return it."""
        end = time.monotonic() + timeout
        while not (value := self.run(expression)):
            assert time.monotonic() < end, f"not true after {timeout} s: {expression}"
            time.sleep(0.1)
        return value

    def choose_files(self, selector, paths):
        """Give files to an input of the page."""
        root = self._ask("DOM.getDocument", depth=0)["root"]["nodeId"]
        found = self._ask("DOM.querySelector", nodeId=root, selector=selector)["nodeId"]
        self._ask("DOM.setFileInputFiles", nodeId=found, files=[str(path) for path in paths])

    def screenshot(self, path):
        """Save a screenshot of the page as PNG."""
        path.write_bytes(base64.b64decode(self._ask("Page.captureScreenshot")["data"]))

    def _ask(self, method, timeout=60.0, **parameters):
        self._number += 1
        number = self._number
        message = {"id": number, "method": method, "params": parameters}
        if self._session is not None:
            message["sessionId"] = self._session
        os.write(self._write, json.dumps(message).encode() + b"\0")
        end = time.monotonic() + timeout
        while True:
            answer = self._receive(end)
            if answer.get("id") == number:
                assert "error" not in answer, answer["error"]
                return dict(answer["result"])

    def _receive(self, end):
        while b"\0" not in self._buffer:
            ready, _, _ = select.select([self._read], [], [], max(0.0, end - time.monotonic()))
            assert ready, "the browser does not answer"
            piece = os.read(self._read, 1 << 20)
            assert piece, "the browser has ended"
            self._buffer += piece
        text, self._buffer = self._buffer.split(b"\0", 1)
        message = json.loads(text)
        self._note(message.get("method"), message.get("params", {}))
        return message

    def _note(self, method, said):
        if method == "Runtime.exceptionThrown":
            self.problems.append(str(said["exceptionDetails"]))
        elif method == "Runtime.consoleAPICalled" and said["type"] in ("error", "warning"):
            self.problems.append(str(said["args"]))
        elif method == "Log.entryAdded" and said["entry"]["level"] in ("error", "warning"):
            self.problems.append(said["entry"]["text"])
        elif method == "Network.requestWillBeSent":
            self.requests.append(said["request"]["url"])
        elif method == "Page.loadEventFired":
            self._loaded = True
