"""Weights of pose networks: which there are, under which licence, and how to get them.

Files go to huggingface_hub's cache, where other programs find them too, and are downloaded by that
library (the extra ``weights``). It goes on where a connection was dropped and writes to a temporary
name; that the bytes are those that the server announced is checked here, by their hash.
"""

from __future__ import annotations

import hashlib
import os
import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from igsr.errors import IgsrError
from igsr.pose.huggingface_cache import cache_folder, cached_snapshots

#: Set to anything but 0, it forbids downloads.
OFFLINE = "IGSR_OFFLINE"
#: Where files come from, if not from huggingface.co.
ENDPOINT = "HF_ENDPOINT"
#: Bytes hashed at a time.
_PART = 1 << 20


@dataclass(frozen=True)
class Weights:
    """Published weights of a pose network.

    Attributes:
        name: what igsr calls them.
        estimator: what uses them.
        model: "owner/name" on huggingface.co.
        files: names of the files that are needed, the weights first.
        size: bytes to download, about.
        licence: SPDX identifier of the licence that the publisher states.
        fetched: whether igsr downloads them; of weights whose terms forbid commercial use it does
            not, for their terms are to be accepted by whoever downloads them.
        purpose: what they are for.
    """

    name: str
    estimator: str
    model: str
    files: tuple[str, ...]
    size: int
    licence: str
    fetched: bool
    purpose: str

    @property
    def page(self) -> str:
        """Where they are described, with their terms."""
        return f"https://huggingface.co/{self.model}"

    @property
    def path(self) -> Path | None:
        """The file of the weights in the cache, or None if a file is missing there."""
        for folder in cached_snapshots(self.model):
            if all((folder / name).is_file() for name in self.files):
                return folder / self.files[0]
        return None


_FILES = ("model.safetensors", "config.json")
#: By name, in the order that they are listed.
KNOWN = {
    one.name: one
    for one in (
        Weights(
            "da3-base",
            "da3",
            "depth-anything/DA3-BASE",
            _FILES,
            541_000_000,
            "Apache-2.0",
            True,
            "cameras and depths of all photos in one pass",
        ),
        Weights(
            "da3-small",
            "da3",
            "depth-anything/DA3-SMALL",
            _FILES,
            137_000_000,
            "Apache-2.0",
            True,
            "the same with a quarter of the memory and time",
        ),
        Weights(
            "dust3r-512-dpt",
            "dust3r",
            "naver/DUSt3R_ViTLarge_BaseDecoder_512_dpt",
            _FILES,
            2_280_000_000,
            "CC-BY-NC-SA-4.0",
            False,
            "points of pairs of photos; few photos from far apart",
        ),
    )
}


def known_weights(name: str) -> Weights:
    """The weights of a name.

    Args:
        name: of ``KNOWN``.

    Raises:
        IgsrError: there are none of that name.
    """
    if name not in KNOWN:
        raise IgsrError(f"there are no weights {name!r}; name one of {', '.join(KNOWN)}")
    return KNOWN[name]


def weights_path(name: str) -> Path:
    """The file of weights in the cache; nothing is downloaded.

    Args:
        name: of ``KNOWN``.

    Raises:
        IgsrError: there are none of that name, or they are not in the cache.
    """
    weights = known_weights(name)
    if weights.path is None:
        how = f"run 'igsr weights fetch {name}'" if weights.fetched else f"see {weights.page}"
        raise IgsrError(f"{name} is not in {cache_folder()}; {how}")
    return weights.path


def fetch_weights(name: str) -> Path:
    """Download weights to the cache, and check them there.

    What is there already is checked too. A dropped connection is taken up where it was; what is not
    whole, or not what the server announced, is removed.

    Args:
        name: of ``KNOWN``.

    Returns:
        The file of the weights.

    Raises:
        IgsrError: there are none of that name, igsr does not download them, downloads are forbidden
            (IGSR_OFFLINE), huggingface_hub is not installed, or the download failed.
    """
    weights = known_weights(name)
    if not weights.fetched:
        raise IgsrError(
            f"{name} is under {weights.licence}, which forbids commercial use, so igsr does not "
            f"download it; accept its terms and get it from {weights.page}"
        )
    if os.environ.get(OFFLINE, "0") not in ("", "0"):
        raise IgsrError(f"{OFFLINE} is set, so {name} is not downloaded; unset it, or name a file")
    try:
        import huggingface_hub
    except ImportError as error:
        raise IgsrError(
            "downloads need huggingface_hub; install it by: pip install 'igsr[weights]'"
        ) from error
    source: dict[str, Any] = {"endpoint": os.environ.get(ENDPOINT) or None, "token": False}
    commit: str | None = None  # of the first file: all must be of one revision
    try:
        # The small file first: what answers wrongly is known before the large one is loaded.
        for file in reversed(weights.files):
            url = huggingface_hub.hf_hub_url(
                weights.model, file, revision=commit, endpoint=source["endpoint"]
            )
            announced = huggingface_hub.get_hf_file_metadata(url, **source)
            commit = commit or announced.commit_hash
            path = Path(
                huggingface_hub.hf_hub_download(
                    weights.model,
                    file,
                    revision=commit,
                    cache_dir=cache_folder(),
                    **source,
                )
            )
            if not _is_what_was_announced(path, announced.etag):
                _remove(path)
                raise IgsrError(
                    f"{file} of {weights.model} is not what the server announced, so it was "
                    "removed; try again, or look for a proxy that changes downloads"
                )
        _set_current(weights, path)
    except IgsrError:
        raise
    except Exception as error:  # several libraries' own
        reason = (str(error).strip().splitlines() or [type(error).__name__])[0]
        raise IgsrError(f"{name} could not be downloaded ({reason}); try again") from error
    return path


def sha256_of(path: Path) -> str:
    """The SHA-256 of a file, in hexadecimal digits.

    Args:
        path: of the file.
    """
    return _digest(path, hashlib.sha256())


def _is_what_was_announced(path: Path, etag: str | None) -> bool:
    """Whether a file has the hash that the server gave: SHA-256, or git's SHA-1 of small files."""
    etag = (etag or "").lower()
    if re.fullmatch("[0-9a-f]{64}", etag):
        return sha256_of(path) == etag
    if re.fullmatch("[0-9a-f]{40}", etag):
        git = hashlib.sha1(f"blob {path.stat().st_size}\0".encode(), usedforsecurity=False)
        return _digest(path, git) == etag
    return False


def _digest(path: Path, digest: Any) -> str:
    with path.open("rb") as file:
        while part := file.read(_PART):
            digest.update(part)
    found: str = digest.hexdigest()
    return found


def _remove(path: Path) -> None:
    """Take a file out of the cache: the link in the snapshot, and what it leads to."""
    path.resolve().unlink(missing_ok=True)
    path.unlink(missing_ok=True)


def _set_current(weights: Weights, path: Path) -> None:
    """Note the revision as the model's current one, as the library does for a branch."""
    from igsr._internal.atomic_write import atomic_write

    reference = cache_folder() / f"models--{weights.model.replace('/', '--')}" / "refs" / "main"
    with atomic_write(reference) as temporary:
        temporary.write_text(path.parent.name)
