"""Difix as igsr's denoiser: renders are cleaned by a single-step diffusion model and a photo.

Difix (Wu et al., "Difix3D+", CVPR 2025) is NVIDIA's; read its license first. It
needs a GPU with 8 GB, ``pip install diffusers transformers accelerate``, and a clone of its
repository, whose ``src`` holds ``pipeline_difix.py``:

    PYTHONPATH=Difix3D/src igsr refine photos --out out --denoiser examples/difix_denoiser.py:make

The weights ("nvidia/difix_ref", 3 GB) are downloaded at first use; ``DIFIX`` names a folder that
has them. Write your own denoiser in the same way: a function that returns a function.
"""

from __future__ import annotations

import os

import torch
from torch import Tensor

from igsr.denoiser import SingleStepDenoiser


def make() -> SingleStepDenoiser:
    """The denoiser; igsr calls it once."""
    from pipeline_difix import DifixPipeline

    device = "cuda" if torch.cuda.is_available() else "cpu"
    pipeline = DifixPipeline.from_pretrained(os.environ.get("DIFIX", "nvidia/difix_ref"))
    pipeline.to(device)
    pipeline.set_progress_bar_config(disable=True)

    def clean(render: Tensor, photo: Tensor | None) -> Tensor:
        # The model was trained with a photo for each render.
        made = pipeline(
            "remove degradation",
            image=render,
            ref_image=render if photo is None else photo,
            num_inference_steps=1,
            timesteps=[199],
            guidance_scale=0.0,
            output_type="pt",
        )
        return made.images

    return SingleStepDenoiser(clean, multiple=8, longest=1024, device=device)
