"""How the denoiser is trained: pairs of renders and true pictures, losses, the training itself.

``make_pairs`` degrades fits on purpose and keeps renders of views beside their true pictures.
``train`` learns a network from such pairs; ``Training`` holds its settings. Names are imported when
they are first used (PEP 562), so that command lines load no torch.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from igsr.denoiser.training.pairs import make_pairs
    from igsr.denoiser.training.train_network import train
    from igsr.denoiser.training.training_run import TrainingProgress
    from igsr.denoiser.training.training_settings import Training

__all__ = ["Training", "TrainingProgress", "make_pairs", "train"]

#: Where each public name is defined.
_HOME_OF = {
    "Training": "igsr.denoiser.training.training_settings",
    "TrainingProgress": "igsr.denoiser.training.training_run",
    "make_pairs": "igsr.denoiser.training.pairs",
    "train": "igsr.denoiser.training.train_network",
}


def __getattr__(name: str) -> Any:
    if name not in _HOME_OF:
        raise AttributeError(f"module 'igsr.denoiser.training' has no attribute {name!r}")
    value = getattr(importlib.import_module(_HOME_OF[name]), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
