"""Whole runs of ``igsr app`` in a browser: from dropped photos to the files of a scene."""

import os
import signal
import subprocess
import sys

import apps
import numpy as np
import pytest
from PIL import Image

from igsr import Splats
from igsr._internal.folder_lock import LOCK_FILE

pytestmark = pytest.mark.long

MINUTES = 60.0


@pytest.fixture
def tab(tmp_path):
    with apps.Page(tmp_path / "profile", (900, 1400)) as page:
        yield page


def kill_run(folder, before=None):
    """Kill the process that writes to a run's folder, once it is another than before."""

    def found():
        words = (folder / LOCK_FILE).read_text().split() if (folder / LOCK_FILE).exists() else []
        return int(words[1]) if len(words) == 4 and words[1] != str(before) else None

    process = apps.until(found)
    os.kill(process, signal.SIGKILL)
    return process


def picture(page, file):
    """Pixels of the frame with the scene."""
    page.wait_for("document.querySelector('iframe').contentWindow.igsr != null")
    page.run("document.querySelector('iframe').contentWindow.igsr.ready.then(() => true)")
    page.run("document.querySelector('iframe').scrollIntoView()")
    page.screenshot(file)
    corners = "(({x, y, width, height}) => [x, y, x + width, y + height])"
    box = page.run(f"{corners}(document.querySelector('iframe').getBoundingClientRect())")
    return np.asarray(Image.open(file).convert("RGB").crop([round(side) for side in box]))


def test_a_killed_run_becomes_the_scene_that_the_command_makes(tab, tmp_path):
    """Tab closed, app and run killed: the files equal those of ``igsr refine``, bit for bit."""
    photos = apps.room_photos(tmp_path / "photos")
    out = tmp_path / "scenes"
    first, address = apps.started(str(out), "--port", "0")
    tab.open_app(address)
    tab.drop(photos)
    tab.wait_for_text("5 photos can be used.")
    tab.run("[...document.querySelectorAll('input')].find(i => i.value == 'draft').click()")
    name = tab.make()
    tab.wait_for_text("fit photos", timeout=5 * MINUTES)
    tab.leave()
    first.kill()
    first.communicate()

    with apps.served(str(out)) as address:
        tab.open_app(f"{address}?run={name}")
        tab.wait_for_text("Working.")  # the run of the app that was killed
        killed = kill_run(out / name)
        tab.wait_for_text("Stopped. It was interrupted.")
        tab.press("Continue")
        tab.wait_for_text("Working.")
        kill_run(out / name, killed)
        tab.wait_for_text("Failed. It was killed")
        tab.press("Continue")
        tab.wait_for_text("Done.", timeout=5 * MINUTES)
        text = tab.wait_for_text("Renders of fitted photos are")
        assert "Download: page to send (.html)" in text
        tab.wait_for("document.querySelectorAll('.scene img').length >= 4")
        scene = picture(tab, tmp_path / "scene.png")
        middle = scene[len(scene) // 4 : -len(scene) // 4]
        assert len(np.unique(middle.reshape(-1, 3) // 16, axis=0)) > 100

        words = ["refine", tmp_path / "photos", "--quality", "draft", "--out", tmp_path / "alone"]
        done = subprocess.run(
            [sys.executable, "-m", "igsr.cli", *words], capture_output=True, text=True
        )
        assert done.returncode == 0, done.stderr
        status, ply = apps.answered(address, f"/runs/{name}/files/scene.ply")
        assert status == 200
        assert ply == (tmp_path / "alone" / "scene.ply").read_bytes()
        count = len(Splats.load(tmp_path / "alone" / "scene.ply"))
        for file in ("scene.spz", "scene.sog"):
            (tmp_path / file).write_bytes(apps.answered(address, f"/runs/{name}/files/{file}")[1])
            assert len(Splats.load(tmp_path / file)) == count
        for file, start in (
            ("scene.mp4", b"\0\0\0"),
            ("scene.html", b"<!"),
            ("report.html", b"<!"),
            ("report.json", b"{"),
        ):
            status, content = apps.answered(address, f"/runs/{name}/files/{file}")
            assert (status, content.lower().startswith(start)) == (200, True), file

        tab.open_app(address)
        tab.wait_for(
            "[...document.querySelectorAll('.runs img')].every(i => i.complete && i.naturalWidth)"
        )


def test_photos_of_two_places_are_named(tab, tmp_path):
    files = apps.room_photos(tmp_path / "a", 4, 0) + apps.room_photos(tmp_path / "b", 3, 1)
    with apps.served(str(tmp_path / "scenes")) as address:
        tab.open_app(address)
        tab.drop(files)
        tab.wait_for_text("7 photos can be used.")
        tab.run("[...document.querySelectorAll('input')].find(i => i.value == 'draft').click()")
        tab.make()
        text = tab.wait_for_text("Done.", "Failed.", timeout=8 * MINUTES)
        text = tab.wait_for_text("10.png")
    assert "Traceback" not in text
    assert "may show another place" in text
