"""Degraded fits, from few photos or with noise on their cameras, and renders of held-out views."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from igsr._internal.choices import FitBackend
from igsr.capture import Capture, View, load_capture
from igsr.capture.load import holds_cameras
from igsr.errors import IgsrError
from igsr.evaluation.scores import known_background
from igsr.fitting.fit_capture import fit_capture
from igsr_lab.camera_noise import AFFINE, MATRIX, Noise, noise_unit, noisy_view
from igsr_lab.denoiser.pair_files import check_one_size, rendered_pairs, write_pairs
from igsr_lab.presets import PAPER_STEPS, preset_settings
from igsr_lab.resumable_jobs import Run
from igsr_lab.study.splits import HOLDOUT, dtu_views, is_dtu, llff_views, spread_out
from igsr_lab.study.study import Row

#: Kinds of degraded fits: numbers of photos; 20 photos with noise on their cameras; and the paper's
#: recipe, with affine noise and its number of steps.
FEW = ("3", "6", "9")
NOISE = "noise"
PAPER = "paper"
DEFAULT_KINDS = (*FEW, NOISE)
KINDS = (*DEFAULT_KINDS, PAPER)
#: Maximum number of photos of fits with noise, and the size of the noise.
NOISY_PHOTOS = 20
CAMERA_NOISE = 0.01
#: Maximum number of held-out views scored per fit, evenly spaced.
SCORED_VIEWS = 8


@dataclass(frozen=True)
class DegradedFit:
    """One fit; its renders depend on nothing else. ``kind`` is one of ``KINDS``."""

    scene: str
    kind: str
    seed: int
    backend: FitBackend

    @property
    def name(self) -> str:
        """Name of its files."""
        return f"{self.scene.replace('/', '-')}-{self.kind}-seed{self.seed}-{self.backend}"

    def renders(self, out: Path) -> Path:
        """File of its renders in the study's folder."""
        return out / "renders" / f"{self.name}.npz"


def scenes_in(data: Path) -> tuple[str, ...]:
    """Find the captures with cameras in a folder and its subfolders."""
    found: list[str] = []
    for pattern in ("*", "*/*"):
        for folder in sorted(data.glob(pattern)):
            name = folder.relative_to(data)
            # The images/ of a capture hold the same photos.
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


def planned_runs(
    data: Path, out: Path, fits: Sequence[DegradedFit]
) -> tuple[list[Run], frozenset[str]]:
    """Load all scenes, so that an error does not come up after hours.

    Returns:
        A run per fit (``fits`` are sorted by scene), and the scenes whose photos have no alpha.
    """
    runs, photographs = [], set()
    for scene in dict.fromkeys(fit.scene for fit in fits):
        capture = load_capture(data / scene)
        if known_background(capture.views) is None:
            photographs.add(scene)
        for fit in (fit for fit in fits if fit.scene == scene):
            degraded = degraded_capture(capture, fit)
            check_one_size(degraded.test_views)
            photos = len(degraded.train_views)
            settings = preset_settings("default", photos, steps=_steps(fit.kind))
            settings |= {"scored": SCORED_VIEWS}
            runs.append(Run(fit.name, fit, settings, fit.renders(out), scene))
    return runs, frozenset(photographs)


def degraded_capture(capture: Capture, fit: DegradedFit) -> Capture:
    """Choose the photos of a degraded fit, with their cameras, and the views to score.

    Photos of a capture with test views are evenly spaced train views. Others are split as in
    ``few_photos``; a fit with noise has at most 20 of the photos that are not scored.
    """
    train, test = _split(capture, fit)
    test = [test[i] for i in spread_out(len(test), SCORED_VIEWS)]
    if fit.kind in FEW:
        return Capture(capture.path, train + test, capture.points)
    random = np.random.default_rng([fit.seed, 0x7AB1, *fit.scene.encode()])
    noise, unit = _noise(fit.kind), noise_unit(train)
    # Without points, which would reveal the true cameras.
    return Capture(capture.path, [noisy_view(v, noise, random, unit) for v in train] + test, None)


def run_fit(out: Path, data: str, fit: DegradedFit) -> Row:
    """Fit, and write renders and photos of the held-out views; return the row."""
    capture = degraded_capture(load_capture(Path(data) / fit.scene), fit)
    result = fit_capture(
        capture,
        backend=fit.backend,
        seed=fit.seed,
        steps=_steps(fit.kind),
        # Few photos have depths, and exact depths of rendered captures would help too much.
        depth_weight=0.0,
        backdrop=False,  # holes must be visible
    )
    background = known_background(capture.views)
    pairs = rendered_pairs(
        result.splats, capture.train_views, capture.test_views, background, fit.backend
    )
    write_pairs(fit.renders(out), pairs)
    return {
        **vars(fit),
        "photos": len(capture.train_views),
        "renders": len(pairs.truth),
        "splats": len(result.splats),
        "seconds": round(result.seconds, 2),
    }


def _split(capture: Capture, fit: DegradedFit) -> tuple[list[View], list[View]]:
    """Photos to fit and photos to score."""
    noisy = fit.kind not in FEW
    if capture.test_views:
        train = capture.train_views
        count = min(NOISY_PHOTOS, len(train)) if noisy else int(fit.kind)
        if count > len(train):
            raise IgsrError(f"{capture.path} has {len(train)} photos to fit, not {count}.")
        return [train[i] for i in spread_out(len(train), count)], capture.test_views
    rest = len(capture.views) - -(-len(capture.views) // HOLDOUT)
    count = min(NOISY_PHOTOS, rest) if noisy else int(fit.kind)
    chosen = (dtu_views if is_dtu(fit.scene) and not noisy else llff_views)(capture, count)
    return chosen.train_views, chosen.test_views


def _noise(kind: str) -> Noise:
    return Noise(AFFINE if kind == PAPER else MATRIX, CAMERA_NOISE)


def _steps(kind: str) -> int | None:
    return PAPER_STEPS if kind == PAPER else None
