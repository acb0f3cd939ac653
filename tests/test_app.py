"""``igsr app``: its page in a browser, bad photos, and requests that it must refuse."""

import base64
import errno
import json
import os
import shutil
import subprocess
import sys
import time
import zlib
from pathlib import Path

import apps
import pytest
from PIL import Image
from test_photo_folder import film, write_video

from igsr.app.events import Events
from igsr.app.intake import MAX_FILES, check_files
from igsr.app.runs import DONE, QUEUED, STOPPED, Run, Runs
from igsr.errors import IgsrError


@pytest.fixture(scope="module")
def app(tmp_path_factory):
    """The folder of an app's runs, and its address."""
    out = tmp_path_factory.mktemp("app") / "scenes"
    with apps.served(str(out)) as address:
        yield out, address


@pytest.fixture(scope="module")
def tab(tmp_path_factory):
    with apps.Page(tmp_path_factory.mktemp("profile"), (900, 1400)) as page:
        yield page


@pytest.fixture(scope="module")
def photos(tmp_path_factory):
    return apps.room_photos(tmp_path_factory.mktemp("photos"))


def finished_run(out, name="20260101-120000-abcdef"):
    """The folder of a run with a scene."""
    folder = out / name
    folder.mkdir()
    (folder / "app.json").write_text(json.dumps({"name": name, "state": DONE, "photos": 3}))
    (folder / "scene.ply").write_bytes(b"ply")
    return folder


def names_of(out):
    return {path.name for path in out.iterdir() if not path.name.startswith(".")}


def test_photos_make_a_run_that_tabs_share_stop_and_continue(app, tab, photos, tmp_path):
    out, address = app
    tab.open_app(address)
    assert [url for url in tab.requests if not url.startswith((address, "data:", "blob:"))] == []
    tab.drop(photos)
    tab.wait_for_text("5 photos can be used.")
    tab.wait_for("document.querySelectorAll('.grid-container img').length == 5")
    name = tab.make()
    assert {path.name for path in (out / name / "photos").iterdir()} == {p.name for p in photos}
    tab.wait_for_text("find cameras")
    tab.wait_for("document.querySelector('iframe').contentDocument.querySelector('canvas') != null")

    with apps.Page(tmp_path / "second", (400, 800)) as second:
        second.open_app(f"{address}?run={name}")
        second.wait_for_text("Working.")
        second.open_app(address)
        second.press("Use the example photos")
        waiting = second.opened_run()
        assert waiting != name
        second.wait_for_text("Waiting. Another scene is being made.")
        second.press("Stop")
        second.wait_for_text("Stopped. Not started.")

        tab.leave()
        tab.open_app(f"{address}?run={name}")
        tab.wait_for_text("Working.")
        tab.press("Stop")
        tab.wait_for_text("Stopped. Continue uses its checkpoint.")
        second.open_app(f"{address}?run={name}")
        second.press("Continue")
        second.wait_for_text("Working.")
        tab.wait_for_text("Working.")
        tab.press("Stop")
        second.wait_for_text("Stopped.")

    tab.open_app(address)
    text = tab.wait_for_text("Scenes")
    assert text.count("Stopped") == 2
    assert tab.run("document.documentElement.scrollWidth <= innerWidth")


def damaged(folder):
    file = folder / "scan.jpg"
    file.write_bytes(b"%PDF-1.7\n1 0 obj\n")
    return [file]


def huge(folder):
    """A PNG of 200 megapixels, one color: 25 kB."""
    width, height = 20000, 10000
    rows = zlib.compressobj(9)
    body = b"".join(rows.compress(b"\0" * (1 + width // 8)) for _ in range(height)) + rows.flush()

    def chunk(kind, data):
        check = zlib.crc32(kind + data).to_bytes(4, "big")
        return len(data).to_bytes(4, "big") + kind + data + check

    sizes = width.to_bytes(4, "big") + height.to_bytes(4, "big") + bytes([1, 0, 0, 0, 0])
    file = folder / "huge.png"
    file.write_bytes(
        b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", sizes) + chunk(b"IDAT", body) + chunk(b"IEND", b"")
    )
    return [file]


def many(folder):
    files = [folder / f"{number}.png" for number in range(500)]
    Image.new("RGB", (8, 8)).save(files[0])
    for file in files[1:]:
        shutil.copyfile(files[0], file)
    return files


BAD = {
    "no photo": (lambda folder: [], "No photo can be used"),
    "one photo": (lambda folder: apps.room_photos(folder, 1), "Only one photo can be used"),
    "a document": (damaged, "scan.jpg"),
    "too many": (many, f"These are 500 files; choose at most {MAX_FILES}."),
    "too large": (huge, "huge.png claims too many pixels for a photo"),
}


@pytest.mark.parametrize("case", BAD)
def test_bad_photos_are_a_sentence_and_start_nothing(app, tab, tmp_path, case):
    out, address = app
    before = names_of(out)
    make_files, sentence = BAD[case]
    tab.open_app(address)
    files = make_files(tmp_path)
    if files:
        tab.drop(files)
        tab.wait_for_text(sentence)
    tab.press("Make the scene")
    text = tab.wait_for_text(sentence)
    assert "Traceback" not in text
    assert names_of(out) == before


def test_dark_and_blurred_photos_are_named(app, tab, tmp_path, photos):
    files = [shutil.copy(photo, tmp_path / photo.name) for photo in photos]
    Image.open(photos[0]).point(lambda level: level // 8).save(tmp_path / photos[0].name)
    _, address = app
    tab.open_app(address)
    tab.drop(files)
    assert f"{photos[0].name}: dark" in tab.wait_for_text("dark; add light")


def test_without_gradio_the_extra_is_named(tmp_path):
    (tmp_path / "sitecustomize.py").write_text("import sys\nsys.modules['gradio'] = None\n")
    path = os.pathsep.join([str(tmp_path), os.environ.get("PYTHONPATH", "")])
    done = subprocess.run(
        [sys.executable, "-m", "igsr.cli", "app", "--no-browser"],
        cwd=tmp_path,
        env={**os.environ, "PYTHONPATH": path},
        capture_output=True,
        text=True,
        timeout=60,
    )
    assert (done.returncode, done.stdout) == (1, "")
    assert done.stderr == "igsr app needs gradio: pip install 'igsr[app]'.\n"
    assert [path.name for path in tmp_path.iterdir()] == ["sitecustomize.py"]


def test_a_run_is_deleted_only_if_that_is_confirmed(app, tab):
    out, address = app
    folder = finished_run(out)
    tab.open_app(f"{address}?run={folder.name}")
    tab.wait_for_text("Done.")
    tab.run("window.confirm = () => { window.asked = true; return false; }")
    tab.press("Delete")
    tab.wait_for("window.asked")
    time.sleep(1.0)
    assert folder.exists()
    tab.run("window.confirm = () => true")
    tab.press("Delete")
    tab.wait_for_text("A scene from photos")
    assert not folder.exists()


def test_videos_are_taken_and_other_files_left_out(tmp_path, photos):
    write_video(tmp_path / "walk.MP4", film(20, {7}))
    (tmp_path / "notes.txt").write_text("notes")
    files = [str(tmp_path / "walk.MP4"), str(tmp_path / "notes.txt"), str(photos[0])]
    notes, _ = Events(None).check(files)
    assert "1 photo and 1 video can be used." in notes
    assert "notes.txt: not a photo or video" in notes
    assert sorted(check_files([*map(Path, files)]).taken) == [photos[0].name, "walk.MP4"]


def test_programs_call_documented_names(app):
    from gradio_client import Client
    from gradio_client.exceptions import AppError

    _, address = app
    client = Client(address, verbose=False)
    name = client.predict("draft", 0, False, 7, api_name="/make_example")
    assert client.predict(name, api_name="/run_state")["state"] in ("queued", "running")
    client.predict(name, api_name="/stop_run")
    state = apps.until(
        lambda: (found := client.predict(name, api_name="/run_state"))["state"] == STOPPED and found
    )
    assert state["files"] == {}
    for unknown in ("../x", "", "20260101-120000-000000"):
        with pytest.raises(AppError, match="This run does not exist"):
            client.predict(unknown, api_name="/run_state")


def test_a_full_disk_leaves_nothing(tmp_path, photos, monkeypatch):
    def full(*_):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    runs = Runs(tmp_path / "scenes")
    monkeypatch.setattr(shutil, "copyfile", full)
    with pytest.raises(OSError, match="No space left"):
        runs.create({"a.png": photos[0]})
    assert runs.names() == []
    assert names_of(runs.root) == set()
    runs.close()


def test_a_run_cannot_be_deleted_while_it_is_queued(tmp_path, photos):
    runs = Runs(tmp_path)
    runs._is_closed.set()  # nothing starts
    runs._worker.join()
    name = runs.create({"a.png": photos[0]}, Run("")).name
    assert runs.get(name).state == QUEUED
    with pytest.raises(IgsrError, match="stop it first"):
        runs.delete(name)
    runs.stop(name)
    runs.delete(name)
    assert names_of(tmp_path) == set()
    again = Runs(tmp_path)
    assert again.names() == []
    again.close()


def test_a_queued_run_whose_state_cannot_be_stored_does_not_wait_forever(
    tmp_path, photos, monkeypatch
):
    def full(*_):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    runs = Runs(tmp_path)
    with runs._lock:
        name = runs.create({"a.png": photos[0]}).name
        monkeypatch.setattr(runs, "_store", full)
    apps.until(lambda: runs.get(name).state == STOPPED)
    runs.delete(name)
    runs.close()


def test_a_damaged_state_is_a_failed_run(tmp_path):
    runs = Runs(tmp_path)
    folder = finished_run(tmp_path)
    for text in ("", "[]", '{"name": "x"}', json.dumps({"name": folder.name, "state": "x"})):
        (folder / "app.json").write_text(text)
        assert runs.get(folder.name).message == "app.json cannot be read."
    runs.close()


def test_a_run_whose_folder_is_removed_does_not_stop_the_queue(tmp_path, photos):
    runs = Runs(tmp_path)
    name = runs.create({"a.png": photos[0]}).name
    apps.until(lambda: name in runs._current)
    shutil.rmtree(tmp_path / name)
    assert runs.log(name) == []
    runs._current[name].process.kill()
    apps.until(lambda: name not in runs._current)
    second = runs.create({"a.png": photos[0]}).name
    apps.until(lambda: second in runs._current)
    runs.close()


def test_files_of_a_run_are_served_by_an_allow_list(app, tmp_path):
    out, address = app
    folder = finished_run(out)
    secret = tmp_path / "secret.txt"
    secret.write_text("hidden words")
    (folder / "scene.html").symlink_to(secret)
    (out / "20260101-120000-bbbbbb").symlink_to(tmp_path)
    (folder / "report.html").mkdir()
    assert apps.answered(address, f"/runs/{folder.name}/files/scene.ply") == (200, b"ply")
    refused = [
        f"/runs/{folder.name}/files/app.json",
        f"/runs/{folder.name}/files/scene.html",
        f"/runs/{folder.name}/files/report.html",
        f"/runs/{folder.name}/files/scene.spz",  # its scene is damaged
        f"/runs/{folder.name}/files/../app.json",
        f"/runs/{folder.name}/files/..%2fapp.json",
        f"/runs/{folder.name}/files/%2e%2e%2fapp.json",
        f"/runs/{folder.name}/view/..%2f..%2fapp.json",
        f"/runs/{folder.name}/view/photo?number=-1",
        "/runs/20260101-120000-bbbbbb/files/secret.txt",
        "/runs/../../etc/passwd",
        "/runs/..%2f..%2f/files/scene.ply",
        "/runs/%00/files/scene.ply",
        f"/gradio_api/file={folder}/app.json",
        "/gradio_api/file=/etc/passwd",
        f"/gradio_api/file={out}/../secret.txt",
    ]
    for path in refused:
        status, content = apps.answered(address, path)
        assert status in (403, 404), path
        assert b"hidden words" not in content
        assert b"root:" not in content
    shutil.rmtree(folder)
    (out / "20260101-120000-bbbbbb").unlink()


def test_a_view_answers_while_others_are_opened(tmp_path, monkeypatch):
    from starlette.testclient import TestClient

    from igsr.app import server

    used = []
    monkeypatch.setattr(
        server, "answer", lambda view, *_: used.append(view) or ("text/plain", b"", 200)
    )
    runs = Runs(tmp_path)
    client = TestClient(server.make_app(runs), "http://127.0.0.1")
    for number in range(server.MAX_VIEWS + 1):
        name = finished_run(tmp_path, f"20260101-12000{number}-abcdef").name
        assert client.get(f"/runs/{name}/view/photo?number=0").status_code == 200
    assert used[0]._decoder.submit(int).result() == 0
    runs.close()


def test_names_of_uploads_stay_in_their_folder(app):
    out, address = app
    form = (
        b'--x\r\nContent-Disposition: form-data; name="files"; filename="../../../evil.png"\r\n'
        b"Content-Type: image/png\r\n\r\nx\r\n--x--\r\n"
    )
    kind = ("Content-Type", "multipart/form-data; boundary=x")
    status, content = apps.answered(address, "/gradio_api/upload", "POST", form, [kind])
    assert status == 200
    assert Path(json.loads(content)[0]).is_relative_to(out / ".uploads")
    assert not list(out.parent.rglob("../evil.png"))


def test_requests_of_other_sites_and_host_names_are_refused(app):
    _, address = app
    port = address.rstrip("/").rpartition(":")[2]
    assert apps.answered(address)[0] == 200
    assert apps.answered(address, headers=[("Origin", address.rstrip("/"))])[0] == 200
    for origin in ("http://evil.example", "null", f"http://127.0.0.1:{int(port) + 1}"):
        status, _ = apps.answered(address, "/gradio_api/upload", "POST", b"", [("Origin", origin)])
        assert status == 403, origin
    for host in ("evil.example", f"evil.example:{port}", "127.0.0.1.evil.example", "[", "x"):
        assert apps.answered(address, host=host)[0] == 403, host
    assert apps.answered(address, host=f"localhost:{port}")[0] == 200


def test_uploads_have_a_limit(app):
    _, address = app
    chunked = [("Content-Length", "5"), ("Transfer-Encoding", "chunked")]
    assert apps.answered(address, "/gradio_api/upload", "POST", headers=chunked)[0] == 413
    assert apps.answered(address, method="HEAD")[0] == 200
    for length, status in (("99999999999", 413), ("9" * 400, 400), ("-1", 400), ("x", 400)):
        headers = [("Content-Length", length)]
        assert apps.answered(address, "/gradio_api/upload", "POST", headers=headers)[0] == status
    large = [("Content-Length", "99999999")]
    assert apps.answered(address, "/gradio_api/queue/join", "POST", headers=large)[0] == 413


def test_files_of_other_servers_are_not_fetched(app):
    from gradio_client import Client, handle_file
    from gradio_client.exceptions import AppError

    _, address = app
    for path in ("file=https://example.com/a.png", "proxy=https://example.com/a.png"):
        status, content = apps.answered(address, f"/gradio_api/{path}")
        assert (status, content) == (403, b"Files of other servers are not fetched.")
    client = Client(address, verbose=False)
    photo = handle_file("https://example.com/a.png")
    with pytest.raises(AppError, match="not fetched"):
        client.predict([photo], "draft", 0, False, 0, api_name="/make_scene")


def test_a_password_guards_every_address(tmp_path):
    from gradio_client import Client

    folder = tmp_path / "scenes"
    folder.mkdir()
    run = finished_run(folder)
    with apps.served(str(folder), variables={"IGSR_PASSWORD": "Väter"}) as address:

        def status(user, password, path, **more):
            login = base64.b64encode(f"{user}:{password}".encode()).decode()
            return apps.answered(
                address, path, headers=[("Authorization", f"Basic {login}")], **more
            )[0]

        paths = ("/", "/config", f"/runs/{run.name}/files/scene.ply", f"/runs/{run.name}/view/")
        for path in paths:
            assert apps.answered(address, path)[0] == 401
            assert apps.answered(address, path, headers=[("Authorization", b"\xe4")])[0] == 401
            assert status("igsr", "Vater", path) == 401
            assert status("root", "Väter", path) == 401
            assert status("igsr", "Väter", path) == 200
            assert status("igsr", "Väter", path, host="scenes.example") == 200
        Client(address, verbose=False, httpx_kwargs={"auth": ("igsr", "Väter")})


def test_an_app_that_cannot_start_says_why(app, tmp_path):
    port = app[1].rstrip("/").rpartition(":")[2]
    for words, sentence in (
        (["--host", "0.0.0.0"], "set a password in IGSR_PASSWORD"),
        (["--port", port], f"port {port}"),
        (["--out", app[0]], "Another igsr (process"),
    ):
        command = [sys.executable, "-m", "igsr.cli", "app", "--no-browser"]
        done = subprocess.run(
            [*command, "--out", tmp_path / "scenes", *words],
            capture_output=True,
            text=True,
            timeout=60,
        )
        assert done.returncode == 1
        assert sentence in done.stderr
        assert "Traceback" not in done.stderr
    assert not (tmp_path / "scenes").exists()
