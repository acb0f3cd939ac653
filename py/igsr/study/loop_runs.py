"""What rounds of ``igsr.refine`` do for held-out views, ours and the paper's: Tables 2 and 3.

Each run fits some photos of a scene once and goes on from there by every method, so that they
differ in nothing but their rounds. Held-out views are scored after each round and decide nothing in
our rounds; the paper's choose by the true pictures of the views that they may add.
"""

from __future__ import annotations

import json
import os
import shutil
import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
from PIL import Image

from igsr import _core
from igsr._internal.atomic_write import atomic_write
from igsr._internal.resumable_jobs import Run, file_hash, finished_runs
from igsr.capture import Camera, Capture, View, load_capture
from igsr.denoiser import Buffers, Denoiser, Source
from igsr.denoiser.training.perceptual_distance import SqueezeNetDistance, picture_distance
from igsr.denoiser.weights import SHIPPED, load_network
from igsr.errors import IgsrError
from igsr.evaluation.scores import default_background, over_background, score_views
from igsr.fitting.presets import preset_settings
from igsr.fitting.run import fingerprint
from igsr.refinement.loop import Choose, Look, refine, round_denoiser
from igsr.refinement.novel_views import UnseenView, unseen_views
from igsr.refinement.results import Refined
from igsr.refinement.selection import Candidate, select
from igsr.splats import Splats
from igsr.study.loop_tables import plot_rounds, summarized, write_table
from igsr.study.picture_sheet import write_sheet
from igsr.study.splits import HOLDOUT, localized, scattered, spread_out

#: How photos are chosen, by the name of the layout.
LAYOUTS: dict[str, Callable[[Sequence[Camera], int], list[int]]] = {
    "localized": localized,
    "scattered": scattered,
    "even": lambda cameras, count: spread_out(len(cameras), count),
}
#: Held-out views of a capture that has test views, of one that has none, and the views that the
#: paper's methods may add of the latter.
HELD_OUT, HELD_OUT_OF_ALL, GIVEN_VIEWS = 15, 7, 6
#: Our loop, and with one of its parts taken out.
OURS = ("ours", "no-denoiser", "no-trust", "no-selection", "no-outward")
#: The paper's choices by the true picture: the largest fall of the perceptual distance, the
#: smallest after cleaning, and the smallest before.
PAPER = ("improvement", "absolute", "absolute-before")
METHODS = (*OURS, *PAPER)
#: Held-out views this near to a photo's direction, degrees, and those farther away than that.
NEAR, FAR = 45.0, 60.0
SCORES = ("psnr", "ssim", "flip", "perceptual")


@dataclass(frozen=True)
class Rounds:
    """How a method goes on from the fit of a run.

    Attributes:
        name: as tables and files call it.
        method: of ``METHODS``.
        views: added per round at most.
        rounds: how many.
        judge: whether a round of ours that does not help is rolled back.
    """

    name: str
    method: str
    views: int
    rounds: int
    judge: bool


@dataclass(frozen=True)
class Refinement:
    """One run: a fit, and the rounds of every method from there.

    Attributes:
        scene: name of the scene's folder in the data.
        layout: of ``LAYOUTS``.
        photos: how many are fitted.
        seed: of everything.
        backend: what fits and renders.
    """

    scene: str
    layout: str
    photos: int
    seed: int
    backend: str

    @property
    def name(self) -> str:
        """Of its file and its folder."""
        return f"{self.scene}-{self.layout}{self.photos}-seed{self.seed}-{self.backend}"


@dataclass(frozen=True)
class Given:
    """What all runs of a study share.

    Attributes:
        out: folder for what the rounds leave.
        methods: what goes on from each fit.
        weights: the denoiser's file; None is igsr's own.
        features: SqueezeNet's arrays, for "perceptual" and the paper's choices; None is without.
        steps: of each fit; None is the default preset's.
    """

    out: str
    methods: tuple[Rounds, ...]
    weights: str | None
    features: str | None
    steps: int | None


def split(capture: Capture, one: Refinement) -> tuple[Capture, list[View], list[View]]:
    """The photos of a run, the views that it is scored on, and those that the paper may add.

    Of a capture with test views 15 of those are scored, evenly spaced, and the others may be added.
    Of another 7 photos, evenly spaced by name (every 8th for the layout "even", as LLFF's protocol
    has it), are scored, and 6 of those that are left may be added.

    Raises:
        IgsrError: the capture has too few photos.
    """
    if capture.test_views:
        train, test = capture.train_views, capture.test_views
        at = spread_out(len(test), HELD_OUT)
        held = [test[i] for i in at]
        given = [view for i, view in enumerate(test) if i not in at]
    else:
        by_name = sorted(capture.views, key=lambda view: view.name)
        at = spread_out(len(by_name), HELD_OUT_OF_ALL)
        if one.layout == "even":
            at = list(range(0, len(by_name), HOLDOUT))
        held, given = [by_name[i] for i in at], []
        train = [view for i, view in enumerate(by_name) if i not in at]
    if one.photos > len(train):
        raise IgsrError(f"{capture.path} has {len(train)} photos to fit, not {one.photos}.")
    chosen = LAYOUTS[one.layout]([view.camera for view in train], one.photos)
    if not capture.test_views:
        rest = [view for i, view in enumerate(train) if i not in chosen]
        given = [rest[i] for i in spread_out(len(rest), GIVEN_VIEWS)] if rest else []
    photos = [train[i] for i in chosen]
    return Capture(capture.path, photos, capture.points), held, given


def run_refinement(given: Given, data: str, one: Refinement) -> dict[str, Any]:
    """Fit, and go on by every method."""
    photos, held, candidates = split(load_capture(Path(data) / one.scene), one)
    distance = None if given.features is None else SqueezeNetDistance(given.features)
    background = default_background(photos)
    angles = _angles_to_nearest(held, photos.views)

    def scored(splats: Splats, picture: Path | None) -> dict[str, Any]:
        rows = []
        for k, view in enumerate(score_views(splats, held, background, one.backend)):
            row: dict[str, float | None] = {name: view.scores[name] for name in ("psnr", "ssim")}
            row["flip"] = view.scores["flip"]
            if distance is not None:
                shown = True if view.mask is None else view.mask[..., None]
                row["perceptual"] = picture_distance(
                    distance, view.render * shown, view.photo * shown
                )
            rows.append(row)
            if picture is not None and k == len(held) // 2:
                with atomic_write(picture) as temporary:
                    Image.fromarray(view.render).save(temporary, format="PNG")
        means = _means(rows)
        for name, chosen in (("near", angles <= NEAR), ("far", angles > FAR)):
            some = [row for row, counts in zip(rows, chosen, strict=True) if counts]
            means[name] = {"views": len(some), **_means(some)} if some else None
        return means

    folder = Path(given.out) / "rounds" / one.name
    _cleared_if_other(folder, given, photos)
    first: dict[str, Any] = {}
    methods: dict[str, Any] = {}
    for how in given.methods:
        out = folder / how.name
        for earlier in given.methods[: given.methods.index(how)]:
            _share_fits(folder / earlier.name, out)
        refined = _refined(photos, candidates, how, given, one, distance, out)
        first = first or scored(refined.first, folder / "first.png")
        rows = [{**first, "splats": len(refined.first), "accepted": True}]
        for number, done in enumerate(refined.rounds, 1):
            row: dict[str, Any] = {"accepted": done.accepted, "added": len(done.chosen)}
            if done.splats is not None:
                row |= scored(done.splats, out / f"round{number}.png")
                row["splats"] = len(done.splats)
            else:
                row = rows[-1] | row
            row["left_out"] = {"before": done.before, "with": done.left_out}
            rows.append(row)
        methods[how.name] = {
            "rounds": rows,
            "stopped": refined.stopped,
            "seconds": {part: round(seconds, 2) for part, seconds in refined.seconds.items()},
        }
    middle = held[len(held) // 2]
    with atomic_write(folder / "truth.png") as temporary:
        truth = over_background(middle.image, background)
        Image.fromarray(truth).save(temporary, format="PNG")
    return {**vars(one), "held_out": len(held), "methods": methods}


def _cleared_if_other(folder: Path, given: Given, photos: Capture) -> None:
    """Remove what a run of other settings or another version left, which none can go on from."""
    made_with = {
        "igsr": _core.__version__,
        "steps": given.steps,
        "weights": file_hash(SHIPPED if given.weights is None else Path(given.weights)),
        "features": None if given.features is None else file_hash(Path(given.features)),
        "capture": fingerprint(photos.views),
    }
    note = folder / "made_with.json"
    try:
        same = json.loads(note.read_text(encoding="utf-8")) == made_with
    except (OSError, ValueError):
        same = False
    if not same:
        shutil.rmtree(folder, ignore_errors=True)
        with atomic_write(note) as temporary:
            temporary.write_text(json.dumps(made_with, indent=1), encoding="utf-8")


def _share_fits(source: Path, out: Path) -> None:
    """What methods begin with is the same: fits that one has done the next goes on from."""
    (out / "checkpoints").mkdir(parents=True, exist_ok=True)
    for name in ("whole", "fold0", "fold1"):
        done, own = source / "checkpoints" / f"{name}.npz", out / "checkpoints" / f"{name}.npz"
        if done.is_file() and not own.is_file():
            with atomic_write(own) as temporary:
                shutil.copyfile(done, temporary)


def _refined(
    photos: Capture,
    candidates: Sequence[View],
    how: Rounds,
    given: Given,
    one: Refinement,
    distance: SqueezeNetDistance | None,
    out: Path,
) -> Refined:
    base: Denoiser = round_denoiser(given.weights)
    look: Look = unseen_views
    choose: Choose = lambda found, _: select(found, how.views)  # noqa: E731
    if how.method == "no-denoiser":
        denoiser: Denoiser = partial(_uncleaned, base)
        # Nothing is changed, so that by what would be changed no view is worth anything.
        choose = lambda found, _: sorted(found, key=lambda one: -one.mean_trust)[: how.views]  # noqa: E731
    elif how.method == "no-trust" or how.method in PAPER:
        denoiser = partial(_trusted, base)
    else:
        denoiser = base
    if how.method == "no-selection":
        choose = lambda found, _: list(found[: how.views])  # noqa: E731
    elif how.method == "no-outward":
        look = _between
    elif how.method in PAPER:
        assert distance is not None
        look = partial(_given, candidates)
        choose = partial(_by_truth, candidates, photos, how, distance)
    return refine(
        photos,
        how.rounds,
        steps=given.steps,
        backend=one.backend,
        seed=one.seed,
        denoiser=denoiser,
        out=out,
        resume=True,
        look=look,
        choose=choose,
        judge=how.judge and how.method not in PAPER,
    )


def _uncleaned(
    base: Denoiser, buffers: Buffers, photos: Sequence[Source]
) -> tuple[npt.NDArray[np.float32], npt.NDArray[np.float32]]:
    """The render as it is, trusted as far as the denoiser trusts what it makes of it."""
    return np.clip(np.nan_to_num(buffers.color), 0.0, 1.0), base(buffers, photos)[1]


def _trusted(
    base: Denoiser, buffers: Buffers, photos: Sequence[Source]
) -> tuple[npt.NDArray[np.float32], npt.NDArray[np.float32]]:
    """Cleaned, and trusted everywhere alike."""
    picture, confidence = base(buffers, photos)
    return picture, np.ones_like(confidence)


def _between(splats: Splats, known: Sequence[Camera], count: int, backend: str) -> list[UnseenView]:
    """Unseen views without those that step outward."""
    return [view for view in unseen_views(splats, known, count, backend) if view.between]


def _given(
    candidates: Sequence[View], splats: Splats, known: Sequence[Camera], count: int, backend: str
) -> list[UnseenView]:
    """The given cameras that were not added yet."""
    return [
        UnseenView(view.camera, 0.0, between=False)
        for view in candidates
        if not any(view.camera is camera for camera in known)
    ]


def _by_truth(
    candidates: Sequence[View],
    photos: Capture,
    how: Rounds,
    distance: SqueezeNetDistance,
    found: Sequence[Candidate],
    count: int,
) -> list[Candidate]:
    """The paper's Top-K, which needs the true pictures of the views that may be added."""
    background = default_background(photos)

    def rank(one: Candidate) -> float:
        truth = next(view for view in candidates if view.camera is one.view.camera)
        shown = True if truth.mask is None else truth.mask[..., None]
        photo = over_background(truth.image, background) * shown
        before = picture_distance(distance, one.render * shown, photo)
        if how.method == "absolute-before":
            return before
        after = picture_distance(distance, one.picture * shown, photo)
        return after if how.method == "absolute" else after - before

    return sorted(found, key=rank)[: how.views]


def _angles_to_nearest(views: Sequence[View], photos: Sequence[View]) -> npt.NDArray[np.float64]:
    """Degrees between each view's direction and the nearest photo's."""
    looks, seen = (
        np.stack([view.camera.viewmat[2, :3] for view in some]) for some in (views, photos)
    )
    return np.degrees(np.arccos(np.clip((looks @ seen.T).max(axis=1), -1.0, 1.0)))


def _means(rows: Sequence[dict[str, float | None]]) -> dict[str, Any]:
    out: dict[str, Any] = {}
    for name in SCORES:
        known = [value for row in rows if (value := row.get(name)) is not None]
        if known:
            out[name] = float(np.mean(known))
    return out


def studied(
    title: str,
    paper: Sequence[str],
    data: str | os.PathLike[str],
    out: str | os.PathLike[str],
    kinds: Sequence[tuple[str, str, int]],
    methods: Sequence[Rounds],
    weights: str | os.PathLike[str] | None,
    features: str | os.PathLike[str] | None,
    steps: int | None,
    seeds: int,
    backend: str,
    jobs: int,
    on_run: Callable[[int, int, dict[str, Any]], None] | None,
    ray: bool,
) -> dict[str, Any]:
    """Do the runs of a study and write what they come to.

    Args:
        title: of its table.
        paper: the paper's own figures, to stand under it.
        data, out: as in ``igsr.study.table2``.
        kinds: (scene, layout, number of photos) of each kind of run.
        methods: what goes on from each fit.
        weights, features, steps, seeds, backend, jobs, on_run, ray: as in ``igsr.study.table2``.

    Raises:
        IgsrError: an argument cannot be used, a scene cannot be read or has too few photos, or a
            fit fails.
    """
    if seeds < 1 or jobs < 1:
        raise IgsrError("seeds and jobs must be at least 1.")
    for how in methods:
        if how.method not in METHODS:
            raise IgsrError(f"methods must be of {', '.join(METHODS)}, not {how.method!r}.")
        if how.method in PAPER and features is None:
            raise IgsrError(
                f"method {how.method} chooses by a perceptual distance; give --features "
                "squeezenet.npz, or leave it out with --method."
            )
    load_network(weights)
    if features is not None:
        SqueezeNetDistance(features)
    out = Path(out)
    given = Given(
        str(out),
        tuple(methods),
        None if weights is None else str(weights),
        None if features is None else str(features),
        steps,
    )
    runs = [
        Refinement(scene, layout, photos, seed, backend)
        for seed in range(seeds)
        for scene, layout, photos in kinds
    ]
    for one in runs:
        # What is wrong with the last scene must not come up hours later.
        split(load_capture(Path(data) / one.scene), one)
    hashes = {
        "weights": file_hash(SHIPPED if weights is None else Path(weights)),
        "features": None if features is None else file_hash(Path(features)),
        "methods": [list(vars(how).values()) for how in methods],
    }
    tasks = [
        Run(
            one.name,
            one,
            preset_settings("default", one.photos, steps=steps) | hashes,
            scene=one.scene,
        )
        for one in runs
    ]
    rows = finished_runs(
        out / "runs", tasks, partial(run_refinement, given), str(data), jobs, on_run, ray
    )
    scenes: dict[str, Any] = {}
    for scene, layout, photos in kinds:
        same = [
            row
            for row in rows
            if (row["scene"], row["layout"], row["photos"]) == (scene, layout, photos)
        ]
        scenes.setdefault(scene, {})[f"{layout} {photos}"] = summarized(same)
    report: dict[str, Any] = {
        "title": title,
        "igsr": _core.__version__,
        "protocol": {
            "seeds": seeds,
            "backend": backend,
            "near": NEAR,
            "far": FAR,
            "rounds": [vars(how) for how in methods],
            "weights": hashes["weights"],
        },
        "scenes": scenes,
        "runs": rows,
        "paper": list(paper),
    }
    for layout in dict.fromkeys(layout for _, layout, _ in kinds):
        report[layout] = summarized([row for row in rows if row["layout"] == layout])
    with atomic_write(out / "study.json") as temporary:
        temporary.write_text(json.dumps(report, indent=2, allow_nan=False), encoding="utf-8")
    write_table(out / "study.md", report)
    plot_rounds(out / "study.png", report)
    for one in (one for one in runs if one.seed == 0):
        _write_run_sheet(out, one, methods)
    return report


def _write_run_sheet(out: Path, one: Refinement, methods: Sequence[Rounds]) -> None:
    """A held-out view after each round, and the two views that the first round valued most."""
    folder = out / "rounds" / one.name
    truth, first = _picture(folder / "truth.png"), _picture(folder / "first.png")
    if truth is None or first is None:
        warnings.warn(f"{folder} has no pictures: no sheet of {one.name} is drawn.", stacklevel=3)
        return
    sheet = {}
    for how in methods:
        row = {"truth": truth, "round 0": first}
        shown = first
        for number in range(1, max(each.rounds for each in methods) + 1):
            after = _picture(folder / how.name / f"round{number}.png")
            shown = shown if after is None else after
            row[f"round {number}"] = shown
        for k in range(min(2, max(how.views for how in methods))):
            added = _picture(folder / how.name / "rounds" / "1" / f"view-{k}.after.png")
            row[f"added view {k + 1}"] = np.full_like(truth, 255) if added is None else added
        sheet[how.name] = row
    write_sheet(out / f"{one.scene}-{one.layout}{one.photos}.png", sheet)


def _picture(path: Path) -> npt.NDArray[np.uint8] | None:
    if not path.is_file():
        return None
    with Image.open(path) as picture:
        return np.asarray(picture)
