"""Random features for perceptual distances."""

import numpy as np

from igsr_lab.denoiser.perceptual_distance import squeezenet_shapes


def squeezenet_file(path):
    """Write SqueezeNet 1.0's arrays with random values; return them."""
    random = np.random.default_rng(0)
    arrays = {}
    for name, shape in squeezenet_shapes().items():
        scale = np.sqrt(2.0 / np.prod(shape[1:]))
        arrays[f"{name}.weight"] = (scale * random.normal(size=shape)).astype(np.float32)
        arrays[f"{name}.bias"] = np.zeros(shape[0], np.float32)
    np.savez(path, **arrays)
    return arrays
