"""LoMa's features and matches (Nordstroem et al., "LoMa: Local Feature Matching Revisited", 2026).

The package ``lomatch`` has the network; its code is MIT and Apache-2.0. It fetches its weights by
torch.hub, whose cache then holds them. It is no extra of igsr: it asks for the package
``dataclasses``, which exists for Python 3.6 only, so pip must be told to take it without what it
asks for.
"""

from __future__ import annotations

import contextlib
import os
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any
from urllib.parse import urlparse

import numpy as np
import numpy.typing as npt

from igsr.errors import IgsrError
from igsr.pose.colmap.matcher import PhotoFeatures
from igsr.pose.weights import OFFLINE

#: Features of a photo, at most. LoMa's default; its cost grows with the square.
MOST_FEATURES = 2048


class Loma:
    """Finds and matches features with LoMa-B, on a CUDA device where torch has one.

    Raises:
        IgsrError: the package is not installed, or its weights can neither be found nor fetched.
    """

    name = "loma"

    def __init__(self) -> None:
        try:
            from loma import LoMa, LoMaB
            from loma.loma import filter_matches
        except ImportError as error:
            raise IgsrError(
                f"matcher loma needs the package lomatch ({error}); install it with "
                "pip install einops opencv-python torchvision tqdm tyro and "
                "pip install --no-deps lomatch==1.0.0"
            ) from error
        with _checked_downloads():
            self._network: Any = LoMa(LoMaB())
        self._filtered = filter_matches

    def features(self, photo: Path) -> PhotoFeatures:
        """See ``Matcher``."""
        xy, descriptors, height, width = self._network.detect_and_describe(
            str(photo), MOST_FEATURES
        )
        # LoMa's places are from -1 to 1, from border to border.
        pixels = 0.5 * (_numpy(xy[0]) + 1.0) * np.array([width, height], dtype=np.float32)
        return PhotoFeatures(pixels, _numpy(descriptors[0]), (width, height))

    def matches(self, first: PhotoFeatures, second: PhotoFeatures) -> npt.NDArray[np.uint32]:
        """See ``Matcher``."""
        import torch

        places = [
            torch.from_numpy(2.0 * one.xy / np.array(one.size, dtype=np.float32) - 1.0)[None]
            for one in (first, second)
        ]
        descriptors = [torch.from_numpy(one.descriptors)[None] for one in (first, second)]
        with torch.inference_mode():
            scores = self._network(*places, *descriptors)["scores"]
            partner = self._filtered(scores, self._network.cfg.filter_threshold)[0][0].cpu().numpy()
        matched = np.flatnonzero(partner >= 0)
        return np.stack([matched, partner[matched]], axis=1).astype(np.uint32)


def _numpy(tensor: Any) -> npt.NDArray[np.float32]:
    array: npt.NDArray[np.float32] = tensor.float().cpu().numpy()
    return array


@contextlib.contextmanager
def _checked_downloads() -> Iterator[None]:
    """Let torch.hub's downloads fail with a message, and load tensors only, no code."""
    import torch

    original: Callable[..., Any] = torch.hub.load_state_dict_from_url

    def load(url: str, *args: Any, **kwargs: Any) -> Any:
        folder = Path(torch.hub.get_dir()) / "checkpoints"
        file = folder / Path(urlparse(url).path).name
        if os.environ.get(OFFLINE, "0") not in ("", "0") and not file.is_file():
            raise IgsrError(f"matcher loma needs {file}, and {OFFLINE} is set; put {url} there")
        try:
            return original(url, *args, **{**kwargs, "weights_only": True})
        except Exception as error:  # torch.hub raises what urllib, the disk and pickle raise
            raise IgsrError(
                f"matcher loma: its weights cannot be fetched or read ({error}); check the "
                f"network, or put {url} at {file}"
            ) from error

    torch.hub.load_state_dict_from_url = load
    try:
        yield
    finally:
        torch.hub.load_state_dict_from_url = original
