"""The server of ``igsr view --web`` under load: slow clients, large captures, foreign hosts."""

import contextlib
import json
import resource
import socket
import sys
import threading
import time

import psutil
import pytest
import scenes
from scene_pages import model
from web_views import served, state_of, with_token

from igsr.capture.write_transforms import write_cameras
from igsr.rendering import live_server, live_view, run_folder

CLIENTS = 500
#: Seconds of load, and the longest answer. The short test shares its cores with others.
LOADS = [(2.5, 3.0), pytest.param(30.0, 1.0, marks=pytest.mark.long)]
MOST_MEMORY = 100e6
MODEL = bytes(20_000_000)

#: Slow clients: the first bytes that they send, and the next ones, repeatedly. None reads.
SLOW = {
    "silent": (b"", b""),
    "one byte at a time": (b"G", b"x"),
    "long lines": (b"GET / HTTP/1.0\r\n", b"name: " + 60_000 * b"x" + b"\r\n"),
    "many lines": (b"GET / HTTP/1.0\r\n", 100 * b"a: b\r\n"),
    "never read": (b"GET /TOKEN/model?id=scene HTTP/1.0\r\n\r\n", b""),
    "no page": (b"GET /TOKEN/nothing HTTP/1.0\r\n", b"a: b\r\n"),
}


@pytest.fixture
def scene(tmp_path, monkeypatch):
    monkeypatch.setattr(live_view, "_packed", lambda found: MODEL)
    model().save(tmp_path / "scene.ply")
    return tmp_path / "scene.ply"


@pytest.fixture
def many_files():
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    resource.setrlimit(resource.RLIMIT_NOFILE, (min(hard, 4096), hard))
    yield
    resource.setrlimit(resource.RLIMIT_NOFILE, (soft, hard))


class SlowClients:
    """Slow clients that connect again whenever they are disconnected."""

    def __init__(self, server, kinds):
        self.address = ("127.0.0.1", server.server_port)
        token = server.token.encode()
        self.sent = [[part.replace(b"TOKEN", token) for part in SLOW[kind]] for kind in kinds]
        self.clients = [None] * len(kinds)

    def step(self):
        for number, (first, next) in enumerate(self.sent):
            try:
                if self.clients[number] is None:
                    self.clients[number] = socket.create_connection(self.address, timeout=5.0)
                    self.clients[number].setblocking(False)
                    self.clients[number].send(first)
                with contextlib.suppress(BlockingIOError):
                    self.clients[number].send(next)
            except OSError:
                self.close(number)

    def close(self, number):
        if self.clients[number] is not None:
            self.clients[number].close()
        self.clients[number] = None


@pytest.mark.parametrize(("seconds", "most_s"), LOADS)
def test_slow_clients_hold_up_no_other_request(scene, many_files, seconds, most_s):
    before = psutil.Process().memory_info().rss
    threads, longest = 0, 0.0
    with served(scene) as server:
        slow = SlowClients(server, CLIENTS // len(SLOW) * list(SLOW))
        end = time.monotonic() + seconds
        while time.monotonic() < end:
            slow.step()
            for name in ("", "state", "surroundings"):
                start = time.monotonic()
                assert with_token(server, name)[0] == 200
                longest = max(longest, time.monotonic() - start)
            threads = max(threads, threading.active_count())
        memory = psutil.Process().memory_info().rss - before
        for number in range(len(slow.clients)):
            slow.close(number)
    assert longest < most_s
    assert threads < live_server.MAX_WITHOUT_TOKEN + live_server.MAX_WITH_TOKEN + 10
    assert memory < MOST_MEMORY


@pytest.mark.parametrize("kind", SLOW)
def test_each_request_has_a_deadline(scene, monkeypatch, kind):
    for name in ("REQUEST_TIMEOUT_S", "ANSWER_TIMEOUT_S"):
        monkeypatch.setattr(live_server, name, 0.3)
    monkeypatch.setattr(live_server, "SLOWEST_BYTES_PER_S", len(MODEL) / 0.3)
    with served(scene) as server:
        accepted = []
        finish = server.finish_request

        def finish_request(request, address):
            accepted.append(address)
            finish(request, address)

        monkeypatch.setattr(server, "finish_request", finish_request)
        slow = SlowClients(server, [kind])
        slow.step()
        end = time.monotonic() + 5.0
        while not accepted:
            assert time.monotonic() < end
            time.sleep(0.01)
        while time.monotonic() < end:
            time.sleep(0.05)
            if not server._connections:
                break
            with contextlib.suppress(OSError):
                slow.clients[0].send(slow.sent[0][1])
        slow.close(0)
        assert not server._connections


def test_only_the_first_bytes_of_a_long_request_are_received(scene):
    with served(scene) as server:
        client = socket.create_connection(("127.0.0.1", server.server_port))
        client.settimeout(live_server.REQUEST_TIMEOUT_S / 2)
        client.sendall(b"GET / HTTP/1.0\r\nname: " + 2 * live_server.MAX_REQUEST_BYTES * b"x")
        with contextlib.suppress(ConnectionError):
            client.recv(100)
        client.close()


def test_a_large_answer_has_more_time(scene, monkeypatch):
    monkeypatch.setattr(live_server, "ANSWER_TIMEOUT_S", 0.2)
    with served(scene) as server:
        client = socket.create_connection(("127.0.0.1", server.server_port))
        client.sendall(SLOW["never read"][0].replace(b"TOKEN", server.token.encode()))
        time.sleep(0.5)
        received = 0
        while piece := client.recv(1 << 20):
            received += len(piece)
        client.close()
        assert received > len(MODEL)


@pytest.mark.skipif(sys.platform != "linux", reason="127.0.0.2 is an address of Linux only")
def test_those_with_the_token_are_kept_and_the_address_with_most_makes_room(scene, monkeypatch):
    monkeypatch.setattr(live_server, "MAX_WITHOUT_TOKEN", 3)
    with served(scene) as server:

        def client(address, sent):
            made = socket.create_connection(
                ("127.0.0.1", server.server_port), source_address=(address, 0)
            )
            made.sendall(sent)
            return made

        reader = client("127.0.0.1", SLOW["never read"][0].replace(b"TOKEN", server.token.encode()))
        few = client("127.0.0.2", b"G")
        many = []
        for _ in range(10):
            many.append(client("127.0.0.1", b"G"))
            assert with_token(server, "state")[0] == 200
        few.sendall(b"ET / HTTP/1.0\r\n\r\n")
        assert few.recv(100).startswith(b"HTTP/1.0 403")
        many[0].settimeout(5.0)
        assert many[0].recv(1) == b"", "the older connections are closed"
        size = 0
        while piece := reader.recv(1 << 20):
            size += len(piece)
        assert size > len(MODEL)
        for one in (reader, few, *many):
            one.close()


@pytest.fixture
def large_capture(tmp_path):
    made = scenes.capture(views=2, size=8)
    write_cameras(tmp_path / "cameras.json", made.views)
    model().save(tmp_path / "scene.ply")
    return tmp_path


def test_the_page_does_not_wait_for_cameras(large_capture, monkeypatch):
    read, reads = threading.Event(), []
    cameras_of = live_view.cameras_of

    def slowly(*given):
        reads.append(given)
        assert read.wait(60.0)
        return cameras_of(*given)

    monkeypatch.setattr(live_view, "cameras_of", slowly)
    monkeypatch.setattr(live_view, "READING_WAIT_S", 0.05)
    with served(large_capture) as server:
        assert state_of(server)["surroundings"] == ""
        for name in ("", "surroundings", "model?id=scene"):
            assert with_token(server, name)[0] == 200
        assert with_token(server, "photo?number=0")[0] == 404
        read.set()
        end = time.monotonic() + 30.0
        while state_of(server)["surroundings"] == "":
            assert time.monotonic() < end
        assert len(json.loads(with_token(server, "surroundings")[1])["cameras"]) == 2
    assert len(reads) == 1


def test_files_of_a_run_are_parsed_again_only_after_a_change(large_capture):
    report = large_capture / "report.json"
    report.write_text('{"psnr": 20, "ssim": 0.5, "protocol": {}}')
    with served(large_capture) as server:
        state_of(server)
        parsed = run_folder._parsed.cache_info().misses
        assert state_of(server)["scores"]["rows"][0][1] == "20.00"
        assert run_folder._parsed.cache_info().misses == parsed
        report.write_text('{"psnr": 21.5, "ssim": 0.5, "protocol": {}}')
        assert state_of(server)["scores"]["rows"][0][1] == "21.50"


@pytest.mark.parametrize("host", ["attacker.example", "127.0.0.1:80", "", "\x1b[2J", "a" * 5000])
def test_a_page_of_a_foreign_host_gets_nothing_without_the_token(scene, host):
    """DNS rebinding: a page of another host whose name leads here has the browser ask."""
    with served(scene) as server:
        for name in ("", "state", "model?id=scene", f"?{server.token}"):
            with socket.create_connection(("127.0.0.1", server.server_port)) as connection:
                head = f"GET /{name} HTTP/1.0\r\nHost: {host}\r\nOrigin: http://{host}\r\n\r\n"
                connection.sendall(head.encode())
                answer = b"".join(iter(lambda: connection.recv(1 << 16), b""))
            assert answer.startswith(b"HTTP/1.0 403")
            for text in (b"Access-Control", server.token.encode(), b"scene", b"attacker"):
                assert text not in answer
