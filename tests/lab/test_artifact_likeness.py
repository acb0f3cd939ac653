"""Similarity of the errors of two sets of renders."""

import numpy as np
import pytest

from igsr.denoiser.inputs import CHANNELS
from igsr_lab.denoiser.pair_files import Pairs
from igsr_lab.study.artifact_likeness import NAMES, OCTAVES, likeness, plot_likeness, signatures


def renders(coarse, count=4, size=64, seed=0):
    """Gray pictures, and the same with random errors in blocks of ``coarse`` pixels."""
    random = np.random.default_rng(seed)
    truth = np.full((count, 3, size, size), 128, np.uint8)
    wrong = random.integers(-40, 40, (count, 1, size // coarse, size // coarse))
    inputs = np.zeros((count, CHANNELS, size, size), np.uint8)
    inputs[:, :3] = truth + wrong.repeat(coarse, 2).repeat(coarse, 3)
    return Pairs(inputs, truth, np.ones((count, size, size), np.bool_))


@pytest.mark.parametrize(("frequency", "octave"), [(0.3, -1), (0.2, -2), (0.1, -3), (0.05, -4)])
def test_a_wave_is_in_its_octave(frequency, octave):
    pairs = renders(1, count=1)
    pairs.inputs[0, :3] = np.rint(128 + 50 * np.sin(2 * np.pi * frequency * np.arange(64)))
    (row,) = signatures([pairs])
    shares = row[: len(OCTAVES)]
    assert np.sum(shares) == pytest.approx(1.0)
    assert shares[octave] > 0.9


def test_power_in_few_pixels_shows():
    pairs = renders(1, count=1)
    pairs.inputs[0, :3] = 128
    pairs.inputs[0, :3, 20:24, 30:34] = 255
    assert signatures([pairs])[0, -1] == 1.0
    assert signatures([renders(1)])[:, -1].max() < 0.5


def test_like_errors_are_near_and_others_far():
    alike = likeness([renders(8, seed=1)], [renders(8, seed=2), renders(8, seed=3)])
    unlike = likeness([renders(8, seed=1)], [renders(2, seed=2), renders(2, seed=3)])
    assert alike.distance < 0.5 < unlike.distance
    assert alike.within < 0.5
    assert alike.noise > 1.0
    assert set(alike.real) == set(NAMES)
    assert alike.renders == {"real": 4, "synthetic": 8}


def test_sets_without_a_render_have_no_distance(tmp_path):
    hidden = renders(4)
    hidden.masks[:, 0] = False
    found = likeness([hidden], [renders(4)])
    assert found.distance is None
    assert found.within is None
    assert found.renders["real"] == 0
    plot_likeness(tmp_path / "a.png", found, [hidden], [renders(4)])
    assert (tmp_path / "a.png").stat().st_size > 1000
