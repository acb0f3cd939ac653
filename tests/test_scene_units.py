"""The unit and the origin of the world change nothing in fits, scores and renders."""

import warnings
from dataclasses import replace

import numpy as np
import pytest
import rooms
import scenes

import igsr
from igsr.blocks import BlockOptions, fit_in_blocks
from igsr.capture import Points, View
from igsr.fitting import fit_capture
from igsr.geometry.frame import Frame
from igsr.refinement.novel_views import novel_views
from igsr.splats import joined
from igsr_lab.large_scenes import towns

SCALES = (1e-4, 1e-2, 100.0, 1e4)
WORLDS = [(scale, 0.0) for scale in SCALES] + [(100.0, 5e5)]


def world(scale, shift=0.0):
    """The frame that makes worlds ``scale`` times as large and moves them by ``shift``."""
    return Frame(np.full(3, -shift / scale), 1.0 / scale)


def room():
    cameras = [rooms.camera(angle, 60.0, 72, 54) for angle in np.linspace(-0.6, 0.6, 7)]
    views = [
        View(f"{i}.png", camera, "train" if i % 3 else "test", rooms.picture(camera))
        for i, camera in enumerate(cameras)
    ]
    random = np.random.default_rng(0)
    points, colors = [], []
    for view in views:
        if view.split == "train":
            depth = rooms.depth(view.camera)
            row, column = (random.integers(0, side, 80) for side in depth.shape)
            pixel = np.stack([column + 0.5, row + 0.5, np.ones(80)])
            ray = np.linalg.inv(view.camera.K) @ pixel * depth[row, column]
            inverse = np.linalg.inv(view.camera.viewmat)
            points.append((inverse[:3, :3] @ ray + inverse[:3, 3:]).T)
            colors.append(view.image[row, column])
    return igsr.Capture("room", views, Points(np.concatenate(points), np.concatenate(colors)))


@pytest.mark.parametrize(
    "options",
    [
        {"density": "original"},
        {"density": "mcmc"},
        {"density": "mcmc", "start": "rays"},
        {"poses": "joint", "focal": "shared"},
        {"exposure": "on"},
    ],
    ids=lambda options: "-".join(options.values()),
)
@pytest.mark.parametrize(("scale", "shift"), WORLDS)
def test_fits(scale, shift, options):
    options = {**options, "steps": 60, "max_splats": 600, "backend": "cpu"}
    capture = room()
    moved = world(scale, shift).capture(capture)
    scores = []
    for one in (capture, moved):
        fitted = fit_capture(one, **options)
        score = igsr.evaluate(fitted.splats, fitted.capture, "train")
        scores.append((score.psnr, len(fitted.splats), *fitted.removed.values()))
    # UTM coordinates are rounded, and a fit with other bits is another fit.
    assert scores[1] == pytest.approx(scores[0], abs=0.1 if shift else 0.01)
    assert scores[0][0] > 12.5


def test_fits_on_the_gpu():
    capture = room()
    options = {"density": "mcmc", "steps": 40, "max_splats": 400, "backend": "gpu"}
    scores = [
        igsr.evaluate(fit_capture(one, **options).splats, one, "train").psnr
        for one in (capture, world(1e-4).capture(capture))
    ]
    assert scores[1] == pytest.approx(scores[0], abs=0.01)


@pytest.mark.parametrize("backend", ["cpu", "gpu"])
@pytest.mark.parametrize(("scale", "shift"), [*WORLDS, (1.0, 5e5)])
def test_renders(scale, shift, backend):
    frame, splats = world(scale, shift), scenes.splats(count=200)
    camera = scenes.ring_camera(0.4)
    first, second = (
        igsr.render(s, c, backend=backend).to_uint8().astype(int)
        for s, c in ((splats, camera), (frame.splats(splats), frame.camera(camera)))
    )
    assert np.abs(first - second).max() <= 2
    assert first.any()


@pytest.mark.parametrize(("scale", "shift"), WORLDS)
def test_cameras_are_refined(scale, shift):
    frame, model = world(scale, shift), scenes.splats(count=60)
    capture = scenes.capture(views=3, scene=model)
    wrong = [
        replace(view, split="test", camera=scenes.perturbed_camera(view.camera, 0.5, 0.02, 1))
        for view in capture.views
    ]
    scores = []
    for splats, views in (
        (model, wrong),
        (frame.splats(model), [frame.view(view) for view in wrong]),
    ):
        refined = igsr.refine_cameras(splats, views, (0.0, 0.0, 0.0), steps=40, backend="cpu")
        refined = igsr.Capture(capture.path, refined)
        scores.append(igsr.evaluate(splats, refined, "test", backend="cpu").psnr)
    assert scores[1] == pytest.approx(scores[0], abs=0.1)
    assert scores[0] > igsr.evaluate(model, igsr.Capture(capture.path, wrong), "test").psnr + 3.0


@pytest.mark.parametrize(("scale", "shift"), WORLDS)
def test_floaters_are_removed(scale, shift):
    frame, model = world(scale, shift), scenes.splats(count=60, degree=0)
    capture = scenes.capture(views=6, scene=model)
    # In front of a camera, and far from all others.
    front = capture.views[0].camera.center * 0.8
    floaters = scenes.round_splats(np.array([front, [9.0, 9.0, 9.0]], np.float32), size=0.1)
    dirty = joined([model, floaters])
    removed = [
        igsr.remove_floaters(splats, one, backend="cpu").removed
        for splats, one in ((dirty, capture), (frame.splats(dirty), frame.capture(capture)))
    ]
    assert removed[0] == removed[1]
    assert sum(removed[0].values()) > 0


@pytest.mark.parametrize(("scale", "shift"), WORLDS)
def test_novel_views(scale, shift):
    """Many are equally far from the photos; which of them are taken must not depend on the unit."""
    frame, model = world(scale, shift), scenes.splats(count=60)
    cameras = [scenes.ring_camera(angle) for angle in (0.0, 0.4, 0.9)]
    views = novel_views(model, cameras, 12, "cpu")
    moved = novel_views(frame.splats(model), [frame.camera(one) for one in cameras], 12, "cpu")
    assert len(views) == len(moved) > 6
    for view, other in zip(views, moved, strict=True):
        expected = frame.camera(view.camera).center
        np.testing.assert_allclose(other.camera.center, expected, rtol=1e-4, atol=1e-4 * scale)


@pytest.mark.parametrize("scale", [1e-4, 1e4])
def test_blocks(scale, tmp_path):
    town = towns.town(1, 1, 16, 48, 36, points=200, sharp=1)
    scores = []
    for name, one in (("one", town), ("other", world(scale).capture(town))):
        folder = tmp_path / name
        scenes.write_capture(folder, one)
        options = BlockOptions(blocks=2, settings={"steps": 30, "max_splats": 600})
        splats, _ = fit_in_blocks(folder, tmp_path / f"{name}-out", options)
        scores.append(igsr.evaluate(splats, one, "train").psnr)
    assert scores[1] == pytest.approx(scores[0], abs=0.1)


@pytest.mark.parametrize("density", ["original", "mcmc"])
def test_a_camera_far_outside_changes_little(density):
    capture = room()
    # Of six cameras and more, single ones do not count.
    more = [replace(capture.views[k], name=f"again-{k}.png") for k in (1, 2)]
    capture = igsr.Capture(capture.path, [*capture.views, *more], capture.points)
    views = list(capture.views)
    far = views[-1].camera.viewmat.copy()
    far[:3, 3] += [5000.0, 0.0, 0.0]
    views[-1] = replace(views[-1], camera=replace(views[-1].camera, viewmat=far))
    assert sum(view.split == "train" for view in views) == 6
    wrong = igsr.Capture(capture.path, views, capture.points)
    scores = [
        igsr.evaluate(
            fit_capture(one, density=density, steps=120, max_splats=600, backend="cpu").splats,
            capture,
            "test",
        ).psnr
        for one in (capture, wrong)
    ]
    assert scores[1] > scores[0] - 1.0


@pytest.mark.parametrize("shift", [0.0, 7.3, 1e3, 5e5])
def test_cameras_at_one_place(shift):
    """A panorama: rotations without points, wherever the tripod is."""
    views = []
    for number, angle in enumerate(np.linspace(-0.4, 0.4, 5)):
        viewmat = rooms.camera(0.0, 60.0, 72, 54).viewmat
        turn = np.array(
            [[np.cos(angle), 0, np.sin(angle)], [0, 1, 0], [-np.sin(angle), 0, np.cos(angle)]]
        )
        center = -viewmat[:3, :3].T @ viewmat[:3, 3]
        turned = np.eye(4)
        turned[:3, :3] = turn @ viewmat[:3, :3]
        turned[:3, 3] = -turned[:3, :3] @ center
        camera = replace(rooms.camera(0.0, 60.0, 72, 54), viewmat=turned)
        views.append(View(f"{number}.png", camera, "train", rooms.picture(camera)))
    capture = igsr.Capture("panorama", views)
    options = {"steps": 60, "max_splats": 600, "backend": "cpu", "start": "rays"}
    scores = []
    for one in (capture, world(1.0, shift).capture(capture)):
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            fitted = fit_capture(one, **options)
        scores.append(igsr.evaluate(fitted.splats, one, "train").psnr)
    assert scores[1] == pytest.approx(scores[0], abs=0.5)


def test_near_things_before_a_far_background_are_drawn():
    near, far = scenes.splats(count=60, degree=0), scenes.splats(count=300, degree=0, seed=1)
    near = replace(near, means=near.means * 0.3 + np.float32([0, 0, 0.5]), scales=near.scales - 2)
    far = replace(far, means=far.means * 100 + np.float32([0, 0, 300]), scales=far.scales + 6)
    both = joined([near, far])
    capture = scenes.capture(views=3)
    views = [
        replace(view, camera=Frame(np.array([0.0, 0.0, -k]), 1.0).camera(_looking(view.camera)))
        for k, view in zip((0.0, 0.05, 0.1), capture.views, strict=True)
    ]
    views = [replace(v, image=igsr.render(both, v.camera, backend="cpu").to_uint8()) for v in views]
    seen = igsr.render(both, views[0].camera, backend="cpu")
    assert (seen.expected_depth[seen.alpha > 0.5] < 2.0).any()
    window = igsr.Capture("window", views)
    kept = [
        int((igsr.remove_floaters(one, window, backend="cpu").splats.means[:, 2] < 2.0).sum())
        for one in (near, both)
    ]
    assert kept[1] > 0.8 * kept[0]


def _looking(camera):
    return replace(camera, viewmat=np.eye(4))


@pytest.mark.parametrize("jitter", [0.0, 1e-3, 1e-4])
def test_many_photos_from_one_spot(jitter):
    capture, random = room(), np.random.default_rng(0)
    views = list(capture.views)
    for number in range(30):
        viewmat = views[1].camera.viewmat.copy()
        viewmat[:3, 3] += jitter * random.normal(size=3)
        camera = replace(views[1].camera, viewmat=viewmat)
        views.append(replace(views[1], name=f"still-{number}.png", camera=camera))
    still = igsr.Capture(capture.path, views, capture.points)
    options = {"density": "mcmc", "steps": 120, "max_splats": 600, "backend": "cpu"}
    fitted = fit_capture(still, **options).splats
    assert igsr.evaluate(fitted, capture, "test").psnr > 11.0


def test_rasterization_keeps_the_near_plane_of_gsplat():
    scene = scenes.torch_scene()
    near = scenes.rasterized(scene)[0]
    assert near.equal(scenes.rasterized(scene, near_plane=0.01)[0])
    assert not near.equal(scenes.rasterized(scene, near_plane=4.0)[0])
