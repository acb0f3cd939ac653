"""The server of ``igsr view --web``.

It is Python's own ``http.server``: a page and four kinds of answers to GET, whose names never reach
a file system, need no more, and nothing has to be installed.
"""

from __future__ import annotations

import hmac
import ipaddress
import json
import logging
import secrets
import socket
import socketserver
import sys
import threading
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from urllib.parse import parse_qs

from igsr.errors import IgsrError
from igsr.viewing.shown import Shown

logger = logging.getLogger(__name__)

#: The usual port; if it is taken, one of the next.
PORT = 8765
NEXT_PORTS = 20
#: Requests that are answered at once, and how long one more waits for its turn, seconds.
MOST_AT_ONCE = 64
WAIT = 10.0
#: A client that is silent for so long has gone, seconds.
SILENCE = 30.0
#: Bytes that are sent at once.
PIECE = 1 << 16


def is_own(host: str) -> bool:
    """Whether an address is one that other computers cannot reach."""
    try:
        return host == "localhost" or ipaddress.ip_address(host).is_loopback
    except ValueError:
        return False


class ViewServer(ThreadingHTTPServer):
    """Answers who has the token.

    Attributes:
        shown: what is shown.
        token: the first part of every address.
    """

    daemon_threads = True
    # A browser asks for much at once; five, the default, would be turned away under load.
    request_queue_size = 128
    # Another program's port is not to be shared with it.
    allow_reuse_address = sys.platform != "win32"

    def __init__(self, shown: Shown, host: str, port: int) -> None:
        """Listen.

        Raises:
            OSError: the port is taken, or the host is none of this computer's addresses.
        """
        self.shown = shown
        self.token = secrets.token_urlsafe(16)
        self._turns = threading.BoundedSemaphore(MOST_AT_ONCE)
        if ":" in host:
            self.address_family = socket.AF_INET6
        super().__init__((host, port), _Handler)

    @property
    def url(self) -> str:
        """The address of the page."""
        host, port = str(self.server_address[0]), self.server_address[1]
        if host in ("0.0.0.0", "::"):
            host = socket.gethostname()
        return f"http://{f'[{host}]' if ':' in host else host}:{port}/{self.token}/"

    def server_bind(self) -> None:
        """Bind without asking for this computer's full name, which may take seconds."""
        socketserver.TCPServer.server_bind(self)
        self.server_name, self.server_port = str(self.server_address[0]), self.server_address[1]

    def process_request(self, request: object, client_address: object) -> None:
        """Answer in a thread of its own, when it is its turn."""
        if not self._turns.acquire(timeout=WAIT):
            self.shutdown_request(request)  # type: ignore[arg-type]
            return
        try:
            super().process_request(request, client_address)  # type: ignore[arg-type]
        except RuntimeError:  # there is no thread to be had
            self._turns.release()
            raise

    def process_request_thread(self, request: object, client_address: object) -> None:
        """Answer, and let another have its turn."""
        try:
            super().process_request_thread(request, client_address)  # type: ignore[arg-type]
        finally:
            self._turns.release()

    def handle_error(self, request: object, client_address: object) -> None:
        """A browser that went away is no error."""
        if not isinstance(sys.exc_info()[1], (ConnectionError, TimeoutError)):
            logger.exception("a request failed")


class _Handler(BaseHTTPRequestHandler):
    """Answers one request. It speaks HTTP/1.0: no connection stays open between two of them."""

    timeout = SILENCE
    server: ViewServer
    server_version, sys_version = "igsr", ""

    def do_GET(self) -> None:
        """Answer a request that has the token; refuse any other."""
        path, _, query = self.path.partition("?")
        token, slash, name = path.removeprefix("/").partition("/")
        if not hmac.compare_digest(token.encode(), self.server.token.encode()):
            message = "This address has no token, or an old one; igsr view printed the right one."
            self._answer_text(HTTPStatus.FORBIDDEN, message)
        elif not slash:
            self.send_response(HTTPStatus.MOVED_PERMANENTLY)
            self.send_header("Location", f"/{self.server.token}/")
            self.send_header("Content-Length", "0")
            self.end_headers()
        else:
            self._answer_name(name, {key: one[-1] for key, one in parse_qs(query).items()})

    def log_message(self, *_: object) -> None:
        """Log nothing: addresses have the token."""

    def _answer_name(self, name: str, asked: dict[str, str]) -> None:
        shown = self.server.shown
        try:
            if name == "":
                page = shown.page().encode("utf-8", errors="xmlcharrefreplace")
                self._answer("text/html; charset=utf-8", page)
            elif name == "state":
                self._answer_json(shown.state())
            elif name == "surroundings":
                self._answer_json(shown.surroundings())
            elif name == "model":
                self._answer("application/octet-stream", shown.model(asked["id"]))
            elif name == "photo" and asked["number"].isdecimal():
                self._answer("image/jpeg", shown.photo(int(asked["number"])))
            else:
                raise KeyError(name)
        except IgsrError as error:
            self._answer_text(HTTPStatus.UNPROCESSABLE_ENTITY, str(error))
        except KeyError:
            self._answer_text(HTTPStatus.NOT_FOUND, "There is no such thing here.")

    def _answer_json(self, value: object) -> None:
        self._answer("application/json", json.dumps(value, allow_nan=False).encode())

    def _answer_text(self, status: HTTPStatus, message: str) -> None:
        content = message.encode("utf-8", errors="replace")
        self._answer("text/plain; charset=utf-8", content, status)

    def _answer(self, kind: str, content: bytes, status: HTTPStatus = HTTPStatus.OK) -> None:
        self.send_response(status)
        self.send_header("Content-Type", kind)
        self.send_header("Content-Length", str(len(content)))
        self.send_header("Cache-Control", "no-store")
        self.send_header("X-Content-Type-Options", "nosniff")
        # The address has the token.
        self.send_header("Referrer-Policy", "no-referrer")
        self.send_header("Cross-Origin-Resource-Policy", "same-origin")
        self.end_headers()
        # In pieces: the time-out is that of a piece, and a large model may take long.
        for start in range(0, len(content), PIECE):
            self.wfile.write(content[start : start + PIECE])


def open_server(shown: Shown, host: str, port: int | None) -> ViewServer:
    """A server that listens, and answers once ``serve_forever`` is called.

    Args:
        shown: what is shown.
        host: address of this computer to listen at.
        port: None takes ``PORT``, or the next one that is free.

    Raises:
        IgsrError: the port is taken, or the address is none of this computer's.
    """
    ports = range(PORT, PORT + NEXT_PORTS) if port is None else (port,)
    for number in ports:
        try:
            return ViewServer(shown, host, number)
        except OSError as error:
            reason = error.strerror or str(error)
    raise IgsrError(
        f"Cannot listen at {host}, port {ports[0]} ({reason}); name another with --host or --port."
    )
