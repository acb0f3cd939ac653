"""The server of ``igsr view --web`` for tests, and requests to it."""

import contextlib
import http.client
import json
import signal
import socket
import subprocess
import sys
import threading
import urllib.request

from igsr.rendering.live_server import open_server
from igsr.rendering.live_view import LiveView


@contextlib.contextmanager
def served(*paths):
    """A server of paths, at a port that is free."""
    with open_server(LiveView(paths, None), "127.0.0.1", 0) as server:
        # It looks ten times as often as usual whether it shall end.
        thread = threading.Thread(target=server.serve_forever, args=(0.05,))
        thread.start()
        try:
            yield server
        finally:
            server.shutdown()
            thread.join()


def asked(server, target):
    """Request an address as it is, without normalization; return status and content."""
    with socket.create_connection(("127.0.0.1", server.server_port), timeout=30) as connection:
        connection.sendall(f"GET {target} HTTP/1.0\r\n\r\n".encode())
        answer = http.client.HTTPResponse(connection)
        answer.begin()
        return answer.status, answer.read()


def with_token(server, name):
    return asked(server, f"/{server.token}/{name}")


def state_of(server):
    status, content = with_token(server, "state")
    assert status == 200, content
    return json.loads(content)


def started_view(folder, variables, *words, program=(sys.executable, "-m", "igsr.cli")):
    """The process of ``igsr view``."""
    return subprocess.Popen(
        [*program, "view", *map(str, words)],
        cwd=folder,
        env=variables,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        # Children of a shell's background jobs ignore Ctrl-C.
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),
    )


def view_until_ctrl_c(*started, **options):
    """Start the browser view, read its state, and stop it; its address, state, status, stderr."""
    process = started_view(*started, **options)
    try:
        url = process.stdout.readline().strip()
        here = url.replace("0.0.0.0", "127.0.0.1")
        with urllib.request.urlopen(f"{here}state", timeout=30) as answer:
            state = json.load(answer)
    finally:
        process.send_signal(signal.SIGINT)
        _, errors = process.communicate(timeout=30)
    return url, state, process.returncode, errors
