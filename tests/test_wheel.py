"""The wheel in a separate environment: no Rust, no torch, no source of igsr."""

from __future__ import annotations

import base64
import json
import os
import platform
import re
import shutil
import subprocess
import sys
import time
import zipfile
from importlib import metadata
from pathlib import Path

import apps
import pytest
from packaging.requirements import Requirement
from PIL import Image
from web_views import view_until_ctrl_c

pytestmark = [
    pytest.mark.long,
    pytest.mark.skipif(os.name == "nt", reason="make wheel is for POSIX shells"),
]

ROOT = Path(__file__).parents[1]
#: A limit on the wheel's size, in bytes: the example is 0.8 MB of it, the viewer about 4.
LARGEST = 13_000_000


@pytest.fixture(scope="module")
def wheel():
    """The wheel that `make wheel` builds."""
    before = time.time()
    made = subprocess.run(["make", "wheel"], cwd=ROOT, capture_output=True, text=True)
    assert made.returncode == 0, made.stderr
    newest = max((ROOT / "dist").glob("*.whl"), key=lambda path: path.stat().st_mtime)
    assert newest.stat().st_mtime >= before - 1.0
    return newest


class Clean:
    """An environment with the wheel and its requirements, and a folder to run commands in."""

    def __init__(self, folder: Path, wheel: Path) -> None:
        self.folder = folder
        subprocess.run([sys.executable, "-m", "venv", str(folder / "venv")], check=True)
        self.bin = folder / "venv" / "bin"
        self.variables = {
            "PATH": os.pathsep.join([str(self.bin), "/usr/bin", "/bin"]),
            "HOME": str(folder),
            "LANG": "C.UTF-8",
        }
        kept = ("PIP_", "HTTP", "http", "NO_PROXY", "no_proxy", "SSL_", "REQUESTS_")
        self.variables |= {
            name: value for name, value in os.environ.items() if name.startswith(kept)
        }
        self.run("python", "-m", "pip", "install", "--quiet", str(wheel))

    def run(self, *words: str, status: int = 0) -> subprocess.CompletedProcess[str]:
        """Run a program of the environment, and say how long it took."""
        started = time.perf_counter()
        result = subprocess.run(
            [str(self.bin / words[0]), *words[1:]],
            cwd=self.folder,
            env=self.variables,
            capture_output=True,
            text=True,
            timeout=600,
        )
        print(f"{time.perf_counter() - started:6.1f} s  {' '.join(words)}")
        assert result.returncode == status, result.stderr
        return result


def size_of(folder: Path) -> int:
    """Bytes of the files in a folder; links are not followed."""
    return sum(file.lstat().st_size for file in folder.rglob("*"))


@pytest.fixture(scope="module")
def clean(wheel, tmp_path_factory):
    made = Clean(tmp_path_factory.mktemp("clean"), wheel)
    for program in ("cargo", "rustc", "maturin"):
        assert shutil.which(program, path=made.variables["PATH"]) is None
    return made


@pytest.fixture(scope="module")
def fitted(clean):
    """Output of a short fit of the example."""
    words = ["fit", "--example", "--out", "out", "--steps", "60", "--backend", "cpu", "--json"]
    return json.loads(clean.run("igsr", *words).stdout)


def test_one_wheel_serves_every_python_and_is_small(wheel):
    print(f"{wheel.stat().st_size / 1e6:.1f} MB  {wheel.name}")
    assert "-cp310-abi3-" in wheel.name
    if sys.platform == "linux":
        assert f"manylinux2014_{platform.machine()}" in wheel.name
    assert wheel.stat().st_size < LARGEST
    with zipfile.ZipFile(wheel) as archive:
        names = archive.namelist()
        metadata = next(name for name in names if name.endswith(".dist-info/METADATA"))
        lines = archive.read(metadata).decode().splitlines()
    assert {name.split("/")[0].split("-")[0] for name in names} == {"igsr"}
    needs = [line for line in lines if line.startswith("Requires-Dist: torch")]
    assert needs
    assert all(re.search(r"extra == ['\"](refine|matching|app)['\"]", line) for line in needs), (
        needs
    )


def test_torch_is_not_installed(clean):
    installed = json.loads(clean.run("python", "-m", "pip", "list", "--format=json").stdout)
    assert "igsr" in {one["name"] for one in installed}
    assert not {one["name"] for one in installed} & {"torch", "torchmetrics"}
    size = size_of(clean.folder / "venv")
    print(f"{size / 1e6:.0f} MB in the environment")
    assert size < 700e6


def test_the_example_is_fitted_and_scored(clean, fitted):
    assert (fitted["photos"]["train"], fitted["photos"]["test"]) == (8, 8)
    assert fitted["psnr"] > 15.0
    assert fitted["ms_ssim"] > 0.3
    for name in ("scene.ply", "scene.html", "report.html", "views.png", "example/test/000.png"):
        assert (clean.folder / "out" / name).is_file()


@pytest.mark.parametrize("target", ["scene.sog", "page.html"])
def test_the_scene_is_converted(clean, fitted, target):
    clean.run("igsr", "convert", "out/scene.ply", target)
    assert (clean.folder / target).stat().st_size > 10_000


def test_the_scene_is_rendered(clean, fitted):
    words = ["out/scene.ply", "--cameras", "out/example", "--out", "views", "--backend", "cpu"]
    clean.run("igsr", "render", *words)
    assert len(list((clean.folder / "views").glob("**/*.png"))) >= 8
    clean.run("igsr", "render", "out/scene.ply", "--orbit", "2", "--out", "turn.mp4")
    assert (clean.folder / "turn.mp4").stat().st_size > 1000


def test_the_viewer_draws_what_a_photo_shows(clean, fitted):
    assert "splat-view" in clean.run("splat-view", "--help").stdout
    words = ["out", "--frames", "frames", "--orbit", "2", "--size", "60x60", "--backend", "cpu"]
    clean.run("splat-view", *words)
    first = Image.open(clean.folder / "frames" / "0000.png")
    assert first.size == (60, 60)
    # The photos have alpha: the fit's background is white.
    assert first.getpixel((0, 0)) == (255, 255, 255)
    words = ["out", "--screenshot", "view.png", "--size", "60x60", "--backend", "cpu"]
    clean.run("igsr", "view", *words)
    assert (clean.folder / "view.png").read_bytes() == (
        clean.folder / "frames" / "0000.png"
    ).read_bytes()


def test_the_browser_view_answers_until_ctrl_c(clean, fitted):
    started = time.perf_counter()
    # Without a display it is the browser view.
    program = [str(clean.bin / "igsr")]
    _, state, status, errors = view_until_ctrl_c(
        clean.folder, clean.variables, "out", program=program
    )
    assert state["newest"] == "scene"
    print(f"{time.perf_counter() - started:6.1f} s  igsr view out, answer and end")
    assert status == 0, errors
    assert "There is no display" in errors


#: Packages that are linked because they are large; pip will not replace them.
LINKED = ("torch", "nvidia", "triton")


def copy_with_requirements(wanted: Requirement, folder: Path, copied: set[str]) -> None:
    """Copy an installed package and its requirements."""
    copied.add(str(wanted))
    package = metadata.distribution(wanted.name)
    for top in {Path(file).parts[0] for file in package.files or []} - {"..", "__pycache__"}:
        source = Path(str(package.locate_file(top)))
        if (folder / top).exists():
            continue
        if top in LINKED:
            (folder / top).symlink_to(source)
        elif source.is_dir():
            shutil.copytree(source, folder / top)
        else:
            shutil.copy(source, folder / top)
    for need in map(Requirement, package.requires or []):
        extras = {"", *wanted.extras}
        holds = need.marker is None or any(need.marker.evaluate({"extra": e}) for e in extras)
        if holds and str(need) not in copied:
            copy_with_requirements(need, folder, copied)


def test_the_commands_of_the_container_serve_the_app(wheel, tmp_path):
    """All but those for root and for PyTorch, which is copied: PyPI does not have its CPU build."""
    lines = (ROOT / "examples" / "app" / "Containerfile").read_text().splitlines()
    commands = [line.partition(" ")[2] for line in lines if line.startswith(("RUN", "CMD"))]
    of_root, torch, install, user, serve = commands
    assert of_root.startswith("apt-get")
    assert torch.startswith("pip install --no-cache-dir torch --index-url")
    assert user.startswith("useradd")
    made = Clean(tmp_path, wheel)
    site = next((tmp_path / "venv").glob("lib/python*/site-packages"))
    copy_with_requirements(Requirement("torch"), site, set())
    before = size_of(site)
    started = time.perf_counter()
    install = install.replace("/tmp/igsr-*.whl", str(wheel))
    subprocess.run(["bash", "-c", install], env=made.variables, cwd=tmp_path, check=True)
    seconds = time.perf_counter() - started
    print(f"{seconds:.0f} s, {(size_of(site) - before) / 1e6:.0f} MB more for igsr[app]")
    port = "7898"
    process = subprocess.Popen(
        ["bash", "-c", f"exec {serve.replace('7860', port)}"],
        env={**made.variables, "IGSR_PASSWORD": "secret"},
        cwd=tmp_path,
        stdout=subprocess.PIPE,
        text=True,
    )
    try:
        assert process.stdout.readline().strip() == f"http://0.0.0.0:{port}/"
        login = ("Authorization", "Basic " + base64.b64encode(b"igsr:secret").decode())
        address = f"http://127.0.0.1:{port}"
        assert apps.answered(address)[0] == 401
        assert apps.answered(address, headers=[login])[0] == 200
    finally:
        process.terminate()
        process.communicate(timeout=30)


def test_refine_names_the_extra(clean):
    result = clean.run("igsr", "refine", "--example", "--out", "refined", status=1)
    assert result.stderr.strip() == "igsr refine needs torch: pip install 'igsr[refine]'."
    assert not (clean.folder / "refined").exists()
