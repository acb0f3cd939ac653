"""What pose networks share: the precision that they run in, and arrays of their outputs."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor


def half_precision(device: torch.device) -> torch.autocast:
    """bfloat16, else float16, on a GPU; a context that changes nothing elsewhere."""
    if device.type != "cuda":
        return torch.autocast(device.type, enabled=False)
    native = torch.cuda.is_bf16_supported(including_emulation=False)
    return torch.autocast("cuda", dtype=torch.bfloat16 if native else torch.float16)


def float32_array(tensor: Tensor) -> npt.NDArray[np.float32]:
    """A tensor of any device and precision as a float32 array."""
    array: npt.NDArray[np.float32] = tensor.float().cpu().numpy()
    return array
