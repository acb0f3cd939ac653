"""Denoisers from networks that turn a render and one photo into a picture in a single step.

An example are single-step diffusion refiners (Wu et al., "Difix3D+: Improving 3D Reconstructions
with Single-Step Diffusion Models", CVPR 2025). They give no confidence.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
import numpy.typing as npt
import torch
import torch.nn.functional as F
from torch import Tensor

from igsr.denoiser.buffers import Buffers
from igsr.denoiser.warping import Source
from igsr.errors import IgsrError

Float32 = npt.NDArray[np.float32]


class SingleStepDenoiser:
    """A denoiser from a function of a render and a photo.

    Args:
        model: takes a render and a photo, both float32 [1, 3, H, W] in [0, 1], and returns a
            picture [1, 3, H, W] in [0, 1]. The photo is None without photos.
        multiple: pictures are padded to multiples of this, in pixels, by repeating the border.
        longest: maximum longest side of the model's pictures, pixels. Larger renders are reduced,
            and the changes are enlarged. None keeps the size.
        device: of the model, such as "cuda".

    Raises:
        IgsrError: ``multiple`` or ``longest`` is not positive.
    """

    def __init__(
        self,
        model: Callable[[Tensor, Tensor | None], Tensor],
        multiple: int = 8,
        longest: int | None = None,
        device: str = "cpu",
    ) -> None:
        if multiple < 1 or (longest is not None and longest < multiple):
            raise IgsrError("multiple must be at least 1, and longest at least multiple")
        self._model, self._multiple, self._longest = model, multiple, longest
        self._device = torch.device(device)

    def __call__(self, render: Buffers, photos: Sequence[Source]) -> Float32:
        """Return the model's picture, float32 [H, W, 3] in [0, 1]; see ``igsr.denoise``.

        Raises:
            IgsrError: the model returns another shape.
        """
        color = np.clip(np.nan_to_num(render.color), 0.0, 1.0).astype(np.float32)
        whole = torch.from_numpy(color).permute(2, 0, 1)[None].to(self._device)
        height, width = color.shape[:2]
        scale = min(1.0, (self._longest or max(height, width)) / max(height, width))
        size = (max(1, round(scale * height)), max(1, round(scale * width)))
        photo = self._nearest(render, photos)
        with torch.inference_mode():
            small = _resized(whole, size)
            padded = self._padded(small)
            near = None if photo is None else self._padded(_resized(photo, size))
            output = self._model(padded, near)
            if output.shape != padded.shape:
                raise IgsrError(
                    f"the denoiser's model returned {list(output.shape)} for {list(padded.shape)}"
                )
            change = output[..., : size[0], : size[1]].float() - small
            picture = (whole + _resized(change, (height, width))).clamp(0.0, 1.0)
        array: Float32 = picture[0].permute(1, 2, 0).contiguous().cpu().numpy()
        return array

    def _nearest(self, render: Buffers, photos: Sequence[Source]) -> Tensor | None:
        """The photo with the nearest position and most similar direction."""
        if render.camera is None or not photos:
            return None
        forward, center = render.camera.viewmat[2, :3], render.camera.center
        distances = [float(np.linalg.norm(photo.camera.center - center)) for photo in photos]
        scale = max(distances) or 1.0
        turns = [1.0 - float(photo.camera.viewmat[2, :3] @ forward) for photo in photos]
        nearest = int(np.argmin([d / scale + t for d, t in zip(distances, turns, strict=True)]))
        color = torch.from_numpy(np.ascontiguousarray(photos[nearest].color))
        return color.permute(2, 0, 1)[None].to(self._device)

    def _padded(self, picture: Tensor) -> Tensor:
        height, width = picture.shape[-2:]
        below, right = -height % self._multiple, -width % self._multiple
        return F.pad(picture, (0, right, 0, below), mode="replicate")


def _resized(picture: Tensor, size: tuple[int, int]) -> Tensor:
    if tuple(picture.shape[-2:]) == size:
        return picture
    return F.interpolate(picture, size, mode="bilinear", antialias=True, align_corners=False)
