"""Models, cameras and comparisons that the tests of scene pages share."""

import base64
import json

import numpy as np
import scenes

import igsr
from igsr.geometry.camera_paths import look_at
from igsr.rendering.renders import render
from igsr.rendering.scene_page import PageCamera, write_scene_page

#: Largest mean difference to the renderer's picture, in 255ths.
MEAN = 1.0
BACKGROUND = (0.2, 0.4, 0.6)
#: Waits for the page in a frame, as in a notebook.
WAIT = """<script>window.igsr = { ready: new Promise((resolve) => addEventListener("load", () =>
    frames[0].igsr.ready.then(resolve))) }</script>"""
PICTURE = """
window.igsr.picture(%s, %s).then((pixels) => {
  let text = "";
  for (let i = 0; i < pixels.length; i += 32768) {
    text += String.fromCharCode(...pixels.subarray(i, i + 32768));
  }
  return btoa(text);
})"""


def model(degree=1, count=400, antialiased=False, size=1.0, origin=(0.0, 0.0, 0.0)):
    """Splats whose spherical harmonics a .spz holds without clipping."""
    made = scenes.splats(count, degree, seed=degree, origin=origin)
    made.sh[:, 1:] = np.clip(0.3 * made.sh[:, 1:], -0.9, 0.9)
    made.means *= size
    made.scales += np.float32(np.log(size) - 1.0)
    made.antialiased = antialiased
    return made


def three_cameras(size=1.0, origin=(0.0, 0.0, 0.0)):
    """From above, below and the side, so that no basis function stays small."""
    middle = np.asarray(origin, dtype=float)
    K = np.array([[240.0, 0.0, 76.0], [0.0, 250.0, 83.0], [0.0, 0.0, 1.0]])
    places = size * np.array([(0.6, -1.9, -2.2), (2.1, 1.6, 1.4), (-2.8, -0.3, 0.9)])
    viewmats = [look_at(middle + at, middle, np.array([0.0, -1.0, 0.0])) for at in places]
    return [igsr.Camera(viewmat, K, 160, 144) for viewmat in viewmats]


def named(cameras):
    return [PageCamera(f"photo {k}", camera) for k, camera in enumerate(cameras)]


def opened(browser, path, splats, cameras=(), background=BACKGROUND):
    write_scene_page(path, splats, cameras, background)
    browser.open(path)
    assert browser.run("window.igsr.error") is None
    return path


def drawn(browser, camera, timeout=60.0):
    """The page's picture of a camera, int [H, W, 3]."""
    K = camera.K
    lens = [K[0, 0], K[1, 1], K[0, 2], K[1, 2], camera.width, camera.height]
    rows = camera.viewmat[:3].ravel().tolist()
    text = browser.run(PICTURE % (json.dumps(rows), json.dumps([float(n) for n in lens])), timeout)
    pixels = np.frombuffer(base64.b64decode(text), np.uint8)
    return pixels.reshape(camera.height, camera.width, 4)[::-1, :, :3].astype(int)


def picture(splats, camera, background):
    """The renderer's picture, int [H, W, 3]."""
    return render(splats, camera, background, backend="cpu").to_uint8().astype(int)


def check_pictures(browser, splats, cameras, background=BACKGROUND):
    for camera in cameras:
        expected = picture(splats, camera, background)
        assert expected.std() > 20, "the scene is not in the picture"
        assert np.abs(drawn(browser, camera) - expected).mean() <= MEAN
