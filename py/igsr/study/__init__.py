"""Protocols of the literature as commands: fixed views, seeds and scores, so that runs compare."""

from igsr.study.blender import blender8
from igsr.study.denoiser_comparison import denoiser_table
from igsr.study.estimated_poses import poses
from igsr.study.loop_protocols import photographs, refinement_ablation, sweep, table2, table3
from igsr.study.noisy_poses import pose_noise
from igsr.study.own_photo_folders import own_photos
from igsr.study.real_captures import few_photos

__all__ = [
    "blender8",
    "denoiser_table",
    "few_photos",
    "own_photos",
    "photographs",
    "pose_noise",
    "poses",
    "refinement_ablation",
    "sweep",
    "table2",
    "table3",
]
