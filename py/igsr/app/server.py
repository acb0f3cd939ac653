"""The HTTP server of ``igsr app``: Gradio's page, the view of each run, and the files of runs."""

from __future__ import annotations

import base64
import hmac
import re
import threading
from collections import OrderedDict
from collections.abc import Awaitable, Callable, MutableMapping
from typing import Any

import gradio as gr
from fastapi import FastAPI, Request, Response
from fastapi.responses import FileResponse, PlainTextResponse
from starlette.datastructures import Headers

from igsr.app.intake import MAX_BYTES
from igsr.app.page import CSS, make_page
from igsr.app.results import result_file
from igsr.app.runs import Runs
from igsr.errors import IgsrError
from igsr.rendering.live_server import answer, is_loopback
from igsr.rendering.live_view import LiveView

USER = "igsr"
#: Views of runs that are kept open; each may hold a few packed models.
MAX_VIEWS = 4
#: The files and the text of a form; other requests are kept in memory.
MAX_UPLOAD_BYTES = MAX_BYTES + (1 << 20)
MAX_CALL_BYTES = 1 << 24
#: Pages load nothing from elsewhere, and no other site shows them in a frame.
_POLICY = (
    "default-src 'self' 'unsafe-inline' 'unsafe-eval' data: blob:; "
    "form-action 'self'; frame-ancestors 'self'; base-uri 'self'"
)

_Message = MutableMapping[str, Any]
_Receive = Callable[[], Awaitable[_Message]]
_Send = Callable[[_Message], Awaitable[None]]


class _Guard:
    """Refuses requests from other sites, to foreign host names, without the password, too large."""

    def __init__(self, app: Any, password: str | None) -> None:
        self._app = app
        login = base64.b64encode(f"{USER}:{password}".encode()).decode()
        self._login = None if password is None else f"Basic {login}".encode()

    async def __call__(self, scope: _Message, receive: _Receive, send: _Send) -> None:
        if scope["type"] != "http":
            if scope["type"] == "lifespan":
                await self._app(scope, receive, send)
            return
        refusal = self._refusal(scope, Headers(scope=scope))
        if refusal is not None:
            await refusal(scope, receive, send)
            return

        async def with_policy(message: _Message) -> None:
            if message["type"] == "http.response.start":
                message["headers"] = [
                    *message["headers"],
                    (b"content-security-policy", _POLICY.encode()),
                    (b"x-content-type-options", b"nosniff"),
                    (b"referrer-policy", b"no-referrer"),
                ]
            await send(message)

        await self._app(scope, receive, with_policy)

    def _refusal(self, scope: _Message, headers: Headers) -> Response | None:
        host = headers.get("host", "")
        if self._login is None:
            # A foreign name that leads to this computer would let other sites read the answers.
            if not is_loopback(re.sub(r":[0-9]*$", "", host).strip("[]")):
                return PlainTextResponse("Open the address that igsr app printed.", 403)
        elif not hmac.compare_digest(headers.get("authorization", "").encode(), self._login):
            return PlainTextResponse(
                "Sign in with the user igsr and the password.",
                401,
                {"WWW-Authenticate": 'Basic realm="igsr", charset="UTF-8"'},
            )
        origin = headers.get("origin")
        if origin is not None and origin.partition("://")[2] != host:
            return PlainTextResponse("This request comes from another site.", 403)
        if "://" in scope["path"]:
            # Gradio would fetch a file from there, which may be a page with a script.
            return PlainTextResponse("Files of other servers are not fetched.", 403)
        # Uvicorn receives no more than the length that a request names, unless it is in chunks.
        length = headers.get("content-length", "0" if scope["method"] in ("GET", "HEAD") else "")
        is_chunked = "transfer-encoding" in headers
        most = MAX_UPLOAD_BYTES if scope["path"].endswith("/upload") else MAX_CALL_BYTES
        if is_chunked or not length.isdecimal() or int(length) > most:
            return PlainTextResponse("The upload is too large, or does not name its length.", 413)
        return None


async def _no_request(url: str) -> Any:
    raise gr.Error("Files of other servers are not fetched.", print_exception=False)


def make_app(runs: Runs, password: str | None = None) -> Any:
    """Return the ASGI application.

    Args:
        runs: the runs to show.
        password: of the user ``igsr``; None answers requests to loopback addresses only.
    """
    app = FastAPI(docs_url=None, redoc_url=None, openapi_url=None)
    views: OrderedDict[str, LiveView] = OrderedDict()
    lock = threading.Lock()

    def view_of(name: str) -> LiveView:
        folder = runs.folder(name)
        with lock:
            view = views.pop(name, None) or LiveView([folder])
            views[name] = view
            while len(views) > MAX_VIEWS:
                views.popitem(last=False)  # not closed: another request may use it
        return view

    @app.get("/runs/{name}/view/{item}")
    @app.get("/runs/{name}/view/")
    def view(name: str, request: Request, item: str = "") -> Response:
        try:
            found = view_of(name)
        except IgsrError as error:
            return PlainTextResponse(str(error), 404)
        kind, content, status = answer(found, item, dict(request.query_params), lambda: True)
        return Response(content, status, {"Cache-Control": "no-store"}, kind)

    @app.get("/runs/{name}/files/{file}")
    def files(name: str, file: str) -> Response:
        try:
            path = result_file(runs.folder(name), file)
        except IgsrError as error:
            return PlainTextResponse(str(error), 404)
        return FileResponse(path, filename=file)

    # Calls may name an address in place of an uploaded file.
    gr.processing_utils.async_ssrf_protected_get = _no_request
    page = make_page(runs)
    gr.mount_gradio_app(
        app,
        page,
        "/",
        footer_links=[],
        run_history=False,
        max_file_size=MAX_BYTES,
        ssr_mode=False,
        mcp_server=False,
        enable_monitoring=False,
        theme=gr.themes.Default(font=("system-ui", "sans-serif"), font_mono=("monospace",)),
        css=CSS,
    )
    return _Guard(app, password)
