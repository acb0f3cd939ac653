"""Weights of pose networks: which exist, under which license, and how to download them.

Files are kept in huggingface_hub's cache, which other programs share. That library (the
extra ``weights``) downloads them and resumes dropped connections. Their hashes are checked here.
"""

from __future__ import annotations

import hashlib
import os
import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from igsr._internal.atomic_write import atomic_write
from igsr._internal.input_files import open_file, read_file
from igsr.errors import IgsrError

#: Environment variable that forbids downloads, unless it is 0.
OFFLINE = "IGSR_OFFLINE"
#: Environment variable with the server's address, by default huggingface.co.
ENDPOINT = "HF_ENDPOINT"
_HASHED_BYTES = 1 << 20
_MAX_NAME_BYTES = 1000
_FILES = ("model.safetensors", "config.json")


@dataclass(frozen=True, kw_only=True)
class Weights:
    """Published weights of a pose network.

    Attributes:
        name: in igsr.
        estimator: that uses them.
        model: "owner/name" on huggingface.co.
        files: names of the needed files, the weights first.
        size: bytes to download, approximately.
        license: SPDX identifier of the license that the publisher states.
        fetched: whether igsr downloads them. It does not download weights for non-commercial use,
            since the user has to accept their terms.
        purpose: description for users.
    """

    name: str
    estimator: str
    model: str
    files: tuple[str, ...] = _FILES
    size: int
    license: str = "Apache-2.0"
    fetched: bool = True
    purpose: str

    @property
    def page(self) -> str:
        """The page with their description and terms."""
        return f"https://huggingface.co/{self.model}"

    @property
    def path(self) -> Path | None:
        """The file of the weights in the cache; None if a file is missing there."""
        for folder in cached_snapshots(self.model):
            if all((folder / name).is_file() for name in self.files):
                return folder / self.files[0]
        return None


#: Published weights by name, in the order of lists.
KNOWN = {
    weights.name: weights
    for weights in (
        Weights(
            name="da3-base",
            estimator="da3",
            model="depth-anything/DA3-BASE",
            size=541_000_000,
            purpose="cameras and depths of all photos in one pass",
        ),
        Weights(
            name="da3-small",
            estimator="da3",
            model="depth-anything/DA3-SMALL",
            size=137_000_000,
            purpose="the same with a quarter of the memory and time",
        ),
        Weights(
            name="dust3r-512-dpt",
            estimator="dust3r",
            model="naver/DUSt3R_ViTLarge_BaseDecoder_512_dpt",
            size=2_280_000_000,
            license="CC-BY-NC-SA-4.0",
            fetched=False,
            purpose="points of pairs of photos; few photos from far apart",
        ),
    )
}


def cache_folder() -> Path:
    """The cache: HF_HUB_CACHE, else ``hub`` in HF_HOME, else in the user's cache folder."""
    home = os.environ.get("HF_HOME") or (
        Path(os.environ.get("XDG_CACHE_HOME") or "~/.cache") / "huggingface"
    )
    return Path(os.environ.get("HF_HUB_CACHE") or Path(home) / "hub").expanduser()


def cached_snapshots(model: str) -> list[Path]:
    """Folders of the cached revisions of "owner/name", the current one first, then by name."""
    folder = _model_folder(model)
    try:
        current = read_file(folder / "refs" / "main", _MAX_NAME_BYTES).decode().strip()
    except (OSError, ValueError):
        current = ""
    return sorted(folder.glob("snapshots/*/"), key=lambda path: (path.name != current, path.name))


def _model_folder(model: str) -> Path:
    return cache_folder() / f"models--{model.replace('/', '--')}"


def known_weights(name: str) -> Weights:
    """Look up weights by name.

    Raises:
        IgsrError: the name is not in ``KNOWN``.
    """
    if name not in KNOWN:
        raise IgsrError(f"there are no weights {name!r}; name one of {', '.join(KNOWN)}")
    return KNOWN[name]


def weights_path(name: str) -> Path:
    """Find the file of weights in the cache; nothing is downloaded.

    Raises:
        IgsrError: the name is not in ``KNOWN``, or the weights are not in the cache.
    """
    weights = known_weights(name)
    if weights.path is None:
        how = f"run 'igsr weights fetch {name}'" if weights.fetched else f"see {weights.page}"
        raise IgsrError(f"{name} is not in {cache_folder()}; {how}")
    return weights.path


def fetch_weights(name: str) -> Path:
    """Download weights to the cache and check their hashes, also of files that are already there.

    Incomplete files are removed, as are files whose hash differs from the server's.

    Raises:
        IgsrError: the name is not in ``KNOWN``, igsr does not download these weights, downloads
            are forbidden (IGSR_OFFLINE), huggingface_hub is missing, or the download failed.
    """
    weights = known_weights(name)
    if not weights.fetched:
        raise IgsrError(
            f"{name} is under {weights.license}, which forbids commercial use, so igsr does not "
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
        # The small file first, so that a wrong server is noticed before the large download.
        for file in reversed(weights.files):
            url = huggingface_hub.hf_hub_url(
                weights.model, file, revision=commit, endpoint=source["endpoint"]
            )
            announced = huggingface_hub.get_hf_file_metadata(url, **source)
            commit = commit or announced.commit_hash
            path = Path(
                huggingface_hub.hf_hub_download(
                    weights.model, file, revision=commit, cache_dir=cache_folder(), **source
                )
            )
            if not _has_hash(path, announced.etag):
                # The link in the snapshot, and its target.
                path.resolve().unlink(missing_ok=True)
                path.unlink(missing_ok=True)
                raise IgsrError(
                    f"{file} of {weights.model} does not have the server's hash, so it was "
                    "removed; try again, or look for a proxy that changes downloads"
                )
        # As the library does for a branch.
        with atomic_write(_model_folder(weights.model) / "refs" / "main") as temporary:
            temporary.write_text(path.parent.name)
    except IgsrError:
        raise
    except Exception as error:  # of several libraries
        reason = (str(error).strip().splitlines() or [type(error).__name__])[0]
        raise IgsrError(f"{name} could not be downloaded ({reason}); try again") from error
    return path


def sha256_of(path: Path) -> str:
    """The SHA-256 of a file, in hexadecimal digits."""
    return _digest(path, hashlib.sha256())


def _has_hash(path: Path, etag: str | None) -> bool:
    """Check a file against the server's hash: SHA-256, or git's SHA-1 for small files."""
    etag = (etag or "").lower()
    if re.fullmatch("[0-9a-f]{64}", etag):
        return sha256_of(path) == etag
    if re.fullmatch("[0-9a-f]{40}", etag):
        git = hashlib.sha1(f"blob {path.stat().st_size}\0".encode(), usedforsecurity=False)
        return _digest(path, git) == etag
    return False


def _digest(path: Path, digest: Any) -> str:
    with open_file(path) as file:
        while part := file.read(_HASHED_BYTES):
            digest.update(part)
    return str(digest.hexdigest())
