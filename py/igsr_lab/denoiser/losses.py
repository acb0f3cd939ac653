"""Losses of the denoiser: the default and the three of the paper.

The default uses ratios, so that good and bad renders have the same weight, as in mean decibels.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from igsr.errors import IgsrError
from igsr_lab.denoiser.perceptual_distance import Distance
from igsr_lab.denoiser.training_settings import LOSSES

#: Weights of the default loss's parts; the squared error's ratio has weight 1.
STRUCTURE_WEIGHT = 1.0
PERCEPTUAL_WEIGHT = 0.1
LIKELIHOOD_WEIGHT = 0.1
#: Weight of the perceptual distance in loss "charbonnier".
CHARBONNIER_PERCEPTUAL_WEIGHT = 0.05
#: SSIM is not defined for smaller pictures.
MIN_SSIM_SIDE_PX = 11
#: Smaller color differences count by their square (Charbonnier).
CHARBONNIER_EPSILON = 1e-3
#: Squared error, 1 - SSIM and perceptual distance that need not get smaller.
SQUARED_FLOOR = 1e-4
STRUCTURE_FLOOR = 1e-3
PERCEPTUAL_FLOOR = 0.01
#: The perceptual distance of one in this many pictures of a batch is used; all would take half as
#: long as the network.
PERCEPTUAL_EVERY = 3


@dataclass(frozen=True)
class Prediction:
    """Output of the network for a batch, and its targets."""

    render: Tensor  # [B, 3, H, W] in [0, 1], the input
    image: Tensor  # [B, 3, H, W], the output; not clamped
    log_error: Tensor  # [B, 1, H, W], natural logarithm of the predicted absolute error
    truth: Tensor  # [B, 3, H, W] in [0, 1]


def charbonnier(prediction: Prediction) -> Tensor:
    """Mean of sqrt(difference^2 + eps^2) - eps, a smooth absolute error (Charbonnier 1994)."""
    difference = prediction.image - prediction.truth
    smooth = (difference.square() + CHARBONNIER_EPSILON**2).sqrt()
    return (smooth - CHARBONNIER_EPSILON).mean()


def squared_ratio(prediction: Prediction) -> Tensor:
    """Mean over pictures of ln(squared error after / before): -0.23 is a gain of 1 dB."""
    after = (prediction.image - prediction.truth).square().mean(dim=(1, 2, 3))
    before = (prediction.render - prediction.truth).square().mean(dim=(1, 2, 3))
    return ((after + SQUARED_FLOOR) / (before + SQUARED_FLOOR)).log().mean()


def structure_ratio(prediction: Prediction) -> Tensor:
    """Mean over pictures of ln((1 - SSIM) after / before), of gray pictures.

    The squared error alone favors smooth pictures if the truth is uncertain.
    """
    from torchmetrics.functional.image import structural_similarity_index_measure

    def unlike(image: Tensor) -> Tensor:
        # Gray pictures take a third of the time.
        similarity = structural_similarity_index_measure(
            image.mean(dim=1, keepdim=True), gray, data_range=1.0, reduction="none"
        )
        assert isinstance(similarity, Tensor)
        return 1.0 - similarity + STRUCTURE_FLOOR

    gray = prediction.truth.mean(dim=1, keepdim=True)
    if min(gray.shape[-2:]) < MIN_SSIM_SIDE_PX:
        return gray.new_zeros(())
    with torch.no_grad():
        before = unlike(prediction.render)
    return (unlike(prediction.image) / before).log().mean()


def regret(prediction: Prediction) -> Tensor:
    """Mean increase of absolute errors; 0 for pixels that improved."""
    before = (prediction.render - prediction.truth).abs()
    after = (prediction.image - prediction.truth).abs()
    return (after - before).clamp_min(0.0).mean()


def error_likelihood(prediction: Prediction) -> Tensor:
    """Negative log-likelihood of the error under a Laplace distribution of the predicted scale.

    Its gradient does not reach the picture; else hard pixels would be given up.
    """
    error = (prediction.image.detach() - prediction.truth).abs().mean(dim=1, keepdim=True)
    return (error * (-prediction.log_error).exp() + prediction.log_error).mean()


def perceptual(prediction: Prediction, distance: Distance) -> Tensor:
    """Mean perceptual distance of the clamped pictures."""
    return distance(_clamped(prediction.image), prediction.truth).mean()


def perceptual_ratio(prediction: Prediction, distance: Distance) -> Tensor:
    """Mean of ln(perceptual distance after / before) of a batch's first pictures."""
    some = slice(-(-len(prediction.image) // PERCEPTUAL_EVERY))
    truth = prediction.truth[some]
    after = distance(_clamped(prediction.image[some]), truth)
    with torch.no_grad():
        before = distance(prediction.render[some], truth)
    return ((after + PERCEPTUAL_FLOOR) / (before + PERCEPTUAL_FLOOR)).log().mean()


def _clamped(image: Tensor) -> Tensor:
    """Clamp to [0, 1], but pass gradients, so that colors out of range can come back."""
    return image + (image.clamp(0.0, 1.0) - image).detach()


class Discriminator(nn.Module):
    """Classifies patches as true or not: logits [B, 1, h, w] (Isola et al. 2017)."""

    def __init__(self, width: int = 48) -> None:
        super().__init__()
        self.layers = nn.Sequential(
            nn.Conv2d(3, width, 4, stride=2, padding=1),
            nn.LeakyReLU(0.2),
            nn.Conv2d(width, 2 * width, 4, stride=2, padding=1),
            nn.GroupNorm(8, 2 * width),
            nn.LeakyReLU(0.2),
            nn.Conv2d(2 * width, 4 * width, 4, stride=2, padding=1),
            nn.GroupNorm(8, 4 * width),
            nn.LeakyReLU(0.2),
            nn.Conv2d(4 * width, 1, 3, padding=1),
        )

    def forward(self, picture: Tensor) -> Tensor:
        """Logits of pictures [B, 3, H, W] in [0, 1]; positive if true."""
        logits: Tensor = self.layers(2.0 * picture - 1.0)
        return logits

    def loss(self, prediction: Prediction) -> Tensor:
        """-E log D(truth) - E log(1 - D(image)), clamped; does not reach the denoiser."""
        true = F.softplus(-self(prediction.truth)).mean()
        made = F.softplus(self(_clamped(prediction.image.detach()))).mean()
        return true + made


class Loss:
    """A loss by name.

    Args:
        name: "default" (ratios of the squared error, of 1 - SSIM and of the perceptual distance, if
            there is one), "charbonnier" (absolute errors and that distance), "gan", "gan+lpips"
            ((1 - a) GAN + a LPIPS) or "lpips". All include the likelihood of the predicted error.
        distance: the perceptual distance, or None.
        a: of "gan+lpips"; the paper has 0.9.
    """

    def __init__(self, name: str, distance: Distance | None, a: float = 0.9) -> None:
        if name not in LOSSES:
            raise IgsrError(f"loss must be one of {', '.join(LOSSES)}, not {name!r}")
        if name.endswith("lpips") and distance is None:
            raise IgsrError(f"loss {name} needs a perceptual distance; name --features or --lpips")
        if not 0.0 <= a <= 1.0:
            raise IgsrError(f"a must be from 0 to 1, not {a:g}")
        self.name, self.distance, self.a = name, distance, a
        self.discriminator = Discriminator() if "gan" in name else None

    def __call__(self, prediction: Prediction) -> tuple[Tensor, dict[str, float]]:
        """The total, and its parts by name for the log."""
        parts: dict[str, tuple[float, Tensor]] = {}
        if self.name == "default":
            parts["squared_ratio"] = 1.0, squared_ratio(prediction)
            parts["structure_ratio"] = STRUCTURE_WEIGHT, structure_ratio(prediction)
            if self.distance is not None:
                ratio = perceptual_ratio(prediction, self.distance)
                parts["perceptual_ratio"] = PERCEPTUAL_WEIGHT, ratio
        elif self.name == "charbonnier":
            parts["charbonnier"] = 1.0, charbonnier(prediction)
            if self.distance is not None:
                distance = perceptual(prediction, self.distance)
                parts["perceptual"] = CHARBONNIER_PERCEPTUAL_WEIGHT, distance
        if self.discriminator is not None:
            weight = 1.0 if self.name == "gan" else 1.0 - self.a
            logits = self.discriminator(_clamped(prediction.image))
            parts["gan"] = weight, F.softplus(-logits).mean()
        if self.name.endswith("lpips") and self.distance is not None:
            weight = 1.0 if self.name == "lpips" else self.a
            parts["perceptual"] = weight, perceptual(prediction, self.distance)
        parts["likelihood"] = LIKELIHOOD_WEIGHT, error_likelihood(prediction)
        total = torch.stack([weight * part for weight, part in parts.values()]).sum()
        shown = {"total": total} | {name: part for name, (_, part) in parts.items()}
        return total, {name: float(part.detach()) for name, part in shown.items()}
