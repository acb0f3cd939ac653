"""igsr: from a handful of photos with known cameras to a Gaussian-splat scene."""
