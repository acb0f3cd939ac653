"""Experiments of the literature with fixed views, seeds and scores, so that runs compare."""

from igsr_lab.study.denoiser_study import denoiser_table
from igsr_lab.study.estimated_poses import poses
from igsr_lab.study.noisy_poses import pose_noise
from igsr_lab.study.own_photos_study import own_photos
from igsr_lab.study.preset_fits import blender8, few_photos
from igsr_lab.study.refinement_studies import (
    photographs,
    refinement_ablation,
    sweep,
    table2,
    table3,
)
from igsr_lab.study.study import Study
from igsr_lab.study.true_depths import depths

__all__ = [
    "Study",
    "blender8",
    "denoiser_table",
    "depths",
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
