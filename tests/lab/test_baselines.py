"""Baselines that studies compare igsr with."""

import numpy as np
import pytest
import scenes

import igsr
from igsr.capture import Points
from igsr.fitting import fit_capture, settings_for
from igsr_lab.presets import PRESETS, preset_keywords, preset_settings


@pytest.fixture(scope="module")
def capture():
    return scenes.capture(views=8, size=40, alpha=True)


def test_the_default_is_igsrs_and_unknown_presets_are_named():
    assert preset_keywords("default") == {}
    settings = preset_settings("default", 8, dropout=0.0, steps=None)
    expected = settings_for(8, dropout=0.0)
    assert settings["dropout"] == 0.0
    assert all(settings[name] == getattr(expected, name) for name in settings)
    with pytest.raises(igsr.IgsrError, match=f"preset must be one of {', '.join(PRESETS)}"):
        preset_keywords("best")


@pytest.mark.parametrize("name", ["3dgs", "instantsplat"])
def test_baselines_have_none_of_igsrs_additions(name):
    settings = preset_settings(name, 8)
    assert settings == preset_settings(name, 100)
    assert (settings["dropout"], settings["coarse_to_fine"]) == (0.0, False)
    assert (settings["depth_weight"], settings["learning_rate"]) == (0.0, 1.0)


def test_3dgs_starts_from_points_or_at_random(capture):
    settings = preset_settings("3dgs", 8)
    assert (settings["density"], settings["sh_degree"], settings["steps"]) == ("original", 3, 7000)
    assert settings["max_splats"] >= 1_000_000
    points = Points(np.random.default_rng(0).normal(size=(200, 3)), np.full((200, 3), 9, np.uint8))
    with_points = igsr.Capture(capture.path, capture.views, points)
    assert preset_keywords("3dgs", capture)["start"] == "random"
    assert preset_keywords("3dgs", with_points)["start"] == "points"


def test_instantsplat_keeps_the_number_of_splats_and_moves_cameras(capture):
    keywords = preset_keywords("instantsplat", capture) | {"steps": 60, "max_splats": 777}
    result = fit_capture(capture, backend="cpu", **keywords)
    assert len(result.splats) == 777
    cameras = [view.camera for view in result.capture.train_views]
    assert not np.array_equal(cameras[0].viewmat, capture.train_views[0].camera.viewmat)
    (focal,) = {camera.K[0, 0] for camera in cameras}
    assert focal != capture.train_views[0].camera.K[0, 0]
