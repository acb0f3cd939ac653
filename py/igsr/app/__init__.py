"""``igsr app``: a page that makes scenes from photos that are dropped into it."""

from __future__ import annotations

import os
import shutil
import socket
from collections.abc import Callable
from pathlib import Path

from igsr._internal.folder_lock import folder_lock
from igsr.errors import IgsrError
from igsr.rendering.live_server import is_loopback, listening

#: The default port.
PORT = 7860


def serve(
    out: Path,
    host: str = "127.0.0.1",
    port: int | None = None,
    password: str | None = None,
    announce: Callable[[str], None] = print,
) -> None:
    """Run the app until Ctrl-C; the run that goes on is stopped and keeps its checkpoint.

    Args:
        out: folder of the runs.
        host: address to listen on.
        port: None takes ``PORT``, or the next free one.
        password: of the user ``igsr``; needed if other computers can reach ``host``.
        announce: gets the address.

    Raises:
        IgsrError: the password is missing, the port is taken, or another app uses the folder.
        OSError: the folder cannot be written.
    """
    if not password and not is_loopback(host):
        raise IgsrError(
            f"Other computers can reach {host}: set a password in IGSR_PASSWORD, "
            "or leave out --host"
        )
    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    listener = listening(
        lambda number: socket.create_server((host, number), family=family, backlog=1024),
        host,
        port,
        PORT,
    )
    # Gradio before its own requirements, so that its extra is named if it is not installed.
    from igsr.app.server import make_app  # isort: split

    import uvicorn

    from igsr.app.runs import Runs

    with listener, folder_lock(out):
        runs = Runs(out)
        # Uploads are on the disk of the runs, and not in a folder that other users can see.
        uploads = runs.root / ".uploads"
        os.environ["GRADIO_TEMP_DIR"] = str(uploads)
        try:
            config = uvicorn.Config(
                make_app(runs, password or None),
                log_level="critical",  # requests that Ctrl-C cancels are errors to it
                timeout_graceful_shutdown=1,
                server_header=False,
            )
            shown = f"[{host}]" if ":" in host else host
            announce(f"http://{shown}:{listener.getsockname()[1]}/")
            uvicorn.Server(config).run(sockets=[listener])
        finally:
            runs.close()
            shutil.rmtree(uploads, ignore_errors=True)
