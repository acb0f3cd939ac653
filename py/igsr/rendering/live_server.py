"""The HTTP server of ``igsr view --web``, on Python's own ``http.server``.

It answers five kinds of GET requests; their names are never used as paths.
"""

from __future__ import annotations

import contextlib
import hmac
import io
import ipaddress
import json
import logging
import secrets
import socket
import socketserver
import sys
import threading
import time
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import Any, TypeVar
from urllib.parse import parse_qs

from igsr.errors import IgsrError
from igsr.rendering.live_view import LiveView

logger = logging.getLogger(__name__)

T = TypeVar("T")

#: The default port, and how many to try if it is taken.
PORT = 8765
PORTS_TO_TRY = 20
#: Maximum numbers of connections, each with a thread: without the token, and with it. For a
#: further one, an older one of its kind is closed.
MAX_WITHOUT_TOKEN = 64
MAX_WITH_TOKEN = 128
#: Time to receive a whole request, and to send a whole answer: more for a large one, such that
#: lines of this rate are fast enough.
REQUEST_TIMEOUT_S = 10.0
ANSWER_TIMEOUT_S = 300.0
SLOWEST_BYTES_PER_S = 1e5
MAX_REQUEST_BYTES = 1 << 14
#: Memory of the system for an answer that is being sent: several MB unless it is limited.
SEND_BUFFER_BYTES = 1 << 18


def is_loopback(host: str) -> bool:
    """Return whether other computers cannot reach an address."""
    try:
        return host == "localhost" or ipaddress.ip_address(host).is_loopback
    except ValueError:
        return False


@dataclass
class _Connection:
    request: Any  # its socket
    address: str
    has_token: bool = False
    is_closed: bool = False

    def close(self) -> None:
        """End the waiting of its thread, which closes the socket."""
        self.is_closed = True
        with contextlib.suppress(OSError):  # the client was faster
            self.request.shutdown(socket.SHUT_RDWR)


class ViewServer(ThreadingHTTPServer):
    """A server that answers requests whose path begins with its token."""

    daemon_threads = True
    # A client that finds the backlog full tries again only after a second.
    request_queue_size = 1024
    # On Windows this would share a port with another program.
    allow_reuse_address = sys.platform != "win32"

    def __init__(self, view: LiveView, host: str, port: int) -> None:
        self.view = view
        self.token = secrets.token_urlsafe(16)
        self._connections: dict[object, _Connection] = {}  # by socket, the oldest first
        self._lock = threading.Lock()
        # By whether they have the token.
        self._room = {kind: threading.Condition(self._lock) for kind in (False, True)}
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

    def process_request(self, request: Any, client_address: Any) -> None:
        """Answer in a new thread."""
        connection = _Connection(request, client_address[0])
        with self._lock:
            self._make_room(connection)
            self._connections[request] = connection
        try:
            super().process_request(request, client_address)
        except RuntimeError:  # no thread can be started
            self._forget(request)
            raise

    def process_request_thread(self, request: Any, client_address: Any) -> None:
        """Answer, and make room for another connection."""
        try:
            super().process_request_thread(request, client_address)
        finally:
            self._forget(request)

    def accept_token(self, request: object) -> None:
        """Count a connection as one with the token."""
        with self._lock:
            connection = self._connections[request]
            self._make_room(connection, has_token=True)
            connection.has_token = True
            self._room[False].notify()

    def is_open(self, request: object) -> bool:
        """Return whether a connection is open for its answer."""
        return not self._connections[request].is_closed

    def _forget(self, request: object) -> None:
        with self._lock:
            self._room[self._connections.pop(request).has_token].notify()

    def _make_room(self, connection: _Connection, has_token: bool = False) -> None:
        """Without room, close the oldest connection of the address that has most.

        Raises:
            ConnectionError: ``connection`` was closed meanwhile, for others.
        """
        most = MAX_WITH_TOKEN if has_token else MAX_WITHOUT_TOKEN
        has_changed = False
        while not connection.is_closed:
            kind = [one for one in self._connections.values() if one.has_token == has_token]
            if len(kind) < most:
                return
            still_open = [one for one in kind if not one.is_closed]
            if still_open and not has_changed:
                held = Counter(one.address for one in still_open)
                max(still_open, key=lambda one: held[one.address]).close()
            has_changed = self._room[has_token].wait(timeout=0.1)
        raise ConnectionError

    def handle_error(self, request: object, client_address: object) -> None:
        """Log an error, unless a browser disconnected."""
        if not isinstance(sys.exc_info()[1], (ConnectionError, TimeoutError)):
            logger.exception("a request failed")


def answer(
    view: LiveView, name: str, query: dict[str, str], is_open: Callable[[], bool]
) -> tuple[str, bytes, HTTPStatus]:
    """Answer a request of the page.

    Args:
        view: what the page shows.
        name: "" for the page, "state", "surroundings", "model" or "photo".
        query: "id" of a model, "number" of a photo.
        is_open: whether the client still waits.

    Returns:
        Content type, content and status.
    """
    try:
        if name == "":
            page = view.page().encode("utf-8", errors="xmlcharrefreplace")
            return "text/html; charset=utf-8", page, HTTPStatus.OK
        if name == "state":
            state = json.dumps(view.state(), allow_nan=False).encode()
            return "application/json", state, HTTPStatus.OK
        if name == "surroundings":
            return "application/json", view.surroundings(), HTTPStatus.OK
        if name == "model":
            return "application/octet-stream", view.model(query["id"], is_open), HTTPStatus.OK
        if name == "photo" and query["number"].isdecimal():
            return "image/jpeg", view.photo(int(query["number"]), is_open), HTTPStatus.OK
        raise KeyError(name)
    except IgsrError as error:
        return _text(HTTPStatus.UNPROCESSABLE_ENTITY, str(error))
    except (KeyError, ValueError):  # int() refuses thousands of digits
        return _text(HTTPStatus.NOT_FOUND, "This address does not exist.")


def _text(status: HTTPStatus, message: str) -> tuple[str, bytes, HTTPStatus]:
    return "text/plain; charset=utf-8", message.encode("utf-8", errors="replace"), status


class _Handler(BaseHTTPRequestHandler):
    """Answers one request, over HTTP/1.0: connections are not kept open."""

    server: ViewServer
    server_version, sys_version = "igsr", ""

    def setup(self) -> None:
        """Receive the whole request: the base class limits single lines and pauses only."""
        super().setup()
        with contextlib.suppress(OSError):  # the client may have reset the connection
            self.connection.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, SEND_BUFFER_BYTES)
        received = b""
        end = time.monotonic() + REQUEST_TIMEOUT_S
        while b"\r\n\r\n" not in received and len(received) < MAX_REQUEST_BYTES:
            self.connection.settimeout(max(end - time.monotonic(), 1e-3))
            piece = self.connection.recv(MAX_REQUEST_BYTES)
            if not piece:
                break
            received += piece
        self.rfile = io.BytesIO(received)
        self.connection.settimeout(ANSWER_TIMEOUT_S)

    def do_GET(self) -> None:
        """Answer a request if it has the token."""
        path, _, query = self.path.partition("?")
        token, slash, name = path.removeprefix("/").partition("/")
        if not hmac.compare_digest(token.encode(), self.server.token.encode()):
            message = "This address has no token or an old one; use the one that igsr view printed."
            self._answer(*_text(HTTPStatus.FORBIDDEN, message))
            return
        self.server.accept_token(self.request)
        if not slash:
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
        kind, content, status = answer(self.server.view, name, query, self._is_open)
        self._answer(kind, content, status)

    def _is_open(self) -> bool:
        return self.server.is_open(self.request)

    def _answer(self, kind: str, content: bytes, status: HTTPStatus) -> None:
        self.send_response(status)
        self.send_header("Content-Type", kind)
        self.send_header("Content-Length", str(len(content)))
        self.send_header("Cache-Control", "no-store")
        self.send_header("X-Content-Type-Options", "nosniff")
        # The address contains the token.
        self.send_header("Referrer-Policy", "no-referrer")
        self.send_header("Cross-Origin-Resource-Policy", "same-origin")
        self.end_headers()
        self.connection.settimeout(ANSWER_TIMEOUT_S + len(content) / SLOWEST_BYTES_PER_S)
        self.wfile.write(content)  # the timeout is for all of it


def open_server(view: LiveView, host: str, port: int | None) -> ViewServer:
    """Open a server; ``serve_forever`` answers requests.

    Args:
        view: answers the requests.
        host: address of this computer to listen at.
        port: None takes ``PORT``, or the next free one.
    """
    return listening(lambda number: ViewServer(view, host, number), host, port, PORT)


def listening(open_at: Callable[[int], T], host: str, port: int | None, first: int) -> T:
    """Return the result of ``open_at`` for a port.

    Args:
        open_at: listens at a port, or raises an OSError.
        host: for the error message.
        port: None takes ``first``, or the next free one.
        first: the default port.

    Raises:
        IgsrError: the port is taken, or the host is not of this computer.
    """
    ports = range(first, first + PORTS_TO_TRY) if port is None else (port,)
    for number in ports:
        try:
            return open_at(number)
        except OSError as error:
            reason = error.strerror or str(error)
    raise IgsrError(
        f"Cannot listen at {host}, port {ports[0]} ({reason}); name another with --host or --port."
    )
