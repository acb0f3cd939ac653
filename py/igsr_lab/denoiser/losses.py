"""What a denoiser is trained to make small: the default and the three losses of the paper.

The default counts ratios: a render that is nearly right and one that is all wrong weigh the same,
as they do in mean decibels.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from igsr.errors import IgsrError
from igsr_lab.denoiser.perceptual_distance import Distance
from igsr_lab.denoiser.training_settings import LOSSES

#: Parts of the default, beside the squared error's ratio, which counts 1.
STRUCTURE, PERCEPTUAL, LIKELIHOOD = 1.0, 0.1, 0.1
#: Part of "charbonnier" that the perceptual distance has.
CHARBONNIER_PERCEPTUAL = 0.05
#: SSIM has nothing to say of pictures that are no larger than what it leaves out at the borders.
STRUCTURE_SIDE = 11
#: Below this the distance of two colours counts by its square (Charbonnier).
CHARBONNIER = 1e-3
#: Squared errors, 1 - SSIM and perceptual distances that need not get smaller.
SQUARED_FLOOR, STRUCTURE_FLOOR, PERCEPTUAL_FLOOR = 1e-4, 1e-3, 0.01
#: The perceptual distance is taken of one in so many pictures of a batch: of all of them it would
#: take half as long again as the network.
PERCEPTUAL_OF = 3


@dataclass(frozen=True)
class Prediction:
    """What a network made of a batch, and what it should have made.

    Attributes:
        render: [B, 3, H, W] in [0, 1], before.
        image: [B, 3, H, W], after; not clamped.
        log_error: [B, 1, H, W], natural logarithm of the predicted absolute error.
        truth: [B, 3, H, W] in [0, 1].
    """

    render: Tensor
    image: Tensor
    log_error: Tensor
    truth: Tensor


def charbonnier(prediction: Prediction) -> Tensor:
    """Mean of sqrt(difference^2 + eps^2) - eps: a smooth absolute error (Charbonnier 1994)."""
    difference = prediction.image - prediction.truth
    return ((difference.square() + CHARBONNIER**2).sqrt() - CHARBONNIER).mean()


def squared_ratio(prediction: Prediction) -> Tensor:
    """Mean over pictures of ln(squared error after / before): -0.23 is a decibel gained."""
    after = (prediction.image - prediction.truth).square().mean(dim=(1, 2, 3))
    before = (prediction.render - prediction.truth).square().mean(dim=(1, 2, 3))
    return ((after + SQUARED_FLOOR) / (before + SQUARED_FLOOR)).log().mean()


def structure_ratio(prediction: Prediction) -> Tensor:
    """Mean over pictures of ln((1 - SSIM) after / before), of the means of the colours.

    Squared errors alone are least where what is uncertain is smooth, which costs structure.
    """
    from torchmetrics.functional.image import structural_similarity_index_measure

    def unlike(image: Tensor) -> Tensor:
        # Of grey pictures it takes a third of the time.
        similarity = structural_similarity_index_measure(
            image.mean(dim=1, keepdim=True), grey, data_range=1.0, reduction="none"
        )
        assert isinstance(similarity, Tensor)
        return 1.0 - similarity + STRUCTURE_FLOOR

    grey = prediction.truth.mean(dim=1, keepdim=True)
    if min(grey.shape[-2:]) < STRUCTURE_SIDE:
        return grey.new_zeros(())
    with torch.no_grad():
        before = unlike(prediction.render)
    return (unlike(prediction.image) / before).log().mean()


def regret(prediction: Prediction) -> Tensor:
    """Mean of how much further from the truth colours are than they were; 0 where nearer.

    What was right must stay right: a mean over all pixels would trade it for what was wrong.
    """
    before = (prediction.render - prediction.truth).abs()
    after = (prediction.image - prediction.truth).abs()
    return (after - before).clamp_min(0.0).mean()


def error_likelihood(prediction: Prediction) -> Tensor:
    """Negative log-likelihood of the error under a Laplace distribution of the predicted scale.

    Its gradient does not reach the picture (Kendall and Gal 2017 let it, which lets hard pixels be
    given up).
    """
    error = (prediction.image.detach() - prediction.truth).abs().mean(dim=1, keepdim=True)
    return (error * (-prediction.log_error).exp() + prediction.log_error).mean()


def perceptual(prediction: Prediction, distance: Distance) -> Tensor:
    """Mean distance by a perceptual metric of the clamped pictures."""
    return distance(_clamped(prediction.image), prediction.truth).mean()


def perceptual_ratio(prediction: Prediction, distance: Distance) -> Tensor:
    """Mean of ln(perceptual distance after / before) of a batch's first pictures."""
    some = slice(-(-len(prediction.image) // PERCEPTUAL_OF))
    truth = prediction.truth[some]
    after = distance(_clamped(prediction.image[some]), truth)
    with torch.no_grad():
        before = distance(prediction.render[some], truth)
    return ((after + PERCEPTUAL_FLOOR) / (before + PERCEPTUAL_FLOOR)).log().mean()


def _clamped(image: Tensor) -> Tensor:
    """``image`` in [0, 1]; gradients pass: colours out of range must be able to come back."""
    return image + (image.clamp(0.0, 1.0) - image).detach()


class Discriminator(nn.Module):
    """Tells patches of true pictures from others': logits [B, 1, h, w] (Isola et al. 2017)."""

    def __init__(self, width: int = 48) -> None:
        """Build the layers."""
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
        """Logits of pictures [B, 3, H, W] in [0, 1] being true ones."""
        logits: Tensor = self.layers(2.0 * picture - 1.0)
        return logits

    def loss(self, prediction: Prediction) -> Tensor:
        """-E log D(truth) - E log(1 - D(image)), clamped; does not reach the denoiser."""
        true = F.softplus(-self(prediction.truth)).mean()
        made = F.softplus(self(_clamped(prediction.image.detach()))).mean()
        return true + made


class Loss:
    """A loss by name; its parts are returned beside the total, for logs.

    Args:
        name: of ``LOSSES``: "default" (the ratios of the squared error, of 1 - SSIM and, if there
            is one, of the perceptual distance), "charbonnier" (absolute errors and that distance),
            "gan", "gan+lpips" ((1 - a) GAN + a LPIPS) or "lpips". The predicted error's likelihood
            is part of all: without it there is no confidence; its gradient does not reach the
            picture.
        distance: the perceptual one, where the loss has it.
        a: of "gan+lpips"; the paper has 0.9.

    Raises:
        IgsrError: no such loss, or one that needs a distance without one.
    """

    def __init__(self, name: str, distance: Distance | None, a: float = 0.9) -> None:
        """Check the arguments."""
        if name not in LOSSES:
            raise IgsrError(f"loss must be one of {', '.join(LOSSES)}, not {name!r}")
        if name.endswith("lpips") and distance is None:
            raise IgsrError(f"loss {name} needs a perceptual distance; name --features or --lpips")
        if not 0.0 <= a <= 1.0:
            raise IgsrError(f"a must be from 0 to 1, not {a:g}")
        self.name, self.distance, self.a = name, distance, a
        self.discriminator = Discriminator() if "gan" in name else None

    def __call__(self, prediction: Prediction) -> tuple[Tensor, dict[str, float]]:
        """The total and its parts."""
        parts: dict[str, tuple[float, Tensor]] = {}
        if self.name == "default":
            parts["squared_ratio"] = 1.0, squared_ratio(prediction)
            parts["structure_ratio"] = STRUCTURE, structure_ratio(prediction)
            if self.distance is not None:
                parts["perceptual_ratio"] = PERCEPTUAL, perceptual_ratio(prediction, self.distance)
        elif self.name == "charbonnier":
            parts["charbonnier"] = 1.0, charbonnier(prediction)
            if self.distance is not None:
                distance = perceptual(prediction, self.distance)
                parts["perceptual"] = CHARBONNIER_PERCEPTUAL, distance
        if self.discriminator is not None:
            weight = 1.0 if self.name == "gan" else 1.0 - self.a
            logits = self.discriminator(_clamped(prediction.image))
            parts["gan"] = weight, F.softplus(-logits).mean()
        if self.name.endswith("lpips") and self.distance is not None:
            weight = 1.0 if self.name == "lpips" else self.a
            parts["perceptual"] = weight, perceptual(prediction, self.distance)
        parts["likelihood"] = LIKELIHOOD, error_likelihood(prediction)
        total = torch.stack([weight * part for weight, part in parts.values()]).sum()
        shown = {"total": total} | {name: part for name, (_, part) in parts.items()}
        return total, {name: float(part.detach()) for name, part in shown.items()}
