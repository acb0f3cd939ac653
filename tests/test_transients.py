"""Things that are in one photo and not in the others: found and masked; nothing else is."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import refinements
import scenes

import igsr
from igsr.capture import Capture, Points, View
from igsr.capture.write_transforms import write_transforms
from igsr.fitting import checkpoint as checkpoints
from igsr.fitting import fit_capture
from igsr.fitting import run as fitting
from igsr.fitting.transient_search import PARAMETERS, TransientSearch
from igsr.floaters.photo_evidence import behind_masks
from igsr.rendering.renders import render
from igsr.splats import Splats
from igsr.transients import PLAIN, find_transients
from igsr.transients.regions import box_sums, dilated, eroded, labels

SIZE = 96


def wall(depth=0.0, count=90, seed=0):
    """A wall of flat, opaque splats across the cameras' view, its colors of soft edges.

    They are small: which of two neighbors is drawn first differs with the side one looks from.
    """
    random = np.random.default_rng(seed)
    x, y = np.meshgrid(np.linspace(-2.2, 2.2, count), np.linspace(-2.2, 2.2, count))
    means = np.stack([x, y, np.full_like(x, depth)], axis=-1).reshape(-1, 3)
    knots = random.uniform(0.1, 0.9, size=(10, 10, 3))
    at = np.linspace(0.0, 9.0, count)
    near = np.maximum(0.0, 1.0 - np.abs(at[:, None] - np.arange(10.0)))
    colors = np.einsum("yi,xj,ijc->yxc", near, near, knots).reshape(-1, 3)
    return Splats(
        means=means.astype(np.float32),
        quats=np.tile(np.array([1, 0, 0, 0], np.float32), (len(means), 1)),
        scales=np.log(np.tile(np.array([0.03, 0.03, 0.01], np.float32), (len(means), 1))),
        opacities=np.full(len(means), 2.0, np.float32),
        sh=((colors - 0.5) / 0.2820948).astype(np.float32)[:, None],
        origin=np.zeros(3),
    )


WALL = wall()


def photos(count=6, scene=WALL):
    """Photos of the wall along an arc of 40 degrees, all of them to fit."""
    views = []
    for k in range(count):
        camera = scenes.ring_camera(np.radians(40.0 * (k / (count - 1) - 0.5)), SIZE)
        image = render(scene, camera, backend="cpu").to_uint8()
        views.append(View(f"photos/{k}.png", camera, "train", image))
    return views


def with_figure(view, top=30, left=40, height=34, width=16, color=(10, 250, 40)):
    """The photo with a green figure in it, and where that is."""
    image, where = view.image.copy(), np.zeros(view.image.shape[:2], np.bool_)
    where[top : top + height, left : left + width] = True
    image[where] = color
    return replace(view, image=image), where


def found_in(views, scene=WALL, before=None, **options):
    before = [None] * len(views) if before is None else before
    return find_transients(scene, views, before, backend="cpu", **options)


def test_a_figure_in_one_photo_is_found_there_alone():
    views = photos()
    views[2], where = with_figure(views[2])
    masks = found_in(views, least=PLAIN)
    assert [k for k, mask in enumerate(masks) if mask is not None] == [2]
    assert masks[2].dtype == np.bool_
    assert masks[2][where].mean() > 0.97
    assert (masks[2] & ~dilated(where, 6)).sum() == 0


def test_figures_at_one_place_in_two_of_six_photos_are_found():
    views = photos()
    for k in (1, 4):
        views[k], _ = with_figure(views[k])
    masks = found_in(views)
    assert [k for k, mask in enumerate(masks) if mask is not None] == [1, 4]


def test_three_photos_are_enough_and_two_are_not():
    views = photos(3)
    views[0], where = with_figure(views[0])
    masks = found_in(views)
    assert masks[0][where].mean() > 0.9
    assert masks[1] is masks[2] is None
    assert found_in(views[:2]) == [None, None]


def brighter(view):
    return replace(view, image=np.clip(1.8 * view.image, 0, 255).astype(np.uint8))


def noisy(view):
    noise = np.random.default_rng(0).normal(scale=12.0, size=view.image.shape)
    return replace(view, image=np.clip(view.image + noise, 0, 255).astype(np.uint8))


def highlit(view):
    """A small highlight, as things that shine have it from one side."""
    image = view.image.copy()
    image[40:43, 40:43] = 255
    return replace(view, image=image)


@pytest.mark.parametrize("change", [lambda view: view, brighter, noisy, highlit])
def test_static_photos_are_left_alone(change):
    views = photos()
    views[2] = change(views[2])
    assert found_in(views) == [None] * len(views)


def test_what_others_have_as_white_may_be_any_bright_color():
    views = photos()
    cut = [brighter(view) for view in views]
    assert (cut[0].image == 255).mean() > 0.1
    cut[2] = views[2]
    assert found_in(cut)[2] is None


def test_a_wrong_surface_is_not_taken_for_a_thing():
    """A board before the wall that the scene does not have yet: the photos show it at one depth."""
    board = wall(depth=-1.0, count=20, seed=5)
    board.means[:, :2] *= 0.2
    both = replace(
        WALL,
        **{
            name: np.concatenate([getattr(WALL, name), getattr(board, name)])
            for name in ("means", "quats", "scales", "opacities", "sh")
        },
    )
    views = photos(scene=both)
    without = [
        np.abs(v.image.astype(int) - p.image).max() for v, p in zip(views, photos(), strict=True)
    ]
    assert min(without) > 60, "the board is seen"
    # What the board hides from all but the outermost photos is theirs alone.
    assert found_in(views)[1:-1] == [None] * (len(views) - 2)


def test_masked_photos_are_no_witnesses_and_pseudo_views_are_not_asked():
    views = photos(4)
    views[0], where = with_figure(views[0])
    hidden = np.zeros(where.shape, np.bool_)
    # Two others are hidden: the one left is no two witnesses.
    some = [views[0], views[1], *(replace(view, mask=hidden) for view in views[2:])]
    assert found_in(some)[0] is None
    assert found_in(views, before=[None, None, ~hidden, ~hidden])[0] is None
    ones = np.ones(where.shape, np.float32)
    pseudo = [replace(view, weights=ones) for view in views[2:]]
    assert found_in([*views[:2], *pseudo]) == [None] * 4
    assert found_in([replace(views[0], weights=ones), *views[1:]]) == [None] * 4


def test_small_things_count_only_where_they_are_asked_for():
    views = photos()
    views[2], _ = with_figure(views[2], height=8, width=8)
    assert found_in(views)[2] is not None
    assert found_in(views, least=0.02) == [None] * len(views)


def test_regions():
    mask = np.zeros((7, 9), np.bool_)
    mask[1, 1] = mask[2, 2] = mask[5, 6:8] = True
    number = labels(mask)
    assert number[1, 1] == number[2, 2] != number[5, 6] == number[5, 7]
    assert sorted(np.unique(number)) == [0, 1, 2]
    assert (labels(np.ones((3, 4), np.bool_)) == 1).all()
    assert (labels(np.zeros((3, 4), np.bool_)) == 0).all()
    # A snake's pixels are one region, however far apart.
    snake = np.zeros((9, 9), np.bool_)
    snake[::2] = True
    snake[1, 8] = snake[3, 0] = snake[5, 8] = snake[7, 0] = True
    assert labels(snake).max() == 1
    assert dilated(mask, 1)[:3, :3].all()
    assert not dilated(mask, 1)[0, 3]
    assert not eroded(mask, 1).any()
    assert eroded(np.ones((3, 3), np.bool_), 2).all()
    sums = box_sums(mask, 1)
    assert sums[1, 1] == 2
    assert sums[6, 8] == 1
    assert sums[0, 8] == 0


@pytest.fixture(scope="module")
def static():
    colors = np.clip(255.0 * (0.5 + 0.2820948 * WALL.sh[:, 0]), 0, 255).astype(np.uint8)
    return Capture(Path("made-up"), photos(), Points(WALL.means.astype(np.float64), colors))


@pytest.fixture(scope="module")
def visited(static):
    """Photos with a figure in two of them, each at another place."""
    views = list(static.views)
    views[1], _ = with_figure(views[1])
    views[4], _ = with_figure(views[4], left=20)
    return Capture(static.path, views, static.points)


OPTIONS = {
    "steps": 120,
    "backend": "cpu",
    "max_splats": 9000,
    "density": "fixed",
    "coarse_to_fine": False,
    "start": "points",
    "sh_degree": 2,
    "dropout": 0.0,
    "learning_rate": 3.0,
    "remove_floaters": False,
    "backdrop": False,
}


def fitted(capture, **options):
    return scenes.fit_with_cameras(capture, **{**OPTIONS, **options})


def test_a_static_capture_has_the_bits_of_a_fit_that_does_not_look(static):
    off, _ = fitted(static, transients="off")
    auto, same = fitted(static)
    assert auto == off
    assert same is static


def test_a_fit_does_not_learn_what_one_photo_shows(static, visited):
    told = []
    off, _ = fitted(visited, transients="off")
    splats, found = fitted(visited, progress=told.append)
    assert set(told[-1].transients) == {"photos/1.png", "photos/4.png"}
    for view in found.train_views:
        part = told[-1].transients.get(view.name, 0.0)
        assert part == (0.0 if view.mask is None else pytest.approx(1.0 - view.mask.mean()))
    photo, (_, where) = static.views[1], with_figure(static.views[1])
    off, on = (
        np.abs(render(one, photo.camera, backend="cpu").color - photo.image / 255.0)[where].mean()
        for one in (off, splats)
    )
    assert on < 0.7 * off


def test_a_fit_begins_anew_with_the_first_masks(visited, monkeypatch):
    monkeypatch.setattr(fitting, "CHUNK_SECONDS", 0.0)
    real = fit_capture.initial_state
    beginnings = []

    def counted(*arguments):
        state, (made_from, count) = real(*arguments)
        beginnings.append([view.mask is None for view in arguments[0].train_views])
        return state, (f"{made_from}, {len(beginnings)}", count)

    monkeypatch.setattr(fit_capture, "initial_state", counted)
    told = []
    fitted(visited, progress=told.append)
    steps = [now.step for now in told]
    back = [k for k in range(1, len(steps)) if steps[k] < steps[k - 1]]
    assert len(back) == 1
    assert steps[back[0] - 1] == round(0.3 * OPTIONS["steps"])
    assert not told[back[0] - 1].transients
    assert told[back[0]].transients
    assert beginnings == [[True] * 6, [True, False, True, True, False, True]]
    # What the report says it began with is what it began anew with.
    assert told[0].started == ("points, 1", 8100)
    assert told[-1].started == ("points, 2", 8100)
    assert steps[-1] == OPTIONS["steps"]
    # Splats that were given are kept: nobody knows how they came about.
    told.clear()
    fitted(visited, progress=told.append, start=WALL, sh_degree=0)
    assert told[-1].transients
    assert [now.step for now in told] == sorted(now.step for now in told)


def test_a_fit_goes_on_where_too_little_is_left_to_begin_with(visited, monkeypatch):
    whole, _ = fitted(visited)
    real = fit_capture.initial_state
    calls = []

    def once(*arguments):
        calls.append(arguments)
        if len(calls) > 1:
            raise igsr.IgsrError("depth maps agree in 8 points only")
        return real(*arguments)

    monkeypatch.setattr(fit_capture, "initial_state", once)
    told = []
    splats, _ = fitted(visited, progress=told.append)
    assert len(calls) == 2
    assert told[-1].transients
    assert splats != whole


def with_ghost(view):
    """The wall, and first a green splat close before a camera, as it comes of a figure."""
    at = np.linalg.inv(view.camera.viewmat) @ np.array([0.0, 0.0, 1.0, 1.0])
    ghost = {name: getattr(WALL, name)[:1].copy() for name in PARAMETERS}
    ghost["means"][0], ghost["scales"][0] = at[:3], np.log(0.02)
    ghost["sh"][0, 0] = (-1.6, 1.7, -1.2)
    parts = {name: np.concatenate([ghost[name], getattr(WALL, name)]) for name in PARAMETERS}
    return replace(WALL, **parts)


def test_what_only_masked_pixels_show_is_told(static):
    both = with_ghost(static.views[1])
    cameras = [view.camera for view in static.views]
    regions = [None] * len(cameras)
    assert not behind_masks(both, cameras, regions, backend="cpu").any()
    regions[1] = np.zeros((SIZE, SIZE), np.bool_)
    regions[1][36:60, 36:60] = True
    ghosts = behind_masks(both, cameras, regions, backend="cpu")
    assert ghosts[0]
    assert not ghosts[1:].any(), "the others show the wall"
    regions[1][:] = False
    regions[1][:4] = True
    assert not behind_masks(both, cameras, regions, backend="cpu").any()


def test_a_look_takes_a_ghost_out_of_the_splats(visited):
    both = with_ghost(visited.views[1])
    given = {"start": both, "sh_degree": 0, "steps": 60}
    kept, _ = fitted(visited, transients="off", **given)
    assert len(kept) == len(both)
    splats, _ = fitted(visited, transients="on", **given)
    assert len(splats) == len(WALL)
    assert np.abs(splats.means - WALL.means).max() < 0.1


def test_a_ghost_that_comes_after_the_last_look_is_taken_out_in_the_end(visited, monkeypatch):
    both = with_ghost(visited.views[1])
    monkeypatch.setattr(TransientSearch, "_kept", lambda _, splats, *__: np.ones(len(splats), bool))
    given = {"start": both, "sh_degree": 0, "steps": 60, "transients": "on"}
    whole, _ = fitted(visited, **given)
    monkeypatch.undo()
    assert len(whole) == len(both)
    kept = TransientSearch._kept
    calls = []

    def last_alone(self, splats, *rest):
        calls.append(len(splats))
        all_of_them = np.ones(len(splats), np.bool_)
        return all_of_them if len(calls) <= 3 else kept(self, splats, *rest)

    monkeypatch.setattr(TransientSearch, "_kept", last_alone)
    splats, _ = fitted(visited, **given)
    assert len(calls) == 4
    assert len(splats) == len(WALL)


def test_a_resumed_fit_has_the_same_masks_and_bits(visited, tmp_path, monkeypatch):
    monkeypatch.setattr(fitting, "CHUNK_SECONDS", 0.0)
    whole, masks = fitted(visited, checkpoint=tmp_path / "whole.npz")
    # Before the first look, right where it is due, after the fit began anew, and after that step.
    for stop_at, again in ((20, False), (36, False), (20, True), (50, True)):
        kept = tmp_path / f"{stop_at}{again}.npz"

        def goes_on(now, at=stop_at, again=again):
            return now.step < at or bool(now.transients) != again

        fitted(visited, checkpoint=kept, progress=goes_on)
        splats, found = fitted(visited, checkpoint=kept, resume=True)
        assert splats == whole
        assert [v.mask is None for v in found.views] == [v.mask is None for v in masks.views]
        assert found.views[1] == masks.views[1]
    with pytest.raises(igsr.IgsrError, match="transients"):
        fitted(visited, checkpoint=kept, resume=True, transients="on")


def test_an_interrupted_look_is_made_again(visited, tmp_path, monkeypatch):
    whole, _ = fitted(visited)
    kept = tmp_path / "kept.npz"

    def interrupted(*_, **__):
        raise KeyboardInterrupt

    with monkeypatch.context() as patched:
        patched.setattr("igsr.fitting.transient_search.find_transients", interrupted)
        with pytest.raises(KeyboardInterrupt):
            fitted(visited, checkpoint=kept)
    splats, _ = fitted(visited, checkpoint=kept, resume=True)
    assert splats == whole


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("transient_masks", np.zeros(3, np.uint8)),
        ("transient_masks", np.zeros(6 * SIZE * SIZE // 8, np.int64)),
        ("transients_looked", np.zeros(2, np.int64)),
        ("transients_looked", np.array([-7])),
        ("transients_looked", np.array([0.5])),
    ],
)
def test_damaged_masks_are_named(visited, tmp_path, name, value):
    kept = tmp_path / "kept.npz"
    fitted(visited, checkpoint=kept, progress=lambda now: now.step < 50)
    state, settings = checkpoints.load_checkpoint(kept)
    checkpoints.save_checkpoint(kept, {**state, name: value}, settings)
    with pytest.raises(igsr.IgsrError, match=f"cannot be used: {name}"):
        fitted(visited, checkpoint=kept, resume=True)


def test_the_gpu_masks_as_the_cpu_does(visited):
    masks = []
    for backend in ("cpu", "gpu"):
        told = []
        _, found = fitted(visited, steps=24, backend=backend, progress=told.append)
        assert set(told[-1].transients) == {"photos/1.png", "photos/4.png"}
        masks.append(found.views[1].mask)
    assert (masks[0] != masks[1]).mean() < 0.01


def test_photos_with_alpha_are_not_looked_at(visited):
    cut = [
        replace(v, image=np.dstack([v.image, np.full(v.image.shape[:2], 255, np.uint8)]))
        for v in visited.views
    ]
    cut = Capture(visited.path, cut, visited.points)
    _, found = fitted(cut)
    assert all(view.mask is None for view in found.views)
    _, found = fitted(cut, transients="on", background=(0.0, 0.0, 0.0))
    assert found.views[1].mask is not None


def test_the_command_reports_what_it_masked(visited, tmp_path, igsr_here):
    write_transforms(visited, tmp_path / "photos")
    ran = igsr_here(
        *("fit", tmp_path / "photos", "--out", tmp_path / "out", "--steps", 300),
        *("--backend", "cpu", "--transients", "on"),
    )
    assert ran.returncode == 0, ran.stderr
    report = json.loads((tmp_path / "out/report.json").read_text())
    assert report["transients"] == "on"
    assert len(report["masked"]) >= 2
    assert all(0.0 < part < 0.3 for part in report["masked"].values())
    assert "transient things masked in" in ran.stdout
    page = (tmp_path / "out/report.html").read_text()
    assert "Transient things" in page


@pytest.mark.usefixtures("small_fits")
def test_a_refinement_masks_what_its_first_fit_found(ball_photos, monkeypatch, rendered):
    looks = []

    def found(splats, views, before, **_):
        looks.append(len(views))
        masks = [None] * len(views)
        masks[0] = np.zeros(views[0].image.shape[:2], np.bool_)
        masks[0][:5] = True
        return masks

    monkeypatch.setattr("igsr.fitting.transient_search.find_transients", found)
    refinements.refine(ball_photos, 1, refinements.lying, transients="on")
    refinements.refine(ball_photos, 1, refinements.lying, transients="on", cross_validate=False)
    name, count = ball_photos.train_views[0].name, len(ball_photos.train_views)
    assert set(looks) == {count}, "only the first fit looks, at all photos"
    assert [one.name for one in rendered] == ["fold0", "fold1", "fold2", "whole"]
    for view in (view for one in rendered for view in one.photos):
        hidden = 0 if view.mask is None else int((~view.mask).sum())
        assert hidden == (5 * view.camera.width if view.name == name else 0)
