"""The server of ``igsr view --web`` for tests, and requests to it."""

import contextlib
import http.client
import json
import signal
import socket
import subprocess
import threading
import urllib.request

from igsr.rendering.live_server import open_server
from igsr.rendering.live_view import LiveView


@contextlib.contextmanager
def served(*paths, cameras=None):
    """A server of paths, at a port that is free."""
    with open_server(LiveView(paths, cameras), "127.0.0.1", 0) as server:
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


def view_until_ctrl_c(command, folder, variables):
    """Start the browser view by a command, read its state, and stop it with Ctrl-C.

    Returns:
        The state, the exit status and stderr.
    """
    process = subprocess.Popen(
        command,
        cwd=folder,
        env=variables,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),
    )
    try:
        url = process.stdout.readline().strip()
        with urllib.request.urlopen(f"{url}state", timeout=30) as answer:
            state = json.load(answer)
    finally:
        process.send_signal(signal.SIGINT)
        _, errors = process.communicate(timeout=30)
    return state, process.returncode, errors
