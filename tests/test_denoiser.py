"""The denoiser's network, its files and its use."""

import json

import numpy as np
import pytest
import torch
from capture_files import assert_refused
from safetensors.torch import load_file, save_file

import igsr
from igsr.capture import Camera
from igsr.denoiser import Buffers, NetworkDenoiser, cleaning, denoise, load_network, save_network
from igsr.denoiser.architecture import Architecture
from igsr.denoiser.cleaning import DOUBT, MIN_CHANGE
from igsr.denoiser.inputs import BUFFERS, CHANNELS, CHOICES, COLOR, PHOTO
from igsr.denoiser.network import INITIAL_LOGIT, REACH_PX, DenoiserNetwork
from igsr.denoiser.warping import Source
from igsr.rendering.renders import Render

SMALL = Architecture(width=4, blocks=(1, 1, 1))


def network(architecture=SMALL, seed=0):
    """With random weights everywhere, so that nothing is the identity."""
    torch.manual_seed(seed)
    made = DenoiserNetwork(architecture).eval()
    with torch.no_grad():
        for parameter in made.parameters():
            parameter.copy_(0.3 * torch.randn_like(parameter))
    return made


def test_a_new_network_changes_little():
    inputs = torch.rand(2, CHANNELS, 9, 14)
    valid = inputs[:, COLOR + BUFFERS + COLOR :: PHOTO]
    valid[:] = (valid > 0.5).float()
    image, log_error = DenoiserNetwork(SMALL)(inputs)
    expected, weights = inputs[:, :COLOR].clone(), torch.ones(2, 1, 9, 14)
    for k in range(CHOICES):
        at = COLOR + BUFFERS + k * PHOTO
        weight = np.exp(INITIAL_LOGIT) * valid[:, k : k + 1]
        expected += weight * inputs[:, at : at + COLOR]
        weights += weight
    assert torch.allclose(image, expected / weights, atol=1e-6)
    assert (log_error == -3.0).all()


def test_invalid_photos_are_not_mixed_in():
    inputs = torch.rand(1, CHANNELS, 8, 8)
    inputs[:, COLOR + BUFFERS + COLOR :: PHOTO] = 0.0
    image, _ = DenoiserNetwork(SMALL)(inputs)
    assert torch.equal(image, inputs[:, :COLOR])


def test_outputs_depend_only_on_pixels_within_reach():
    made = network(Architecture(4, (2, 2, 4)))
    inputs = torch.rand(1, CHANNELS, 16, 2 * REACH_PX + 32)
    changed = inputs.clone()
    changed[..., :8] = 0.0
    with torch.inference_mode():
        difference = (made(inputs)[0] - made(changed)[0]).abs().amax(dim=(0, 1, 2))
    assert difference[:40].max() > 0.0
    assert difference[8 + REACH_PX :].max() == 0.0


def test_tiles_equal_the_whole(monkeypatch):
    color = np.random.default_rng(0).uniform(size=(50, 230, 3)).astype(np.float32)
    cleaner = NetworkDenoiser(network(Architecture(4, (2, 2, 4))))
    whole = cleaner(Buffers(color), [])
    monkeypatch.setattr(cleaning, "TILE_PX", 40)
    tiled = cleaner(Buffers(color), [])
    for a, b in zip(whole, tiled, strict=True):
        assert np.abs(a - b).max() < 1e-5
    assert np.abs(whole[0] - color).max() > 0.1


@pytest.mark.parametrize("size", [(1, 1), (3, 500), (2, 8000), (33, 7)])
def test_any_size_is_preserved(size):
    color = np.random.default_rng(0).uniform(size=(*size, 3)).astype(np.float32)
    picture, confidence = denoise(color, denoiser=NetworkDenoiser(network()))
    assert picture.shape == (*size, 3)
    assert confidence.shape == size
    assert picture.dtype == confidence.dtype == np.float32
    assert 0.0 <= picture.min() <= picture.max() <= 1.0
    assert 0.0 <= confidence.min() <= confidence.max() <= 1.0


def test_invisible_changes_are_not_made():
    color = np.random.default_rng(0).uniform(0.1, 0.9, size=(20, 20, 3)).astype(np.float32)
    for brighter, same in ((0.9 * MIN_CHANGE, True), (1.1 * MIN_CHANGE, False)):
        picture, _ = denoise(color, denoiser=NetworkDenoiser(brightening(brighter, 1e-3)))
        assert np.array_equal(picture, color) is same


def brightening(by, error):
    """A network that makes everything brighter, and expects that it is then as wrong as said."""
    made = DenoiserNetwork(SMALL).eval()
    with torch.no_grad():
        made.tail.bias[:12] = by
        made.tail.bias[12:16] = float(np.log(error)) + 3.0
    return made


def test_changes_are_reduced_by_their_expected_error():
    color = np.full((20, 20, 3), 0.4, np.float32)
    for error, part in ((1e-3, 1.0), (0.1 / DOUBT, 0.5), (0.3 / DOUBT, 0.1)):
        cleaner = NetworkDenoiser(brightening(0.1, error))
        picture, confidence = denoise(color, denoiser=cleaner)
        assert picture == pytest.approx(0.4 + 0.1 * part, abs=1e-4)
        assert confidence == pytest.approx(0.05 / (0.05 + error), rel=1e-4)
        picture, _ = denoise(color, denoiser=NetworkDenoiser(cleaner.network, doubt=0.0))
        assert picture == pytest.approx(0.5, abs=1e-6), "every change is made"


def test_nonfinite_pixels_are_filled_with_zero_confidence():
    color = np.full((20, 20, 3), 0.5, np.float32)
    color[3, 4] = np.nan
    color[5, 6, 1] = np.inf
    picture, confidence = denoise(color, denoiser=NetworkDenoiser(network()))
    assert np.isfinite(picture).all()
    assert confidence[3, 4] == confidence[5, 6] == 0.0
    assert (np.delete(confidence.ravel(), [3 * 20 + 4, 5 * 20 + 6]) > 0.0).all()


def test_renders_of_all_types_are_accepted():
    cleaner = NetworkDenoiser(network())
    color = np.random.default_rng(0).integers(0, 255, (8, 9, 3), dtype=np.uint8)
    floats = color.astype(np.float32) / 255
    from_bytes = denoise(color, denoiser=cleaner)
    assert np.array_equal(from_bytes[0], denoise(floats, denoiser=cleaner)[0])
    assert np.array_equal(from_bytes[0], denoise(Buffers(floats), denoiser=cleaner)[0])
    ones = np.ones((8, 9), np.float32)
    drawn = Render(floats, ones, ones, ones, 0 * ones)
    assert denoise(drawn, denoiser=cleaner)[0].shape == (8, 9, 3)
    photo = Source(Camera(np.eye(4), np.eye(3), 9, 8), floats, ones > 0.0, ones)
    for render, photos, message in (
        (floats[..., 0], [], r"color must be \[H, W, 3\], not \[8, 9\]"),
        (Buffers(floats), ["photo.png"], r"must be of igsr\.denoiser\.photo_sources"),
        (drawn, [photo], "photos need a render with a camera"),
        (np.zeros((2, 2, 3), np.int64), [], "render must be uint8 or float"),
    ):
        assert_refused(message, denoise, render, photos, denoiser=cleaner)

    def smaller(render, photos):
        return floats[::2], ones

    assert_refused(r"returned a picture \[4, 9, 3\]", denoise, floats, denoiser=smaller)


def test_networks_survive_files(tmp_path):
    architecture = Architecture(6, (0, 1, 2))
    save_network(network(architecture), tmp_path / "a.safetensors", {"seed": 3})
    read = load_network(tmp_path / "a.safetensors")
    assert read.architecture == architecture
    inputs = torch.rand(1, CHANNELS, 8, 8)
    assert torch.allclose(read(inputs)[0], network(architecture)(inputs)[0], rtol=1e-2, atol=5e-2)


def test_damaged_weights_are_refused(tmp_path):
    path = tmp_path / "a.safetensors"
    save_network(network(), path, {})
    whole = path.read_bytes()
    weights = load_file(path)
    said = {"width": 4, "blocks": [1, 1, 1], "residual": True, "buffers": True}
    about = {"architecture": json.dumps({**said, "photos": "concatenated"})}

    def refused(match):
        with pytest.raises(igsr.IgsrError, match=match) as caught:
            load_network(path)
        assert str(path) in str(caught.value)

    for length in (0, 4, 100, len(whole) - 1):
        path.write_bytes(whole[:length])
        refused("is not a complete .safetensors file")
    save_file(weights, path)
    unsaid = "does not record its architecture"
    refused(unsaid)
    for wrong, why in (
        *((text, unsaid) for text in ("[]", '{"width": 4}', "{", "[" * 100_000)),
        ('{"width": 100000, "blocks": [1, 1, 1]}', "width must be even, from 2 to 256"),
        ('{"width": 4.5, "blocks": [1, 1, 1]}', "width must be even"),
        ('{"width": 4, "blocks": [1, 1]}', "blocks must be three from 0 to 32"),
        ('{"width": 4, "blocks": [1, 1, 99]}', "blocks must be three from 0 to 32"),
        ('{"width": 4, "blocks": [1, 1, 1], "photos": "attention"}', "no longer has its settings"),
    ):
        save_file(weights, path, metadata={"architecture": wrong})
        refused(why)
    for wrong, why in (
        ({k: v for k, v in weights.items() if k != "head.bias"}, "lacks the weight head.bias"),
        (weights | {"head.bias": torch.zeros(3)}, "head.bias has shape"),
        (weights | {"head.bias": weights["head.bias"] * np.nan}, "head.bias holds a NaN"),
        (weights | {"more": torch.zeros(3)}, "has an unknown weight more"),
    ):
        save_file(wrong, path, metadata=about)
        refused(why)
    path.unlink()
    refused("does not exist")


def test_missing_shipped_weights_give_advice(monkeypatch, tmp_path):
    monkeypatch.setattr("igsr.denoiser.weights.SHIPPED", tmp_path / "denoiser.safetensors")
    assert_refused("without the denoiser's weights.*--weights", load_network)
