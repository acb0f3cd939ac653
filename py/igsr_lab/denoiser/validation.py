"""What a network scores on crops that it was not trained on."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from igsr.denoiser.inputs import COLOR
from igsr.denoiser.network import DenoiserNetwork
from igsr_lab.denoiser.crops import Crop, stacked
from igsr_lab.denoiser.losses import Prediction, charbonnier, regret
from igsr_lab.denoiser.perceptual_distance import Distance


def validated(
    network: DenoiserNetwork, crops: Sequence[Crop], distance: Distance | None, device: torch.device
) -> dict[str, float]:
    """Mean scores over the crops, after denoising and, as "..._before", before.

    Returns:
        "validation_charbonnier", "validation_regret", "validation_psnr" (dB) and, where there is a
        ``distance``, "validation_perceptual".
    """
    sums: dict[str, float] = {}
    with torch.no_grad():
        for crop in crops:
            batch = stacked([crop], device)
            image, log_error = network(batch.inputs)
            image = torch.where(batch.known, image.clamp(0.0, 1.0), batch.truth)
            render = batch.inputs[:, :COLOR]
            made = Prediction(render, image, log_error, batch.truth)
            scores = {
                "validation_charbonnier": charbonnier(made),
                "validation_regret": regret(made),
                "validation_psnr_before": _psnr(render, batch.truth),
                "validation_psnr": _psnr(image, batch.truth),
            }
            if distance is not None:
                scores["validation_perceptual_before"] = distance(render, batch.truth).mean()
                scores["validation_perceptual"] = distance(image, batch.truth).mean()
            for name, score in scores.items():
                sums[name] = sums.get(name, 0.0) + float(score) / len(crops)
    return sums


def _psnr(image: Tensor, truth: Tensor) -> Tensor:
    return -10.0 * (image - truth).square().mean().clamp_min(1e-10).log10()
