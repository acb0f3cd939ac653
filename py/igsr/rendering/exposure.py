"""``apply_exposure``: a rendered picture as a photo of some exposure and white balance has it."""

from __future__ import annotations

from torch import Tensor

from igsr.errors import IgsrError


def apply_exposure(image: Tensor, gain: Tensor, offset: Tensor) -> Tensor:
    """Give rendered pictures the exposures of their photos, before the loss.

    For training loops of one's own: with a parameter ``gain`` (1 at first) and ``offset`` (0) for
    each photo, differentiable in all three. It is what ``igsr.fit`` does with ``exposure="on"``
    (the renderer's stage ``exposure``). Keep the means of log gain and of offset over the photos at
    zero: brighter splats with lower gains look the same.

    Args:
        image: [..., H, W, 3], rendered RGB, encoded as photos are (sRGB), 1 at the brightest.
        gain: [..., 3], factors of R, G and B, above 0.
        offset: [..., 3], added after it.

    Returns:
        [..., H, W, 3], ``gain * image + offset`` cut to [0, 1]. The gradient goes back where
        nothing is cut, and where it brings a cut color closer to what a photo holds.

    Raises:
        IgsrError: the shapes do not go together.
    """
    batch = image.shape[:-3]
    if image.ndim < 3 or image.shape[-1] != 3:
        raise IgsrError(f"image must have shape [..., H, W, 3], not {list(image.shape)}.")
    for name, values in (("gain", gain), ("offset", offset)):
        if values.shape not in ((3,), (*batch, 3)):
            raise IgsrError(
                f"{name} must have shape {[*batch, 3]} or [3], not {list(values.shape)}."
            )
    colors = image * gain[..., None, None, :] + offset[..., None, None, :]
    if colors.requires_grad:
        raw = colors.detach()
        colors.register_hook(
            lambda v: (
                None
                if v is None
                else v.masked_fill(((raw > 1.0) & (v < 0.0)) | ((raw < 0.0) & (v > 0.0)), 0.0)
            )
        )
    # The value is the cut one, the gradient that of what was cut.
    return colors + (colors.clamp(0.0, 1.0) - colors).detach()
