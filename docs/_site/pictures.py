"""Make pictures of the guides from the example capture, in about four minutes on two cores.

    python docs/_site/pictures.py

Needs a Chromium browser for the picture of the report.
"""

from __future__ import annotations

import subprocess
import sys
import tempfile
from dataclasses import replace
from pathlib import Path

import numpy as np
from PIL import Image

import igsr
from igsr.denoiser import photo_sources, photo_support, render_buffers

ROOT = Path(__file__).parents[2]
EXAMPLE = ROOT / "examples" / "tea_table"
WHITE = (1.0, 1.0, 1.0)

sys.path.insert(0, str(ROOT / "tests"))
from browser import Browser  # noqa: E402


def save(name: str, image: Image.Image, width: int = 768) -> None:
    """Save docs/images/NAME.jpg, ``width`` pixels wide."""
    path = ROOT / "docs" / "images" / f"{name}.jpg"
    image = image.convert("RGB").resize((width, width * image.height // image.width))
    image.save(path, quality=80, optimize=True)
    print(f"{path}: {path.stat().st_size / 1000:.0f} kB")


def strip(images: list[np.ndarray]) -> Image.Image:
    """8-bit images of one height, from left to right."""
    return Image.fromarray(np.concatenate(images, axis=1))


def run(*words: object) -> None:
    igsr_program = Path(sys.executable).with_name("igsr")
    subprocess.run([igsr_program, *map(str, words)], check=True)


def main() -> None:
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        run("pose", EXAMPLE / "train", "--matcher", "sift", "--out", folder / "posed", "--plot")
        with Image.open(folder / "posed" / "poses.png") as plot:
            save("poses", plot, width=1000)

        run("fit", "--example", "--out", folder / "eight")
        with Browser(folder / "profile", size=(900, 1420)) as browser:
            browser.load(folder / "eight" / "report.html")
            browser.run("frames[0].igsr.ready.then(() => true)")
            browser.run("new Promise((resolve) => setTimeout(resolve, 3000))")  # the first frame
            browser.screenshot(folder / "report.png")
        with Image.open(folder / "report.png") as page:
            save("report", page, width=600)
        eight = igsr.Splats.load(folder / "eight" / "scene.ply")

    capture = igsr.load_capture(EXAMPLE)
    view = capture.test_views[0]
    few = replace(capture, views=[*capture.train_views[::10], view])
    four = igsr.fit(few, max_splats=20_000).splats
    forty = igsr.fit(capture, max_splats=20_000).splats
    scenes = (four, eight, forty)
    save("few_photos", strip([igsr.render(s, view.camera, WHITE).to_uint8() for s in scenes]))

    support = photo_support(four, few.train_views)
    buffers = render_buffers(four, view.camera, support, WHITE)
    cleaned, confidence = igsr.denoise(buffers, photo_sources(four, few.train_views, WHITE))
    images = [
        igsr.render(four, view.camera, WHITE).to_uint8(),
        *(np.rint(255 * x).astype(np.uint8) for x in (cleaned, np.stack(3 * [confidence], -1))),
    ]
    save("denoised", strip(images))


if __name__ == "__main__":
    main()
