"""Find checkpoints of pose networks: named files, environment variables and caches.

Without torch, so that a command can look for them fast. Nothing is downloaded.
"""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path

from igsr.cameras.weights import cached_snapshots
from igsr.errors import IgsrError

#: The weights in a checkpoint's folder.
WEIGHTS = "model.safetensors"


@dataclass(frozen=True)
class _Network:
    variable: str
    owner: str
    models: tuple[str, ...]
    advice: str
    in_torch_hub: bool = False


#: By estimator; the best models first.
_NETWORKS = {
    "da3": _Network(
        "IGSR_DA3",
        "depth-anything",
        ("DA3-BASE", "DA3-SMALL"),
        "name a checkpoint of Depth Anything 3, or get one by 'igsr weights fetch'",
    ),
    "dust3r": _Network(
        "IGSR_DUST3R",
        "naver",
        (
            "DUSt3R_ViTLarge_BaseDecoder_512_dpt",
            "DUSt3R_ViTLarge_BaseDecoder_512_linear",
            "DUSt3R_ViTLarge_BaseDecoder_224_linear",
        ),
        "name a checkpoint of DUSt3R, or none",
        in_torch_hub=True,
    ),
}


def find_checkpoint(estimator: str, named: str | os.PathLike[str] | None = None) -> Path | None:
    """Find a checkpoint: named, of the environment variable, or cached; the first that exists.

    The caches are huggingface_hub's and, for DUSt3R, torch.hub's (``checkpoints/NAME.pth``).

    Args:
        estimator: "da3" (IGSR_DA3) or "dust3r" (IGSR_DUST3R).
        named: a file, or a folder with ``model.safetensors``.

    Returns:
        None if there is none.

    Raises:
        IgsrError: the named checkpoint, or that of the variable, does not exist.
    """
    network = _NETWORKS[estimator]
    for source, value in (
        ("checkpoint", named),
        (network.variable, os.environ.get(network.variable)),
    ):
        if value:
            path = Path(value).expanduser()
            path = path / WEIGHTS if exists(path, folder=True) else path
            if not exists(path):
                raise IgsrError(
                    f"{source} names {str(path)!r}, which does not exist; {network.advice}"
                )
            return path
    for model in network.models:
        paths = [folder / WEIGHTS for folder in cached_snapshots(f"{network.owner}/{model}")]
        if network.in_torch_hub:
            paths.insert(0, _torch_hub() / "checkpoints" / f"{model}.pth")
        for path in paths:
            if exists(path):
                return path
    return None


def exists(path: Path, folder: bool = False) -> bool:
    """Whether a path is a file, or a folder; False for invalid names."""
    try:
        return path.is_dir() if folder else path.is_file()
    except (OSError, ValueError):
        return False


def _torch_hub() -> Path:
    """The folder of ``torch.hub.get_dir()``."""
    cache = os.environ.get("XDG_CACHE_HOME") or "~/.cache"
    home = os.environ.get("TORCH_HOME") or os.path.join(cache, "torch")
    return Path(home).expanduser() / "hub"
