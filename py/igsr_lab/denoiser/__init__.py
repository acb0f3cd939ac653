"""How the denoiser is trained: pairs of renders and true pictures, losses, the training itself.

``make_pairs`` degrades fits on purpose and keeps renders of views beside their true pictures.
``train`` learns a network from such pairs; ``Training`` holds its settings. Names are imported when
they are first used (PEP 562), so that command lines load no torch.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from igsr._internal.lazy_exports import lazy_exports

if TYPE_CHECKING:
    from igsr_lab.denoiser.pairs import make_pairs
    from igsr_lab.denoiser.train_network import train
    from igsr_lab.denoiser.training_run import TrainingProgress
    from igsr_lab.denoiser.training_settings import Training

__all__ = ["Training", "TrainingProgress", "make_pairs", "train"]

if not TYPE_CHECKING:
    __getattr__, __dir__ = lazy_exports(
        __name__,
        {
            "igsr_lab.denoiser.pairs": ("make_pairs",),
            "igsr_lab.denoiser.train_network": ("train",),
            "igsr_lab.denoiser.training_settings": ("Training",),
            "igsr_lab.denoiser.training_run": ("TrainingProgress",),
        },
    )
