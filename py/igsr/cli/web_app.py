"""``igsr app``: a page in the browser that makes scenes from dropped photos."""

from __future__ import annotations

import os
import webbrowser
from pathlib import Path
from typing import Annotated

from igsr.cli.error_messages import Terminated, error_messages, print_message
from igsr.cli.options import option
from igsr.cli.web_view import has_display

PASSWORD = "IGSR_PASSWORD"


def app_command(
    *,
    out: Annotated[Path, option("--out", help="Folder for the scenes, a folder each.")] = Path(
        "igsr-scenes"
    ),
    host: Annotated[
        str,
        option("--host", metavar="ADDRESS", help="Listen on ADDRESS; needs IGSR_PASSWORD."),
    ] = "127.0.0.1",
    port: Annotated[
        int | None,
        option("--port", metavar="N", help="Listen on port N. Default: 7860 or the next free."),
    ] = None,
    browser: Annotated[
        bool, option("--browser/--no-browser", help="Open the page in the browser.")
    ] = True,
) -> None:
    """Open a page that makes scenes from dropped photos."""
    with error_messages():
        from igsr.app import serve

        def announce(url: str) -> None:
            print(url, flush=True)
            print_message(f"Scenes are written to {out}. Press Ctrl-C to stop.")
            if browser and has_display() and "SSH_CONNECTION" not in os.environ:
                webbrowser.open(url)

        try:
            serve(out, host, port, os.environ.get(PASSWORD), announce)
        except Terminated:
            raise
        except KeyboardInterrupt:
            pass
