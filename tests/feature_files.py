"""Files of features that a perceptual distance reads, with random values."""

import numpy as np

from igsr_lab.denoiser.perceptual_distance import _FIRES


def squeezenet_file(path):
    """SqueezeNet 1.0's arrays with random values; returns them."""
    random = np.random.default_rng(0)
    shapes = {"conv1": (96, 3, 7, 7)}
    channels = 96
    for number, (squeezed, expanded) in _FIRES.items():
        shapes[f"fire{number}/conv1x1_1"] = (squeezed, channels, 1, 1)
        shapes[f"fire{number}/conv1x1_2"] = (expanded, squeezed, 1, 1)
        shapes[f"fire{number}/conv3x3_2"] = (expanded, squeezed, 3, 3)
        channels = 2 * expanded
    arrays = {}
    for name, shape in shapes.items():
        scale = np.sqrt(2.0 / np.prod(shape[1:]))
        arrays[f"{name}.weight"] = (scale * random.normal(size=shape)).astype(np.float32)
        arrays[f"{name}.bias"] = np.zeros(shape[0], np.float32)
    np.savez(path, **arrays)
    return arrays
