"""``igsr view --web``: the server in the foreground, until Ctrl-C."""

from __future__ import annotations

import contextlib
import os
import sys
import tempfile
import webbrowser
from collections.abc import Callable
from pathlib import Path

from igsr.cli.error_messages import print_message
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
        readable_cameras: the ``cameras.json`` to show, made in a folder where it has to be; None
            for those beside the scenes.
        host: address to listen at.
        port: None takes the usual one, or the next that is free.

    Raises:
        IgsrError: a scene is not there, or the server cannot listen.
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
        cameras = readable_cameras(Path(folder))
        with open_server(LiveView(paths, cameras), host, port) as server:
            _announce(server.url, server.server_port, is_open=not is_loopback(host))
            # Ctrl-C is how it is meant to end.
            with contextlib.suppress(KeyboardInterrupt):
                server.serve_forever()


def _announce(url: str, port: int, *, is_open: bool) -> None:
    print(url, flush=True)
    if is_open:
        print_message(
            f"Port {port} is open to other computers: whoever has the address above sees the "
            "scenes and photos, and nothing is encrypted."
        )
    is_remote = "SSH_CONNECTION" in os.environ
    if is_remote and not is_open:
        print_message(
            f"On your own computer run: ssh -L {port}:127.0.0.1:{port} HOST, "
            "then open the address above there."
        )
    print_message("Ctrl-C ends it.")
    if has_display() and not is_remote:
        webbrowser.open(url)


def has_display() -> bool:
    """Whether windows can be opened here, as far as the environment says."""
    return sys.platform in ("win32", "darwin") or bool(
        os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")
    )
