"""Networks that make a picture from a render and one photo in a single step, as denoisers.

Single-step diffusion refiners work so (Wu et al., "Difix3D+: Improving 3D Reconstructions with
Single-Step Diffusion Models", CVPR 2025): they take a render and the nearest photo, and give no
confidence.
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
    """A denoiser of a function from a render and a photo to a picture.

    Args:
        model: takes a render and a photo, both float32 [1, 3, H, W] in [0, 1], and returns a
            picture [1, 3, H, W] in [0, 1]. The photo is None where there is none.
        multiple: sides of what the model gets are multiples of this; borders are repeated.
        longest: longest side of what the model gets, pixels; larger renders are reduced, and what
            the model changes is enlarged. None leaves the size.
        device: where the model is, such as "cuda".
    """

    def __init__(
        self,
        model: Callable[[Tensor, Tensor | None], Tensor],
        multiple: int = 8,
        longest: int | None = None,
        device: str = "cpu",
    ) -> None:
        """Keep what is given.

        Raises:
            IgsrError: ``multiple`` or ``longest`` is not positive.
        """
        if multiple < 1 or (longest is not None and longest < multiple):
            raise IgsrError("multiple must be at least 1, and longest at least multiple")
        self._model, self._multiple, self._longest = model, multiple, longest
        self._device = torch.device(device)

    def __call__(self, render: Buffers, photos: Sequence[Source]) -> Float32:
        """The model's picture, float32 [H, W, 3] in [0, 1]; see ``igsr.denoise``.

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
            near = None if photo is None else self._padded(_resized(photo, size))
            made = self._model(self._padded(small), near)
            if made.shape != self._padded(small).shape:
                raise IgsrError(
                    f"the denoiser's model made {list(made.shape)} of "
                    f"{list(self._padded(small).shape)}"
                )
            change = made[..., : size[0], : size[1]].float() - small
            picture = (whole + _resized(change, (height, width))).clamp(0.0, 1.0)
        array: Float32 = picture[0].permute(1, 2, 0).contiguous().cpu().numpy()
        return array

    def _nearest(self, render: Buffers, photos: Sequence[Source]) -> Tensor | None:
        """The photo that is taken from nearest, and in the most alike direction."""
        if render.camera is None or not photos:
            return None
        forward, centre = render.camera.viewmat[2, :3], render.camera.center
        apart = [float(np.linalg.norm(photo.camera.center - centre)) for photo in photos]
        reach = max(apart) or 1.0
        turned = [1.0 - float(photo.camera.viewmat[2, :3] @ forward) for photo in photos]
        nearest = int(np.argmin([a / reach + t for a, t in zip(apart, turned, strict=True)]))
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
