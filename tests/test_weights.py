"""``igsr weights``: downloads from servers that drop connections or send wrong bytes."""

from __future__ import annotations

import hashlib
import http.server
import json
import sys
import threading

import pytest
from capture_files import assert_refused
from huggingface_hub import file_download as download

from igsr.cameras.checkpoint_search import find_checkpoint
from igsr.cameras.weights import KNOWN, fetch_weights, known_weights, weights_path
from igsr.errors import IgsrError

COMMIT = "0123456789abcdef0123456789abcdef01234567"
CONTENT = {
    "model.safetensors": bytes(range(256)) * 4000,  # a megabyte
    "config.json": b'{"model_name": "da3-small"}',
}


class Server:
    """A server that answers like huggingface.co, with optional faults."""

    def __init__(self):
        self.drops = 0  # number of connections that end after a third of the rest
        self.changed = self.html = self.status = False
        self.etag = None
        self.ranges = []
        server = self

        class Handler(http.server.BaseHTTPRequestHandler):
            protocol_version = "HTTP/1.1"

            def log_message(self, *arguments):
                pass

            def do_HEAD(self):
                self.do_GET(body=False)

            def do_GET(self, body=True):
                name = self.path.split("?")[0].rsplit("/", 1)[-1]
                content = CONTENT.get(name, b"")
                if server.html or server.status:
                    content = b"<!doctype html><title>Log in</title>"
                begin = 0
                if "Range" in self.headers and body:
                    server.ranges.append(self.headers["Range"])
                    begin = int(self.headers["Range"].removeprefix("bytes=").split("-")[0])
                self.send_response(server.status or (206 if begin else 200))
                self.send_header("Content-Length", str(len(content) - begin))
                if not server.html and not server.status:
                    digest = hashlib.sha1(b"blob %d\0" % len(content) + content).hexdigest()
                    if name.endswith(".safetensors"):
                        digest = hashlib.sha256(content).hexdigest()
                    digest = server.etag or digest
                    self.send_header("ETag", f'"{digest}"')
                    self.send_header("X-Repo-Commit", COMMIT)
                    self.send_header("Accept-Ranges", "bytes")
                    if begin:
                        last = len(content) - 1
                        self.send_header("Content-Range", f"bytes {begin}-{last}/{len(content)}")
                self.end_headers()
                if not body:
                    return
                if server.changed and name == "model.safetensors":
                    content = content[:-1] + b"!"
                rest = content[begin:]
                if server.drops and name == "model.safetensors":
                    server.drops -= 1
                    self.wfile.write(rest[: len(rest) // 3])
                    self.wfile.flush()
                    self.close_connection = True
                    self.connection.close()
                    return
                self.wfile.write(rest)

        self.server = http.server.ThreadingHTTPServer(("127.0.0.1", 0), Handler)
        self.server.handle_error = lambda *arguments: None
        self.thread = threading.Thread(target=self.server.serve_forever, daemon=True)
        self.thread.start()

    @property
    def url(self):
        return f"http://127.0.0.1:{self.server.server_address[1]}"

    def close(self):
        self.server.shutdown()
        self.server.server_close()
        self.thread.join()


@pytest.fixture
def cache(tmp_path, monkeypatch):
    folder = tmp_path / "hub"
    monkeypatch.setenv("HF_HUB_CACHE", str(folder))
    for name in ("IGSR_OFFLINE", "IGSR_DA3", "HF_TOKEN"):
        monkeypatch.delenv(name, raising=False)
    return folder


@pytest.fixture
def server(cache, monkeypatch):
    monkeypatch.setattr(download.time, "sleep", lambda seconds: None)
    # The library keeps incomplete files in units of this size.
    monkeypatch.setattr(download.constants, "DOWNLOAD_CHUNK_SIZE", 1000)
    server = Server()
    monkeypatch.setenv("HF_ENDPOINT", server.url)
    yield server
    server.close()


def files_in(cache):
    """Files with content, without the notes and locks that the library keeps."""
    files = [path for path in cache.rglob("*") if path.is_file() and not path.is_symlink()]
    return [p.name for p in files if p.suffix != ".lock" and p.name != "CACHEDIR.TAG"]


def refused(name="da3-small"):
    with pytest.raises(IgsrError) as caught:
        fetch_weights(name)
    assert "\n" not in str(caught.value)
    return str(caught.value)


def test_weights_are_fetched_found_and_not_fetched_twice(server, cache):
    path = fetch_weights("da3-small")
    assert path.read_bytes() == CONTENT["model.safetensors"]
    assert (path.parent / "config.json").read_bytes() == CONTENT["config.json"]
    assert path.parent.name == COMMIT
    assert weights_path("da3-small") == path
    assert find_checkpoint("da3") == path
    assert (cache / "models--depth-anything--DA3-SMALL/refs/main").read_text() == COMMIT
    server.drops = 99  # would end every download
    assert fetch_weights("da3-small") == path


def test_dropped_connections_are_resumed(server):
    server.drops = 3
    assert fetch_weights("da3-small").read_bytes() == CONTENT["model.safetensors"]
    size = len(CONTENT["model.safetensors"])
    begins = [int(one.removeprefix("bytes=").rstrip("-")) for one in server.ranges]
    assert len(begins) == 3
    assert begins == sorted(begins)
    assert 0 <= size // 3 - begins[0] < 1000


def test_no_connection_that_lasts(server, cache, monkeypatch):
    # No byte arrives: the library gives up after some tries.
    monkeypatch.setitem(CONTENT, "model.safetensors", b"ab")
    server.drops = 99
    assert "da3-small could not be downloaded" in refused()
    assert [name for name in files_in(cache) if "incomplete" in name] == []
    assert_refused("igsr weights fetch da3-small", weights_path, "da3-small")


def test_wrong_bytes_are_removed(server, cache):
    server.changed = True
    message = "model.safetensors of depth-anything/DA3-SMALL does not have the server's hash"
    assert message in refused()
    assert KNOWN["da3-small"].path is None
    assert not any(hashlib.sha256(b).hexdigest() in files_in(cache) for b in CONTENT.values())
    server.changed = False
    path = fetch_weights("da3-small")
    assert path.read_bytes() == CONTENT["model.safetensors"]
    # Files that change in the cache are fetched again.
    path.write_bytes(b"!" + CONTENT["model.safetensors"][1:])
    assert message in refused()
    assert fetch_weights("da3-small").read_bytes() == CONTENT["model.safetensors"]


def test_an_unknown_hash_is_refused(server):
    server.etag = "abc"
    assert "does not have the server's hash" in refused()


@pytest.mark.parametrize("answer", [{"html": True}, {"status": 404}, {"status": 500}, None])
def test_a_server_of_web_pages_and_none_at_all(server, cache, answer, monkeypatch):
    if answer:
        vars(server).update(answer)
    else:
        monkeypatch.setenv("HF_ENDPOINT", "http://127.0.0.1:9")
    assert "da3-small could not be downloaded" in refused()
    assert files_in(cache) == []


def test_nothing_is_downloaded_offline(server, monkeypatch):
    monkeypatch.setenv("IGSR_OFFLINE", "1")
    assert "IGSR_OFFLINE is set, so da3-small is not downloaded" in refused()
    monkeypatch.setenv("IGSR_OFFLINE", "0")
    fetch_weights("da3-small")
    monkeypatch.setenv("IGSR_OFFLINE", "1")
    assert weights_path("da3-small").is_file()


def test_weights_for_non_commercial_use_are_not_downloaded(cache):
    message = refused("dust3r-512-dpt")
    assert "CC-BY-NC-SA-4.0, which forbids commercial use" in message
    assert "huggingface.co/naver/DUSt3R" in message
    words = "dust3r-512-dpt is not in .*; see https://hugg"
    assert_refused(words, weights_path, "dust3r-512-dpt")


def test_without_the_library(cache, monkeypatch):
    monkeypatch.setitem(sys.modules, "huggingface_hub", None)
    assert r"pip install 'igsr[weights]'" in refused()


def test_names():
    assert known_weights("da3-base").estimator == "da3"
    words = "no weights 'da3-giant'; name one of da3-base, da3-small"
    assert_refused(words, known_weights, "da3-giant")
    assert all(one.fetched == ("NC" not in one.license) for one in KNOWN.values())


def test_the_command(server, cache, igsr_here):
    listed = igsr_here("weights", "list")
    assert listed.returncode == 0, listed.stderr
    assert listed.stdout.count("not downloaded") == 3
    assert "Apache-2.0" in listed.stdout
    assert igsr_here("weights", "path", "da3-small").returncode == 1
    fetched = igsr_here("weights", "fetch", "da3-small")
    assert fetched.returncode == 0, fetched.stderr
    assert fetched.stderr.count("published under Apache-2.0") == 1
    found = igsr_here("weights", "path", "da3-small")
    assert found.stdout == fetched.stdout
    plain = json.loads(igsr_here("weights", "list", "--json").stdout)
    by_name = {row["name"]: row for row in plain["weights"]}
    assert by_name["da3-small"]["path"] == found.stdout.strip()
    assert by_name["da3-base"]["path"] is None
    assert igsr_here("weights", "fetch", "none").returncode == 1
