"""Protocols of the literature as commands: fixed views, seeds and scores, so that runs compare."""

from .blender import blender8
from .estimated_poses import poses
from .noisy_poses import pose_noise
from .poor_fits import denoiser_table
from .real_captures import few_photos
from .refinement_protocols import refinement_ablation, sweep, table2, table3

__all__ = [
    "blender8",
    "denoiser_table",
    "few_photos",
    "pose_noise",
    "poses",
    "refinement_ablation",
    "sweep",
    "table2",
    "table3",
]
