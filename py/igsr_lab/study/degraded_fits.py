"""Degraded reconstructions: fits from few photos or with noisy cameras, whose renders get denoised.

Scenes are fitted from 3, 6 and 9 photos, and from 20 with noise on their cameras. Renders of the
held-out views are kept beside the true pictures.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from igsr._internal.choices import FitBackend
from igsr._internal.resumable_jobs import Run
from igsr.capture import Capture, View, load_capture
from igsr.capture.load import holds_cameras
from igsr.errors import IgsrError
from igsr.evaluation.scores import known_background
from igsr.fitting.fit_capture import fit_with_cameras
from igsr.fitting.presets import PAPER_STEPS, preset_settings
from igsr_lab.camera_noise import AFFINE, MATRIX, Noise, noise_unit, noisy_view
from igsr_lab.denoiser.pair_files import write_pairs
from igsr_lab.denoiser.pair_renders import check_one_size, rendered_pairs
from igsr_lab.study.real_captures import is_dtu
from igsr_lab.study.splits import HOLDOUT, dtu_views, llff_views, spread_out

#: Kinds of degraded fits: numbers of photos; noise on the cameras of 20, made rotations again; and
#: the same as the paper has it, matrices as they come and 5 000 steps.
FEW = ("3", "6", "9")
NOISE, PAPER = "noise", "paper"
USUAL = (*FEW, NOISE)
KINDS = (*USUAL, PAPER)
NOISY_PHOTOS, CAMERA_NOISE = 20, 0.01
#: Held-out views scored per fit, at most; evenly spaced ones where there are more.
SCORED_VIEWS = 8


@dataclass(frozen=True)
class DegradedFit:
    """One fit of the study; everything that its renders depend on.

    Attributes:
        scene: name of the scene's folder in the data, with "/" between folders.
        kind: of ``KINDS``.
        seed: of the fit and of the noise.
        backend: what fits and renders.
    """

    scene: str
    kind: str
    seed: int
    backend: FitBackend

    @property
    def name(self) -> str:
        """Of its files."""
        return f"{self.scene.replace('/', '-')}-{self.kind}-seed{self.seed}-{self.backend}"

    def renders(self, out: Path) -> Path:
        """The file of its renders in the study's folder."""
        return out / "renders" / f"{self.name}.npz"


@dataclass(frozen=True)
class PlannedFits:
    """The fits of a study, checked against the scenes.

    Attributes:
        runs: one for each fit, in the order of the fits.
        photographs: scenes whose pictures have no alpha.
    """

    runs: list[Run]
    photographs: frozenset[str]


def scenes_in(data: Path) -> tuple[str, ...]:
    """Folders of ``data``, and folders in those, that hold photos with cameras.

    Raises:
        IgsrError: there are none.
    """
    found: list[str] = []
    for pattern in ("*", "*/*"):
        for folder in sorted(data.glob(pattern)):
            name = folder.relative_to(data)
            # A capture's folder of photos is one too, of the same photos.
            if name.parent.as_posix() not in found and folder.is_dir() and holds_cameras(folder):
                found.append(name.as_posix())
    if not found:
        raise IgsrError(f"{data} holds no folder of photos with cameras; name another DATA.")
    return tuple(found)


def described(kind: str) -> str:
    """A kind of degraded fit in words."""
    if kind in FEW:
        return f"{kind} photos"
    steps = f", {PAPER_STEPS} steps" if kind == PAPER else ""
    return f"at most {NOISY_PHOTOS} photos, {_noise(kind)}{steps}"


def planned_fits(data: Path, out: Path, fits: Sequence[DegradedFit]) -> PlannedFits:
    """What there is to fit. Reads all scenes first: an error in the last must not come hours later.

    Args:
        data: folder that holds the scenes.
        out: the study's folder.
        fits: sorted by scene.

    Raises:
        IgsrError: a scene cannot be read, has too few photos, or views of several sizes.
    """
    runs, photographs = [], set()
    for scene in dict.fromkeys(one.scene for one in fits):
        capture = load_capture(data / scene)
        if known_background(capture.views) is None:
            photographs.add(scene)
        for one in (one for one in fits if one.scene == scene):
            degraded = degraded_capture(capture, one)
            check_one_size(degraded.test_views)
            photos = len(degraded.train_views)
            settings = preset_settings("default", photos, steps=_steps(one.kind))
            settings |= {"scored": SCORED_VIEWS}
            runs.append(Run(one.name, one, settings, one.renders(out), scene))
    return PlannedFits(runs, frozenset(photographs))


def degraded_capture(capture: Capture, one: DegradedFit) -> Capture:
    """The photos that a degraded fit has, with the cameras it has, and the views to score.

    A capture with test views is fitted from evenly spaced train views. Others are split as in the
    few-photos study, and a fit with noise has all photos that are not scored, if fewer than 20.

    Raises:
        IgsrError: the capture has too few photos.
    """
    train, test = _split(capture, one)
    test = [test[i] for i in spread_out(len(test), SCORED_VIEWS)]
    if one.kind in FEW:
        return Capture(capture.path, train + test, capture.points)
    random = np.random.default_rng([one.seed, 0x7AB1, *one.scene.encode()])
    noise, unit = _noise(one.kind), noise_unit(train)
    # Points would tell a fit where the cameras were.
    return Capture(capture.path, [noisy_view(v, noise, random, unit) for v in train] + test, None)


def run_fit(out: Path, data: str, one: DegradedFit) -> dict[str, Any]:
    """Fit, and keep the renders of the held-out views beside the true pictures; returns the row."""
    capture = degraded_capture(load_capture(Path(data) / one.scene), one)
    seconds = 0.0

    def progress(now: Any) -> None:
        nonlocal seconds
        seconds = now.seconds

    splats, _ = fit_with_cameras(
        capture,
        backend=one.backend,
        seed=one.seed,
        steps=_steps(one.kind),
        # Silhouettes of wrong cameras take away what is there.
        # Few photos have depths; those of rendered captures would tell a fit too much.
        depth_weight=0.0,
        backdrop=False,  # holes are to be seen as such
        progress=progress,
    )
    background = known_background(capture.views)
    pairs = rendered_pairs(splats, capture.train_views, capture.test_views, background, one.backend)
    write_pairs(one.renders(out), pairs)
    return {
        **vars(one),
        "photos": len(capture.train_views),
        "renders": len(pairs.truth),
        "splats": len(splats),
        "seconds": round(seconds, 2),
    }


def _split(capture: Capture, one: DegradedFit) -> tuple[list[View], list[View]]:
    """Photos to fit and photos to score."""
    noisy = one.kind not in FEW
    if capture.test_views:
        train = capture.train_views
        count = min(NOISY_PHOTOS, len(train)) if noisy else int(one.kind)
        if count > len(train):
            raise IgsrError(f"{capture.path} has {len(train)} photos to fit, not {count}.")
        return [train[i] for i in spread_out(len(train), count)], capture.test_views
    few_dtu = is_dtu(one.scene) and not noisy
    rest = len(capture.views) - -(-len(capture.views) // HOLDOUT)
    count = min(NOISY_PHOTOS, rest) if noisy else int(one.kind)
    chosen = (dtu_views if few_dtu else llff_views)(capture, count)
    return chosen.train_views, chosen.test_views


def _noise(kind: str) -> Noise:
    return Noise(AFFINE if kind == PAPER else MATRIX, CAMERA_NOISE)


def _steps(kind: str) -> int | None:
    return PAPER_STEPS if kind == PAPER else None
