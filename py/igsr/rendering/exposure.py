"""``apply_exposure``: apply a photo's exposure and white balance to a rendered picture."""

from __future__ import annotations

from torch import Tensor

from igsr.errors import IgsrError


def apply_exposure(image: Tensor, gain: Tensor, offset: Tensor) -> Tensor:
    """Apply exposures to rendered pictures, differentiably, before the loss.

    For custom training loops: optimize a ``gain``, initially 1, and an ``offset``, initially 0, per
    photo, as ``igsr.fit`` does with ``exposure="on"``. Keep the means of log gain and of offset
    over the photos at zero: brighter splats with lower gains look the same.

    Args:
        image: [..., H, W, 3] rendered RGB, sRGB-encoded like photos, in [0, 1].
        gain: [..., 3] factors of R, G and B, above 0.
        offset: [..., 3], added after ``gain``.

    Returns:
        [..., H, W, 3], ``gain * image + offset`` clamped to [0, 1]. Clamped colors have a gradient
        only if it moves them towards [0, 1].

    Raises:
        IgsrError: the shapes do not match.
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
    # The value is clamped, but the gradient is not.
    return colors + (colors.clamp(0.0, 1.0) - colors).detach()
