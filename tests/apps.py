"""The server of ``igsr app`` for tests, in its own process, and the page in a browser."""

import contextlib
import http.client
import os
import signal
import subprocess
import sys
import time

import numpy as np
import rooms
from browser import Browser
from PIL import Image

#: Text of the page.
TEXT = "(document.body?.innerText ?? '')"


def started(out, *words, variables=None):
    """The process of ``igsr app``, and its address."""
    process = subprocess.Popen(
        [sys.executable, "-m", "igsr.cli", "app", "--out", out, "--no-browser", *words],
        env={**os.environ, **(variables or {})},
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
        # Children of a shell's background jobs ignore Ctrl-C.
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),
    )
    address = process.stdout.readline().strip()
    assert address.startswith("http://"), process.communicate()[1]
    return process, address


@contextlib.contextmanager
def served(out, *words, variables=None):
    """The address of ``igsr app``, which ends without an error."""
    process, address = started(out, "--port", "0", *words, variables=variables)
    try:
        yield address
    finally:
        process.send_signal(signal.SIGINT)
        _, errors = process.communicate(timeout=30)
    assert process.returncode == 0, errors
    assert "Traceback" not in errors, errors


def answered(address, path="/", method="GET", body=None, headers=(), host=None):
    """Status and content of a request, whose path is sent as it is."""
    place = address.removeprefix("http://").rstrip("/")
    connection = http.client.HTTPConnection(place, timeout=60)
    with contextlib.closing(connection):
        connection.putrequest(method, path, skip_host=True)
        connection.putheader("Host", host or place)
        for name, value in headers:
            connection.putheader(name, value)
        if body is not None:
            connection.putheader("Content-Length", str(len(body)))
        connection.endheaders(body)
        response = connection.getresponse()
        return response.status, response.read()


def room_photos(folder, count=5, seed=0):
    """Photos of a room that structure from motion can place."""
    folder.mkdir(parents=True, exist_ok=True)
    files = []
    for number, angle in enumerate(np.linspace(-0.35, 0.35, count)):
        files.append(folder / f"{seed}{number}.png")
        Image.fromarray(rooms.picture(rooms.camera(angle), seed)).save(files[-1])
    return files


class Page(Browser):
    """A tab with the app."""

    def open_app(self, address):
        """Open the page and wait until it is complete."""
        self.load(address)
        self.wait_for(f"{TEXT}.includes('Make the scene') || {TEXT}.includes('New scene')")

    def drop(self, files):
        """Give photos to the page."""
        self.choose_files("input[type=file]", files)

    def press(self, label):
        """Press a button."""
        button = f"[...document.querySelectorAll('button')].find(b => b.innerText == {label!r})"
        self.wait_for(f"!!({button})")
        self.run(f"{button}.click()")

    def wait_for_text(self, *texts, timeout=60.0):
        """Wait until the page has one of the texts, and return all of its text."""
        found = " || ".join(f"{TEXT}.includes({text!r})" for text in texts)
        return self.wait_for(f"({found}) && {TEXT}", timeout)

    def make(self):
        """Press the button that starts a run; return the run's name."""
        self.press("Make the scene")
        return self.opened_run()

    def opened_run(self):
        """The name of the run that the page shows as soon as it does."""
        return self.wait_for("new URLSearchParams(location.search).get('run')")


def until(found, timeout=60.0):
    """Wait until a function returns something true, and return it."""
    end = time.monotonic() + timeout
    while not (value := found()):
        assert time.monotonic() < end, f"not true after {timeout} s"
        time.sleep(0.1)
    return value
