"""The server of ``igsr view --web``: access, models and photos, bad requests, the command."""

import json
import os
import signal
import socket
import struct
import time
from concurrent.futures import ThreadPoolExecutor
from urllib.parse import urlsplit

import numpy as np
import pytest
import scenes
from PIL import Image
from scene_pages import model
from web_views import asked, served, started_view, state_of, view_until_ctrl_c, with_token

import igsr
from igsr._internal.event import Event
from igsr.capture.write_transforms import write_cameras
from igsr.fitting.fit_capture import fit_capture
from igsr.fitting.followed_run import FollowedRun
from igsr.rendering import live_view, run_folder
from igsr.rendering.live_server import is_loopback, open_server
from igsr.rendering.run_folder import run_background, run_progress, run_scores

SECRET = b"private"


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    path = tmp_path_factory.mktemp("scene") / "scene.ply"
    model().save(path)
    return path


@pytest.mark.parametrize("name", ["", "state", "surroundings", "model?id=scene", "photo?number=0"])
def test_requests_without_the_token_are_refused(scene, name):
    with served(scene) as server:
        right = server.token
        near = (right[:-1], right + "x", right.swapcase(), f"x/../{right}")
        for wrong in (*near, "", "é", "%00", "/["):
            status, content = asked(server, f"/{wrong}/{name}")
            assert status == 403
            assert right.encode() not in content
        assert asked(server, f"/{name}")[0] == 403
    with served(scene) as another:
        assert another.token != right
        assert asked(another, f"/{right}/{name}")[0] == 403


def test_names_are_not_paths(tmp_path, scene):
    folder = tmp_path / "folder"
    folder.mkdir()
    (folder / "scene.ply").write_bytes(scene.read_bytes())
    for place in (folder, tmp_path):
        (place / "secret.txt").write_bytes(SECRET)
    paths = [f"{part}secret.txt" for part in ("", "../", "..%2f", "%2e%2e/", "//", "./")]
    paths += ["static/../secret.txt"]
    models = ["model", *(f"model?id={id}" for id in ("../secret.txt", "secret.txt", "%00"))]
    photos = ["photo", *(f"photo?number={n}" for n in ("../secret.txt", "-1", "99"))]
    with served(folder) as server:
        for name in (*paths, *models, *photos):
            status, content = with_token(server, name)
            assert status == 404, name
            assert SECRET not in content


def test_photos_outside_of_the_folder_are_not_shown(tmp_path):
    made = scenes.capture(views=4, size=8)
    folder = tmp_path / "folder"
    folder.mkdir()
    for name in ("folder/in.png", "out.png", "folder/scene.txt"):
        Image.fromarray(made.views[0].image).save(tmp_path / name, format="PNG")
    (folder / "link.png").symlink_to(tmp_path / "out.png")
    names = ["../out.png", str(tmp_path / "out.png"), "link.png", "in.png", "scene.txt", "no.png"]
    views = [igsr.View(name, made.views[0].camera, "train", made.views[0].image) for name in names]
    write_cameras(folder / "cameras.json", views)
    model().save(folder / "scene.ply")
    with served(folder) as server:
        cameras = json.loads(with_token(server, "surroundings")[1])["cameras"]
        assert {one["name"] for one in cameras if "photo" in one} == {"in.png"}
        status, content = with_token(server, cameras[0]["photo"])
        assert status == 200
        assert content.startswith(b"\xff\xd8")
        assert with_token(server, "photo?number=1")[0] == 404


def test_a_damaged_photo_is_an_error(tmp_path):
    made = scenes.capture(views=1, size=8)
    (tmp_path / "in.png").write_bytes(b"\x89PNG\r\n\x1a\n and no more")
    view = igsr.View("in.png", made.views[0].camera, "train", made.views[0].image)
    write_cameras(tmp_path / "cameras.json", [view])
    with served(tmp_path) as server:
        status, content = with_token(server, "photo?number=0")
        assert status == 422
        assert b"in.png cannot be shown" in content


def test_a_hundred_requests_at_once_pack_a_model_once(scene, monkeypatch):
    packed = []

    def pack(found):
        packed.append(found)
        time.sleep(0.2)
        return b"x" * 3_000_000

    monkeypatch.setattr(live_view, "_packed", pack)
    with served(scene) as server, ThreadPoolExecutor(100) as pool:
        answers = list(pool.map(lambda _: with_token(server, "model?id=scene"), range(100)))
    assert {(status, len(content)) for status, content in answers} == {(200, 3_000_000)}
    assert len(packed) == 1


def test_clients_that_disconnect_or_send_nothing_do_no_harm(scene, monkeypatch, caplog):
    monkeypatch.setattr(live_view, "_packed", lambda found: b"x" * 20_000_000)
    with served(scene) as server:
        silent = [socket.create_connection(("127.0.0.1", server.server_port)) for _ in range(20)]
        for one in silent:
            one.sendall(b"GET /")
        for _ in range(20):
            leaving = socket.create_connection(("127.0.0.1", server.server_port))
            leaving.sendall(f"GET /{server.token}/model?id=scene HTTP/1.0\r\n\r\n".encode())
            leaving.recv(1000)
            # It closes the connection at once.
            leaving.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))
            leaving.close()
        assert state_of(server)["newest"] == "scene"
        for one in silent:
            one.close()
    assert caplog.records == []


def test_a_port_in_use_is_an_error(scene):
    with served(scene) as server:
        taken = server.server_port
        with pytest.raises(igsr.IgsrError, match=f"port {taken} .*--port"):
            open_server(server.view, "127.0.0.1", taken)
        with pytest.raises(igsr.IgsrError, match=r"Cannot listen at 192\.0\.2\.1"):
            open_server(server.view, "192.0.2.1", 0)


def test_loopback_addresses():
    assert all(map(is_loopback, ["127.0.0.1", "127.1.2.3", "::1", "localhost"]))
    assert not any(map(is_loopback, ["0.0.0.0", "::", "192.168.1.2", "box", ""]))


def test_a_fit_and_its_checkpoint(tmp_path):
    made = scenes.capture(views=5, size=24)
    folder = tmp_path / "out"
    folder.mkdir()
    with served(folder) as server:
        assert state_of(server)["models"] == []
        states = []
        followed = FollowedRun(folder)
        followed(Event("find cameras", part=0.0))
        assert state_of(server)["run"] == {"text": "find cameras", "done": 0.0}
        followed.show(made, (1.0, 0.5, 0.0))

        def listener(event):
            followed(event)
            states.append(state_of(server))

        options = {"remove_floaters": False, "backdrop": False, "report": listener}
        checkpoint = folder / "checkpoint.npz"
        fitted = fit_capture(made, steps=6, backend="cpu", checkpoint=checkpoint, **options).splats
        assert states[0]["run"]["text"].startswith("fit 1 of 6, loss ")
        assert 0.0 < states[0]["run"]["done"] < 1.0
        state = state_of(server)
        assert [one["label"] for one in state["models"]] == ["being fitted"]
        found = live_view.live_models(folder)[0].load()
        assert found.means.tobytes() == fitted.means.tobytes()
        around = json.loads(with_token(server, "surroundings")[1])
        assert around["background"] == [1.0, 0.5, 0.0]
        names = [one["name"] for one in around["cameras"]]
        assert names == ["held-out/photos/00.jpg", "held-out/photos/04.jpg"]
        status, photo = with_token(server, around["cameras"][1]["photo"])
        assert status == 200
        (tmp_path / "photo.jpg").write_bytes(photo)
        pixels = np.asarray(Image.open(tmp_path / "photo.jpg")).astype(int)
        assert np.abs(pixels - made.views[4].image).mean() < 12
        fitted.save(folder / "scene.ply")
        with followed:
            pass  # the run ends
        state = state_of(server)
        assert [one["label"] for one in state["models"]] == ["scene"]
        assert state["run"] is None


def test_scenes_of_an_earlier_run_are_labeled(tmp_path):
    model().save(tmp_path / "scene.ply")
    os.utime(tmp_path / "scene.ply", (1e9, 1e9))
    followed = FollowedRun(tmp_path)
    followed.show(scenes.capture(views=2, size=8), (0.0, 0.0, 0.0))
    followed(Event("fit", part=0.0))
    (tmp_path / "checkpoint.npz").write_bytes(b"damaged")
    with served(tmp_path) as server:
        labels = [one["label"] for one in state_of(server)["models"]]
        assert labels == ["scene of an earlier run", "being fitted"]
        status, content = with_token(server, "model?id=checkpoint")
        assert status == 422
        assert b"checkpoint.npz" in content


def test_a_refinement_has_rounds_and_their_scores(tmp_path):
    for number in (0, 1, 10):
        model(0).save(tmp_path / "rounds" / str(number) / "scene.ply")
    (tmp_path / "rounds" / "x").mkdir()
    rounds = [{"splats": 400, "test": {"psnr": 20.0}}, {"splats": 500, "test": None}]
    (tmp_path / "report.json").write_text(json.dumps({"rounds": rounds}))
    checkpoint = tmp_path / "checkpoints" / "whole-round2.npz"
    checkpoint.parent.mkdir()
    checkpoint.write_bytes(b"")
    with served(tmp_path) as server:
        state = state_of(server)
        assert [(one["id"], one["label"]) for one in state["models"]] == [
            ("round-0", "first fit, 20.00 dB"),
            ("round-1", "round 1"),
            ("round-10", "round 10"),
            ("checkpoint", "round 2, being fitted"),
        ]
        assert state["scores"]["rows"] == [
            ["first fit", "20.00", "400"],
            ["round 1", "–", "500"],
        ]
        os.utime(checkpoint, (1e9, 1e9))
        assert state_of(server)["newest"] == "round-10"


def test_two_scenes_have_their_own_models(tmp_path, scene):
    model(0).save(tmp_path / "other.spz")
    with served(scene, tmp_path / "other.spz") as server:
        models = state_of(server)["models"]
        assert [one["label"] for one in models] == ["scene.ply", "other.spz"]
        first, second = (with_token(server, f"model?id={one['id']}")[1] for one in models)
        assert first != second


@pytest.mark.parametrize(
    "text",
    [
        "",
        "[]",
        "{",
        '{"rounds": [3, null, {"test": [], "splats": {"before": 1}}]}',
        '{"rounds": {}, "psnr": "high", "protocol": 7, "train": []}',
        '{"psnr": NaN, "text": 3, "done": 1, "background": [1, 2]}',
        '{"psnr": 1' + 400 * "0" + ', "text": "x", "done": 1e999, "background": [1, 2, "3"]}',
        "[" * 100_000,
    ],
)
def test_damaged_files_of_a_run_are_ignored(tmp_path, text):
    (tmp_path / "view").mkdir()
    for name in ("report.json", "view/progress.json", "view/run.json", "view/cameras.json"):
        (tmp_path / name).write_text(text)
    with served(tmp_path) as server:
        state = state_of(server)
        assert state["run"] is None
        assert with_token(server, "surroundings")[0] == 200
    assert run_background(tmp_path) is None


def test_a_run_without_news_is_labeled(tmp_path, monkeypatch):
    folder = tmp_path / "view"
    folder.mkdir()
    (folder / "progress.json").write_text('{"text": "fit", "done": 7}')
    assert run_progress(tmp_path) == {"text": "fit", "done": 1.0}
    os.utime(folder / "progress.json", (time.time() - 1200, time.time() - 1200))
    assert "no news for 20 min" in run_progress(tmp_path)["text"]
    (tmp_path / "report.json").write_text('{"psnr": 20, "ssim": 0.5, "protocol": {}}')
    assert run_scores(tmp_path)["rows"] == [], "the report is of an earlier run"
    (folder / "progress.json").unlink()
    (row,) = run_scores(tmp_path)["rows"]
    assert row == ["fitted photos", "20.00", "0.5000", run_folder.MISSING]


@pytest.fixture
def environment(tmp_path):
    """Variables of a process without a display and programs."""
    hidden = ("DISPLAY", "WAYLAND_DISPLAY", "SSH_CONNECTION")
    kept = {name: value for name, value in os.environ.items() if name not in hidden}
    return {**kept, "PATH": str(tmp_path)}


@pytest.mark.skipif(os.name == "nt", reason="Ctrl-C is a signal here")
@pytest.mark.parametrize(
    ("options", "notices"),
    [
        (["--web"], ["Press Ctrl-C to stop."]),
        ([], ["There is no display", "Press Ctrl-C to stop."]),
        (["--web", "--host", "0.0.0.0"], ["is open to other computers", "Press Ctrl-C to stop."]),
    ],
)
def test_the_command_serves_until_ctrl_c(tmp_path, environment, scene, options, notices):
    url, state, status, errors = view_until_ctrl_c(tmp_path, environment, scene, *options)
    assert status == 0, errors
    assert state["newest"] == "scene"
    assert "0.0.0.0" in options or url.startswith("http://127.0.0.1:")
    lines = errors.splitlines()
    assert len(lines) == len(notices), errors
    for line, notice in zip(lines, notices, strict=True):
        assert notice in line


def test_sigterm_while_a_scene_is_read_is_one_sentence(tmp_path, environment):
    temporary = tmp_path / "temporary"
    temporary.mkdir()
    scenes.splats(count=200_000).save(tmp_path / "scene.ply")
    variables = {**environment, "TMPDIR": str(temporary)}
    process = started_view(tmp_path, variables, "--web", "scene.ply")
    address = urlsplit(process.stdout.readline().strip())
    assert any(temporary.iterdir())
    with socket.create_connection((address.hostname, address.port)) as connection:
        connection.sendall(f"GET {address.path}model?id=scene HTTP/1.0\r\n\r\n".encode())
        time.sleep(0.05)
        process.send_signal(signal.SIGTERM)
        _, errors = process.communicate(timeout=60)
    assert process.returncode == 128 + signal.SIGTERM
    assert errors == "Press Ctrl-C to stop.\nInterrupted.\n"
    assert not any(temporary.iterdir())


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["no.ply", "--web"], "There is no file or folder no.ply"),
        (["no.ply"], "There is no file or folder no.ply"),
        (["SCENE", "--web", "--camera", "3"], "--camera is an option of splat-view"),
        (["SCENE", "--camera", "3"], "--camera needs a window, and there is no display"),
        (["damaged.ply", "--web"], "damaged.ply"),
        (["SCENE", "--web", "--host", "192.0.2.1"], "Cannot listen at 192.0.2.1"),
        (["SCENE", "--web", "--cameras", "no"], "no"),
    ],
)
def test_wrong_arguments_are_errors(tmp_path, environment, scene, words, message):
    (tmp_path / "damaged.ply").write_text("no splats")
    words = [scene if word == "SCENE" else word for word in words]
    process = started_view(tmp_path, environment, *words)
    out, errors = process.communicate(timeout=60)
    assert process.returncode == 1
    assert out == ""
    assert message in errors.splitlines()[-1]
    assert "Traceback" not in errors
