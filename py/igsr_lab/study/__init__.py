"""Protocols of the literature as commands: fixed views, seeds and scores, so that runs compare."""

from igsr_lab.study.blender import blender8
from igsr_lab.study.denoiser_comparison import denoiser_table
from igsr_lab.study.estimated_poses import poses
from igsr_lab.study.loop_protocols import photographs, refinement_ablation, sweep, table2, table3
from igsr_lab.study.noisy_poses import pose_noise
from igsr_lab.study.own_photo_folders import own_photos
from igsr_lab.study.real_captures import few_photos

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
