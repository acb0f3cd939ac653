"""Transient objects, which only one photo shows, are found and masked."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from unittest.mock import Mock

import numpy as np
import pytest
import refinements
import scenes
from capture_files import assert_refused

import igsr
from igsr.capture import Capture, Points, View
from igsr.capture.write_transforms import write_transforms
from igsr.fitting import checkpoint as checkpoints
from igsr.fitting import fit_capture, train
from igsr.floaters.photo_evidence import behind_masks
from igsr.rendering.renders import render
from igsr.splats import PARAMETERS, joined
from igsr.transients import EVIDENT_FRACTION, find_transients
from igsr.transients.regions import box_sums, labels, window_max, window_min

SIZE = 96


def wall(depth=0.0, count=90, seed=0):
    """A wall of small, flat, opaque splats across the cameras' view, with smooth colors."""
    random = np.random.default_rng(seed)
    side = np.linspace(-2.2, 2.2, count)
    means = np.stack(np.meshgrid(side, side, depth), axis=-1).reshape(-1, 3)
    knots = random.uniform(0.1, 0.9, size=(10, 10, 3))
    at = np.linspace(0.0, 9.0, count)
    near = np.maximum(0.0, 1.0 - np.abs(at[:, None] - np.arange(10.0)))
    colors = np.einsum("yi,xj,ijc->yxc", near, near, knots).reshape(-1, 3)
    return scenes.round_splats(means, [0.03, 0.03, 0.01], color=colors[:, None])


WALL = wall()


def photos(count=6, scene=WALL):
    """Train photos of the wall along an arc of 40 degrees."""
    views = []
    for k in range(count):
        camera = scenes.ring_camera(np.radians(40.0 * (k / (count - 1) - 0.5)), SIZE)
        image = render(scene, camera, backend="cpu").to_uint8()
        views.append(View(f"photos/{k}.png", camera, "train", image))
    return views


def with_figure(view, top=30, left=40, height=34, width=16, color=(10, 250, 40)):
    """The photo with a green figure, and the figure's pixels."""
    image, where = view.image.copy(), np.zeros(view.image.shape[:2], np.bool_)
    where[top : top + height, left : left + width] = True
    image[where] = color
    return replace(view, image=image), where


def find(views, scene=WALL, before=None, **options):
    before = [None] * len(views) if before is None else before
    return find_transients(scene, views, before, backend="cpu", **options)


def masked(masks):
    """Indices of the photos that have a mask."""
    return [k for k, mask in enumerate(masks) if mask is not None]


def test_a_figure_in_one_photo_is_found_there_only():
    views = photos()
    views[2], where = with_figure(views[2])
    masks = find(views, min_evident=EVIDENT_FRACTION)
    assert masked(masks) == [2]
    assert masks[2].dtype == np.bool_
    assert masks[2][where].mean() > 0.97
    assert (masks[2] & ~window_max(where, 6)).sum() == 0


def test_figures_at_one_place_in_two_of_six_photos_are_found():
    views = photos()
    for k in (1, 4):
        views[k], _ = with_figure(views[k])
    assert masked(find(views)) == [1, 4]


def test_three_photos_are_enough_and_two_are_not():
    views = photos(3)
    views[0], where = with_figure(views[0])
    masks = find(views)
    assert masks[0][where].mean() > 0.9
    assert masks[1] is masks[2] is None
    assert find(views[:2]) == [None, None]


def brighter(view):
    return replace(view, image=np.clip(1.8 * view.image, 0, 255).astype(np.uint8))


def noisy(view, seed):
    noise = np.random.default_rng(seed).normal(scale=12.0, size=view.image.shape)
    return replace(view, image=np.clip(view.image + noise, 0, 255).astype(np.uint8))


def test_static_photos_have_no_masks():
    views = photos()
    with_highlight = with_figure(views[2], 40, 40, 3, 3, 255)[0]
    changed = [views[2], brighter(views[2]), with_highlight]
    for view in changed + [noisy(views[2], seed) for seed in range(3)]:
        assert masked(find([*views[:2], view, *views[3:]])) == []


def test_overexposed_pixels_may_have_any_bright_color():
    views = photos()
    overexposed = [brighter(view) for view in views]
    assert (overexposed[0].image == 255).mean() > 0.1
    overexposed[2] = views[2]
    assert find(overexposed)[2] is None


def test_objects_that_the_scene_lacks_are_not_transient():
    board = wall(depth=-1.0, count=20, seed=5)
    board.means[:, :2] *= 0.2
    views = photos(scene=joined([WALL, board]))
    for view, without in zip(views, photos(), strict=True):
        assert np.abs(view.image.astype(int) - without.image).max() > 60, "the board is visible"
    # Only the outermost photos show the wall behind the board.
    assert masked(find(views)[1:-1]) == []


def test_masked_pixels_and_pseudo_views_are_no_evidence():
    views = photos(4)
    views[0], where = with_figure(views[0])
    nothing = np.zeros(where.shape, np.bool_)
    # One photo is left besides; it takes two.
    hidden = [*views[:2], *(replace(view, mask=nothing) for view in views[2:])]
    assert find(hidden)[0] is None
    assert find(views, before=[None, None, ~nothing, ~nothing])[0] is None
    pseudo = [scenes.pseudo_view(view) for view in views]
    assert masked(find([*views[:2], *pseudo[2:]])) == []
    assert masked(find([pseudo[0], *views[1:]])) == []


def test_small_objects_count_only_below_their_limit():
    views = photos()
    views[2], _ = with_figure(views[2], height=8, width=8)
    assert masked(find(views)) == [2]
    assert masked(find(views, min_evident=0.02)) == []


def test_regions():
    mask = np.zeros((7, 9), np.bool_)
    mask[1, 1] = mask[2, 2] = mask[5, 6:8] = True
    number = labels(mask)
    assert number[1, 1] == number[2, 2] != number[5, 6] == number[5, 7]
    assert sorted(np.unique(number)) == [0, 1, 2]
    for value in (0, 1):
        assert (labels(np.full((3, 4), value, np.bool_)) == value).all()
    # The ends of a snake are one region.
    snake = np.zeros((9, 9), np.bool_)
    snake[::2] = True
    snake[1, 8] = snake[3, 0] = snake[5, 8] = snake[7, 0] = True
    assert labels(snake).max() == 1
    assert window_max(mask, 1)[:3, :3].all()
    assert not window_max(mask, 1)[0, 3]
    assert not window_min(mask, 1).any()
    assert window_min(np.ones((3, 3), np.bool_), 2).all()
    assert box_sums(mask, 1)[[1, 6, 0], [1, 8, 8]].tolist() == [2, 1, 0]


@pytest.fixture(scope="module")
def static():
    colors = np.clip(255.0 * (0.5 + 0.2820948 * WALL.sh[:, 0]), 0, 255).astype(np.uint8)
    return Capture(Path("made-up"), photos(), Points(WALL.means.astype(np.float64), colors))


@pytest.fixture(scope="module")
def visited(static):
    """Photos with a figure in two of them, at different places."""
    views = list(static.views)
    views[1], _ = with_figure(views[1])
    views[4], _ = with_figure(views[4], left=20)
    return Capture(static.path, views, static.points)


@pytest.fixture
def single_steps(monkeypatch):
    monkeypatch.setattr(train, "CHUNK_SECONDS", 0.0)


VISITED = {"photos/1.png", "photos/4.png"}
STEPS = 120
LOOKS = [round(part * STEPS) for part in (0.3, 0.5, 0.7)]
OPTIONS = {"steps": STEPS, "backend": "cpu", "max_splats": 9000, "sh_degree": 2, "dropout": 0.0}
OPTIONS |= {"density": "fixed", "start": "points", "learning_rate": 3.0}
OPTIONS |= dict.fromkeys(("coarse_to_fine", "remove_floaters", "backdrop"), False)
#: Options of fits that continue from splats.
CONTINUED = {"sh_degree": 0, "steps": 60, "transients": "on"}


def fit(capture, **options):
    return fit_capture(capture, **{**OPTIONS, **options})


def test_a_static_capture_has_the_bits_of_a_fit_without_search(static):
    off, auto = fit(static, transients="off"), fit(static)
    assert auto.splats == off.splats
    assert auto.capture == static
    assert auto.masked == auto.masks == {}


def test_a_fit_does_not_learn_transient_objects(static, visited, whole):
    off, on = fit(visited, transients="off"), whole
    assert on.masked.keys() == on.masks.keys() == VISITED
    for name, mask in on.masks.items():
        assert on.masked[name] == pytest.approx(1.0 - mask.mean())
    photo, (_, where) = static.views[1], with_figure(static.views[1])
    renders = (render(one.splats, photo.camera, backend="cpu").color for one in (off, on))
    before, after = (np.abs(color - photo.image / 255.0)[where].mean() for color in renders)
    assert after < 0.7 * before


@pytest.fixture(scope="module")
def whole(visited):
    """A fit that is not interrupted."""
    return fit(visited)


@pytest.fixture
def starts(monkeypatch):
    """For each initialization of a fit, the names of its masked photos."""
    names, initial_state = [], train.initial_state

    def recorded(capture, *rest):
        names.append({view.name for view in capture.train_views if view.mask is not None})
        return initial_state(capture, *rest)

    monkeypatch.setattr(train, "initial_state", recorded)
    return names


@pytest.mark.usefixtures("single_steps")
def test_a_fit_starts_over_with_the_first_masks(visited, starts):
    events = []
    fit(visited, report=events.append)
    steps = [int(event.done) for event in events]
    assert steps == [*range(1, LOOKS[0] + 1), *range(1, STEPS + 1)]
    masked = ["2 photos masked" in event.message for event in events]
    assert masked == [False] * LOOKS[0] + [True] * STEPS
    assert starts == [set(), VISITED]


def test_a_fit_that_continues_from_splats_does_not_start_over(visited, starts):
    assert fit(visited, start=WALL, sh_degree=0).masked.keys() == VISITED
    assert starts == [set()]


def test_a_fit_continues_if_masks_leave_too_little_to_start_over(visited, whole, monkeypatch):
    initial_state, calls = train.initial_state, []

    def once(*arguments):
        calls.append(arguments)
        if len(calls) > 1:
            raise igsr.IgsrError("depth maps agree in 8 points only")
        return initial_state(*arguments)

    monkeypatch.setattr(train, "initial_state", once)
    result = fit(visited)
    assert len(calls) == 2
    assert result.masked.keys() == VISITED
    assert result.splats != whole.splats


def with_ghost(view):
    """A green splat close to a camera, as fits to a figure have it, and the wall."""
    place = np.linalg.inv(view.camera.viewmat) @ np.array([0.0, 0.0, 1.0, 1.0])
    ghost = replace(WALL, **{name: getattr(WALL, name)[:1].copy() for name in PARAMETERS})
    ghost.means[0], ghost.scales[0] = place[:3], np.log(0.02)
    ghost.sh[0, 0] = (-1.6, 1.7, -1.2)
    return joined([ghost, WALL])


def test_splats_that_only_masked_pixels_show_are_found(static):
    splats = with_ghost(static.views[1])
    cameras = [view.camera for view in static.views]
    regions = [None] * len(cameras)
    assert not behind_masks(splats, cameras, regions, backend="cpu").any()
    regions[1] = np.zeros((SIZE, SIZE), np.bool_)
    regions[1][36:60, 36:60] = True
    assert np.flatnonzero(behind_masks(splats, cameras, regions, backend="cpu")).tolist() == [0]
    regions[1][:] = False
    regions[1][:4] = True
    assert not behind_masks(splats, cameras, regions, backend="cpu").any()


def test_a_fit_removes_splats_that_only_masked_pixels_show(visited):
    splats = with_ghost(visited.views[1])
    kept = fit(visited, start=splats, **CONTINUED | {"transients": "off"})
    assert len(kept.splats) == len(splats)
    result = fit(visited, start=splats, **CONTINUED)
    assert len(result.splats) == len(WALL)
    assert np.abs(result.splats.means - WALL.means).max() < 0.1


def test_splats_behind_masks_are_removed_after_the_last_step_too(visited, monkeypatch):
    monkeypatch.setattr(train, "visible_splats", lambda splats, *_: np.ones(len(splats), bool))
    result = fit(visited, start=with_ghost(visited.views[1]), **CONTINUED)
    assert len(result.splats) == len(WALL)


# Before the first look, when it is due, after the fit started over, and past that step again.
@pytest.mark.parametrize(
    ("stop", "started_over"), [(20, False), (36, False), (20, True), (50, True)]
)
@pytest.mark.usefixtures("single_steps")
def test_a_stopped_fit_resumes_with_the_same_masks_and_bits(
    visited, whole, tmp_path, stop, started_over
):
    path = tmp_path / "checkpoint.npz"

    def end(event):
        if event.done >= stop and ("photos masked" in event.message) == started_over:
            raise scenes.Stop

    with pytest.raises(scenes.Stop):
        fit(visited, checkpoint=path, report=end)
    assert checkpoints.load_checkpoint(path)[0]["step"] == [stop]
    resumed = fit(visited, checkpoint=path, resume=True)
    assert resumed.splats == whole.splats
    assert resumed.capture == whole.capture


@pytest.fixture
def saved_every_30_steps(single_steps, monkeypatch):
    monkeypatch.setattr(train, "CHECKPOINT_STEPS", 30)
    monkeypatch.setattr(train, "CHECKPOINT_SECONDS", 1e9)


@pytest.mark.usefixtures("saved_every_30_steps")
def test_ctrl_c_saves_a_fit_that_started_over(visited, tmp_path, monkeypatch):
    path, fit_event, calls = tmp_path / "checkpoint.npz", train.fit_event, []

    def interrupted(*arguments, **named):
        calls.append(arguments)
        if len(calls) == LOOKS[0] + 20:
            raise KeyboardInterrupt
        return fit_event(*arguments, **named)

    monkeypatch.setattr(train, "fit_event", interrupted)
    with pytest.raises(KeyboardInterrupt):
        fit(visited, checkpoint=path, report=lambda event: None)
    assert checkpoints.load_checkpoint(path)[0]["step"] == [20]


@pytest.mark.usefixtures("saved_every_30_steps")
def test_a_fit_that_started_over_is_saved_at_once(visited, tmp_path, monkeypatch):
    saved, save = [], checkpoints.CheckpointFile.save

    def watched(file, state, *others):
        saved.append(int(state["step"][0]))
        save(file, state, *others)

    monkeypatch.setattr(checkpoints.CheckpointFile, "save", watched)
    fit(visited, checkpoint=tmp_path / "checkpoint.npz")
    assert saved[:3] == [30, 1, 31]


def test_an_interrupted_search_is_repeated(visited, whole, tmp_path, monkeypatch):
    path = tmp_path / "checkpoint.npz"

    interrupted = Mock(side_effect=KeyboardInterrupt)
    monkeypatch.setattr("igsr.fitting.transient_masks.find_transients", interrupted)
    with pytest.raises(KeyboardInterrupt):
        fit(visited, checkpoint=path)
    monkeypatch.undo()
    assert fit(visited, checkpoint=path, resume=True).splats == whole.splats


def test_damaged_masks_are_named(visited, tmp_path):
    options = {"checkpoint": tmp_path / "checkpoint.npz", "steps": 10}
    fit(visited, **options)
    state, settings = checkpoints.load_checkpoint(options["checkpoint"])
    masks = np.zeros(3, np.uint8), np.zeros(6 * SIZE * SIZE // 8, np.int64)
    looked = np.zeros(2, np.int64), np.array([-7]), np.array([0.5])
    for name, values in (("transient_masks", masks), ("transients_looked", looked)):
        for value in values:
            damaged = {**state, name: value}
            checkpoints.save_checkpoint(options["checkpoint"], damaged, settings)
            assert_refused(f"cannot be used: {name}", fit, visited, resume=True, **options)


def test_cpu_and_gpu_mask_alike(visited):
    cpu, gpu = (fit(visited, steps=24, backend=name).masks for name in ("cpu", "gpu"))
    assert cpu.keys() == gpu.keys() == VISITED
    assert (cpu["photos/1.png"] != gpu["photos/1.png"]).mean() < 0.01


def test_photos_with_alpha_are_searched_only_if_asked_for(visited):
    alpha = np.full((SIZE, SIZE, 1), 255, np.uint8)
    views = [replace(view, image=np.dstack([view.image, alpha])) for view in visited.views]
    cut_out = Capture(visited.path, views, visited.points)
    assert not fit(cut_out).masks
    assert fit(cut_out, transients="on", background=(0.0, 0.0, 0.0)).masks.keys() >= VISITED


def test_the_command_reports_what_it_masked(visited, tmp_path, igsr_here):
    write_transforms(visited, tmp_path / "photos")
    options = ("--steps", 300, "--backend", "cpu", "--transients", "on")
    ran = igsr_here("fit", tmp_path / "photos", "--out", tmp_path / "out", *options)
    assert ran.returncode == 0, ran.stderr
    report = json.loads((tmp_path / "out/report.json").read_text())
    assert report["transients"] == "on"
    assert len(report["masked"]) >= 2
    assert all(0.0 < part < 0.3 for part in report["masked"].values())
    assert "transient objects masked in" in ran.stdout
    assert "Transient" in (tmp_path / "out/report.html").read_text()


def test_a_refinement_keeps_the_masks_of_its_first_fit(ball_photos, monkeypatch, rendered):
    searches = []

    def found(splats, views, before, **_):
        searches.append(len(views))
        first = np.zeros(views[0].image.shape[:2], np.bool_)
        first[:5] = True
        return [first, *[None] * (len(views) - 1)]

    monkeypatch.setattr("igsr.fitting.transient_masks.find_transients", found)
    refinements.refine(ball_photos, 1, refinements.contented, transients="on")
    name, count = ball_photos.train_views[0].name, len(ball_photos.train_views)
    assert set(searches) == {count}, "only fits to all photos search"
    assert len(rendered) == 1
    for view in (view for model in rendered for view in model.photos):
        hidden = 0 if view.mask is None else int((~view.mask).sum())
        assert hidden == (5 * view.camera.width if view.name == name else 0)
