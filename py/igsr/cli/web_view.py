"""``igsr view --web``: run the server in the foreground until Ctrl-C."""

from __future__ import annotations

import contextlib
import os
import sys
import tempfile
import webbrowser
from collections.abc import Callable
from pathlib import Path

from igsr.cli.error_messages import Terminated, print_message
from igsr.errors import IgsrError


def serve_web_view(
    scenes: list[str],
    readable_cameras: Callable[[Path], Path | None],
    host: str,
    port: int | None,
) -> None:
    """Show scenes in the browser until Ctrl-C.

    Args:
        scenes: splat files, and folders of fits and refinements.
        readable_cameras: given a temporary folder, returns the ``cameras.json`` to show, or None
            to use those in the scenes' folders.
        host: address to listen on.
        port: None for the default, or the next free one.

    Raises:
        IgsrError: a scene does not exist, or the server cannot listen.
    """
    from igsr.rendering.live_models import check_viewable, live_models
    from igsr.rendering.live_server import is_loopback, open_server
    from igsr.rendering.live_view import LiveView

    options = [word for word in scenes if word.startswith("-")]
    if options:
        raise IgsrError(f"{options[0]} is an option of splat-view, not of the browser view")
    paths = [Path(scene) for scene in scenes]
    for path in paths:
        check_viewable(path)
        if not live_models(path):
            print_message(f"{path} has no model yet; the page shows it as soon as there is one.")
    with tempfile.TemporaryDirectory(prefix="igsr-view-") as folder:
        view = LiveView(paths, readable_cameras(Path(folder)))
        with contextlib.closing(view), open_server(view, host, port) as server:
            _announce(server.url, server.server_port, is_open=not is_loopback(host))
            try:
                server.serve_forever()
            except Terminated:
                raise
            except KeyboardInterrupt:
                pass


def _announce(url: str, port: int, *, is_open: bool) -> None:
    print(url, flush=True)
    if is_open:
        print_message(
            f"Port {port} is open to other computers: anyone with the address above can see the "
            "scenes and photos. The connection is not encrypted."
        )
    is_remote = "SSH_CONNECTION" in os.environ
    if is_remote and not is_open:
        print_message(
            f"On your own computer run: ssh -L {port}:127.0.0.1:{port} HOST, "
            "then open the address above."
        )
    print_message("Press Ctrl-C to stop.")
    if has_display() and not is_remote:
        webbrowser.open(url)


def has_display() -> bool:
    """Whether the environment has a display."""
    return sys.platform in ("win32", "darwin") or bool(
        os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")
    )
