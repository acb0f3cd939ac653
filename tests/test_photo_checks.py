"""What photos cannot tell is one clear sentence, and no more is said than is so."""

from __future__ import annotations

import warnings
from dataclasses import replace

import numpy as np
import pytest
import scenes

import igsr
from igsr.capture import Camera, Capture
from igsr.capture.photo_checks import check_photos


@pytest.fixture(scope="module")
def views():
    return scenes.capture(views=6, size=24).views


def turned_away(view, index):
    """The same photo from a camera that looks away from all others."""
    viewmat = np.diag([1.0, 1.0, 1.0, 1.0])
    angle = 2.0 * np.pi * index / 3.0
    c, s = np.cos(angle), np.sin(angle)
    viewmat[:3, :3] = [[c, 0.0, -s], [0.0, 1.0, 0.0], [s, 0.0, c]]
    viewmat[:3, 3] = [0.0, 0.0, -1.0]  # its center lies one unit along its own axis
    return replace(view, camera=Camera(viewmat, view.camera.K, 24, 24), name=f"{index}.png")


def test_good_photos_are_not_talked_about(views):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        check_photos(views)
        check_photos(views[:2])


def test_one_photo_works_and_says_what_it_cannot(views):
    with pytest.warns(UserWarning, match="one photo only"):
        splats = igsr.fit(Capture("one", views[1:2]), steps=20, backend="cpu", max_splats=200)
    assert np.isfinite(splats.means).all()


def test_all_poses_equal(views):
    same = [replace(view, camera=views[0].camera) for view in views]
    with pytest.warns(UserWarning, match="All cameras are at one place"):
        check_photos(same)


def test_a_camera_given_twice(views):
    twice = [*views, replace(views[2], name="again.png")]
    with pytest.warns(UserWarning, match=r"02\.png, again\.png have the same camera"):
        check_photos(twice)
    other = [*views, replace(views[2], camera=replace_focal(views[2].camera), name="zoomed.png")]
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        check_photos(other)


def replace_focal(camera):
    K = camera.K.copy()
    K[0, 0] *= 1.5
    K[1, 1] *= 1.5
    return Camera(camera.viewmat, K, camera.width, camera.height)


def test_photos_that_see_nothing_in_common(views):
    apart = [turned_away(views[k], k) for k in range(3)]
    with pytest.warns(UserWarning, match="No two photos see anything in common"):
        check_photos(apart)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        check_photos([*apart, *views])


def test_black_and_transparent_photos(views):
    black = [replace(view, image=np.zeros_like(view.image)) for view in views]
    with pytest.raises(igsr.IgsrError, match="Every photo is black"):
        check_photos(black)
    with pytest.warns(UserWarning, match="black or fully transparent; leave"):
        check_photos([black[0], *views[1:]])
    clear = np.full((24, 24, 4), 255, np.uint8)
    clear[..., 3] = 0
    with pytest.raises(igsr.IgsrError, match="fully transparent"):
        check_photos([replace(view, image=clear) for view in views])
    dark = np.zeros((24, 24, 4), np.uint8)
    dark[..., 3] = 255
    with pytest.raises(igsr.IgsrError, match="Every photo is black"):
        check_photos([replace(view, image=dark) for view in views])
    outline = dark.copy()  # of a black thing: it tells where the thing is
    outline[:8, :, 3] = 0
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        check_photos([replace(view, image=outline) for view in views])


def test_a_mask_that_hides_everything(views):
    hidden = replace(views[1], mask=np.zeros((24, 24), bool))
    with pytest.raises(igsr.IgsrError, match=r"01\.png: its mask leaves no pixel"):
        check_photos([hidden, *views])
