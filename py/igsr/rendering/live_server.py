"""The HTTP server of ``igsr view --web``, on Python's own ``http.server``.

It answers five kinds of GET requests; their names are never used as paths.
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
from igsr.rendering.live_view import LiveView

logger = logging.getLogger(__name__)

#: The default port, and how many to try if it is taken.
PORT = 8765
PORTS_TO_TRY = 20
MAX_CONCURRENT_REQUESTS = 64
#: Further requests are dropped after this time.
QUEUE_TIMEOUT_S = 10.0
#: Silent clients are dropped after this time.
CLIENT_TIMEOUT_S = 30.0
CHUNK_BYTES = 1 << 16


def is_loopback(host: str) -> bool:
    """Return whether other computers cannot reach an address."""
    try:
        return host == "localhost" or ipaddress.ip_address(host).is_loopback
    except ValueError:
        return False


class ViewServer(ThreadingHTTPServer):
    """A server that answers requests whose path begins with its token."""

    daemon_threads = True
    # The default backlog of 5 drops requests of a browser under load.
    request_queue_size = 128
    # On Windows this would share a port with another program.
    allow_reuse_address = sys.platform != "win32"

    def __init__(self, view: LiveView, host: str, port: int) -> None:
        self.view = view
        self.token = secrets.token_urlsafe(16)
        self._slots = threading.BoundedSemaphore(MAX_CONCURRENT_REQUESTS)
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
        """Bind without looking up the host's full name, which may take seconds."""
        socketserver.TCPServer.server_bind(self)
        self.server_name, self.server_port = str(self.server_address[0]), self.server_address[1]

    def process_request(self, request: object, client_address: object) -> None:
        """Answer in a new thread, as soon as fewer than the maximum are running."""
        if not self._slots.acquire(timeout=QUEUE_TIMEOUT_S):
            self.shutdown_request(request)  # type: ignore[arg-type]
            return
        try:
            super().process_request(request, client_address)  # type: ignore[arg-type]
        except RuntimeError:  # no thread can be started
            self._slots.release()
            raise

    def process_request_thread(self, request: object, client_address: object) -> None:
        """Answer, and free the slot."""
        try:
            super().process_request_thread(request, client_address)  # type: ignore[arg-type]
        finally:
            self._slots.release()

    def handle_error(self, request: object, client_address: object) -> None:
        """Log an error, unless a browser disconnected."""
        if not isinstance(sys.exc_info()[1], (ConnectionError, TimeoutError)):
            logger.exception("a request failed")


class _Handler(BaseHTTPRequestHandler):
    """Answers one request, over HTTP/1.0: connections are not kept open."""

    timeout = CLIENT_TIMEOUT_S
    server: ViewServer
    server_version, sys_version = "igsr", ""

    def do_GET(self) -> None:
        """Answer a request if it has the token."""
        path, _, query = self.path.partition("?")
        token, slash, name = path.removeprefix("/").partition("/")
        if not hmac.compare_digest(token.encode(), self.server.token.encode()):
            message = "This address has no token or an old one; use the one that igsr view printed."
            self._answer_text(HTTPStatus.FORBIDDEN, message)
        elif not slash:
            self.send_response(HTTPStatus.MOVED_PERMANENTLY)
            self.send_header("Location", f"/{self.server.token}/")
            self.send_header("Content-Length", "0")
            self.end_headers()
        else:
            query_values = {key: values[-1] for key, values in parse_qs(query).items()}
            self._answer_name(name, query_values)

    def log_message(self, *_: object) -> None:
        """Log nothing, since addresses contain the token."""

    def _answer_name(self, name: str, query: dict[str, str]) -> None:
        view = self.server.view
        try:
            if name == "":
                page = view.page().encode("utf-8", errors="xmlcharrefreplace")
                self._answer("text/html; charset=utf-8", page)
            elif name == "state":
                self._answer_json(view.state())
            elif name == "surroundings":
                self._answer_json(view.surroundings())
            elif name == "model":
                self._answer("application/octet-stream", view.model(query["id"]))
            elif name == "photo" and query["number"].isdecimal():
                self._answer("image/jpeg", view.photo(int(query["number"])))
            else:
                raise KeyError(name)
        except IgsrError as error:
            self._answer_text(HTTPStatus.UNPROCESSABLE_ENTITY, str(error))
        except KeyError:
            self._answer_text(HTTPStatus.NOT_FOUND, "This address does not exist.")

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
        # The address contains the token.
        self.send_header("Referrer-Policy", "no-referrer")
        self.send_header("Cross-Origin-Resource-Policy", "same-origin")
        self.end_headers()
        # In chunks, since the timeout applies to each write.
        for start in range(0, len(content), CHUNK_BYTES):
            self.wfile.write(content[start : start + CHUNK_BYTES])


def open_server(view: LiveView, host: str, port: int | None) -> ViewServer:
    """Open a server; ``serve_forever`` answers requests.

    Args:
        view: answers the requests.
        host: address of this computer to listen at.
        port: None takes ``PORT``, or the next free one.
    """
    ports = range(PORT, PORT + PORTS_TO_TRY) if port is None else (port,)
    for number in ports:
        try:
            return ViewServer(view, host, number)
        except OSError as error:
            reason = error.strerror or str(error)
    raise IgsrError(
        f"Cannot listen at {host}, port {ports[0]} ({reason}); name another with --host or --port."
    )
