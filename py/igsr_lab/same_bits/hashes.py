"""Hashes of results, and the numbers of reports under names that outlive renames."""

from __future__ import annotations

import dataclasses
import hashlib
import json
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch
from PIL import Image

import igsr

#: Renamed keys of reports, new to old, so that older records still match. A number that was moved
#: has its whole path here: ``{"settings.steps": "steps"}``.
REPORT_KEYS: dict[str, str] = {
    "after": "with",
    "center": "center",
    "gain": "worth",
    "mean_confidence": "mean_trust",
    "rejected": "passed",
    "selected": "views",
    "train_views": "refine_views",
    "validation_views": "judge_views",
}
#: Keys whose numbers differ from run to run.
NOT_REPEATABLE = ("seconds", "cpu_seconds", "peak_memory_bytes")

Results = Iterator[tuple[str, Any]]


def digest(value: Any) -> str:
    """SHA-256 of a result's numbers: arrays with dtype and shape, splats, cameras, files' bytes."""
    sha = hashlib.sha256()
    _feed(sha, value)
    return sha.hexdigest()


def _feed(sha: Any, value: Any) -> None:
    if isinstance(value, torch.Tensor):
        value = value.detach().cpu().numpy()
    if isinstance(value, igsr.Splats):
        names = ("means", "quats", "scales", "opacities", "sh", "origin", "antialiased")
        value = [getattr(value, name) for name in names]
    elif isinstance(value, igsr.Camera):
        value = [value.viewmat, value.K, value.width, value.height]
    elif isinstance(value, igsr.Render):
        names = ("color", "alpha", "depth", "expected_depth", "transmittance")
        value = [getattr(value, name) for name in names]
    if isinstance(value, np.ndarray):
        sha.update(f"{value.dtype.str}{value.shape}".encode())
        sha.update(np.ascontiguousarray(value).tobytes())
    elif isinstance(value, (bytes, bytearray)):
        sha.update(b"bytes")
        sha.update(value)
    elif isinstance(value, Path):
        _feed(sha, value.read_bytes())
    elif isinstance(value, (list, tuple)):
        sha.update(f"list{len(value)}".encode())
        for item in value:
            _feed(sha, item)
    elif isinstance(value, np.generic):
        _feed(sha, value.item())
    elif value is None or isinstance(value, (bool, int, float)):
        sha.update(repr(value).encode())
    else:
        raise TypeError(f"{type(value).__name__} has no hash here")


def stable_name(path: str) -> str:
    """Name of a number in a report (``rounds[].test.psnr``), with renamed keys put back."""
    parts = [part.partition("[") for part in path.split(".")]
    name = ".".join(REPORT_KEYS.get(key, key) + bracket + rest for key, bracket, rest in parts)
    return REPORT_KEYS.get(name, name)


def numbers(report: Any) -> dict[str, list[Any]]:
    """Numbers of a report by stable name; numbers in lists are joined, and texts left out."""
    found: dict[str, list[Any]] = {}

    def walk(value: Any, path: str) -> None:
        if dataclasses.is_dataclass(value) and not isinstance(value, type):
            value = vars(value)
        if isinstance(value, Mapping):
            for key, item in value.items():
                if key not in NOT_REPEATABLE:
                    walk(item, f"{path}.{key}" if path else key)
        elif isinstance(value, (list, tuple)):
            for item in value:
                walk(item, f"{path}[]")
        elif isinstance(value, np.generic):
            walk(value.item(), path)
        elif value is None or isinstance(value, (bool, int, float)):
            found.setdefault(stable_name(path), []).append(value)

    walk(report, "")
    return found


def named_numbers(report: Any) -> Results:
    """Numbers of a report by name, without names whose values are all None."""
    for name, values in numbers(report).items():
        if any(value is not None for value in values):
            yield name, values


def pixels(path: Path) -> np.ndarray:
    """Decoded pixels of a picture; its compression may change."""
    with Image.open(path) as picture:
        return np.asarray(picture)


def read_json(path: Path) -> Any:
    return json.loads(path.read_text(encoding="utf-8"))


def prefixed(prefix: str, results: Results) -> Results:
    for name, value in results:
        yield f"{prefix}.{name}", value
