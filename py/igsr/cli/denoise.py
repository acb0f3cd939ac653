"""``igsr denoise``: make training pairs, train on them, clean renders."""

from __future__ import annotations

import contextlib
import enum
from collections.abc import Iterator
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer
from rich.progress import BarColumn, TextColumn, TimeRemainingColumn
from rich.progress import Progress as ProgressBar

from igsr._internal.atomic_write import atomic_write
from igsr.cli.shared import (
    BackendChoice,
    BackendOption,
    JobsOption,
    JsonOption,
    RayOption,
    SplitChoice,
    TimeLeft,
    error_console,
    load,
    one_sentence,
    output_console,
    picture_name,
    print_json,
    resolved,
    stopped,
)
from igsr.errors import IgsrError
from igsr.evaluation.scores import (
    default_background,
    default_split,
    known_background,
    views_of_split,
)
from igsr.splats import Splats

app = typer.Typer(
    help="Clean what a poor splat model renders: training pairs, training, use.",
    no_args_is_help=True,
)


class RecipeChoice(str, enum.Enum):
    """How fits are made poor."""

    sparse = "sparse"
    underfit = "underfit"
    noise = "noise"
    paper = "paper"
    scattered = "scattered"
    leave_one_out = "leave-one-out"


class LossChoice(str, enum.Enum):
    """What training makes small."""

    default = "default"
    charbonnier = "charbonnier"
    gan = "gan"
    gan_lpips = "gan+lpips"
    lpips = "lpips"


class BackboneChoice(str, enum.Enum):
    """Backbones of LPIPS."""

    alex = "alex"
    vgg = "vgg"
    squeeze = "squeeze"


@app.command("pairs")
def pairs_command(
    captures: Annotated[
        list[Path], typer.Argument(metavar="CAPTURES", help="Captures with known cameras.")
    ],
    out: Annotated[Path, typer.Option("--out", metavar="PAIRS", help="Folder for the pairs.")],
    recipes: Annotated[
        list[RecipeChoice] | None,
        typer.Option("--recipe", help="Repeat it for several. Default: sparse, underfit, noise."),
    ] = None,
    fits: Annotated[int, typer.Option("--fits", help="Per capture and recipe.")] = 1,
    views: Annotated[int, typer.Option("--views", help="Unseen views rendered per fit.")] = 8,
    steps: Annotated[
        int | None, typer.Option("--steps", help="Of each fit. Default: as igsr fit.")
    ] = None,
    all_views: Annotated[
        bool, typer.Option("--all-views", help="Use the views that are held out, too.")
    ] = False,
    seed: Annotated[int, typer.Option("--seed", help="Same seed, same pairs.")] = 0,
    jobs: JobsOption = 1,
    ray: RayOption = False,
    backend: BackendOption = BackendChoice.auto,
    as_json: JsonOption = False,
) -> None:
    """Fit captures poorly and keep renders of unseen views beside the true pictures.

    What is finished is kept in --out, and the same command goes on from there.
    """
    from igsr.denoiser.training.pairs import DEFAULT_RECIPES, make_pairs

    with one_sentence(
        lambda: "Interrupted; finished fits are kept, the same command goes on from there."
    ):
        time_left = TimeLeft()

        def on_run(done: int, total: int, row: dict[str, Any]) -> None:
            left = time_left(done, total)
            error_console().print(
                f"{done} of {total}: {row['pairs']} from {row['photos']} photos, "
                f"{row['psnr']:.2f} dB; {left}"
            )

        rows = make_pairs(
            captures,
            out,
            recipes=[choice.value for choice in recipes] if recipes else DEFAULT_RECIPES,
            fits=fits,
            views=views,
            steps=steps,
            all_views=all_views,
            seed=seed,
            backend=resolved(backend),
            jobs=jobs,
            on_run=on_run,
            ray=ray,
        )
    if as_json:
        print_json({"fits": rows})
        return
    renders = sum(row["renders"] for row in rows)
    output_console().print(f"{renders} pairs of {len(rows)} fits: {out}", markup=False)


@app.command("train")
def train_command(
    pairs: Annotated[Path, typer.Option("--pairs", metavar="PAIRS", help="Of igsr denoise pairs.")],
    out: Annotated[Path, typer.Option("--out", metavar="DIR", help="Folder for what comes out.")],
    loss: Annotated[LossChoice, typer.Option("--loss", help="The last three are a paper's.")] = (
        LossChoice.default
    ),
    a: Annotated[float, typer.Option("--a", help="gan+lpips: part that LPIPS has.")] = 0.9,
    features: Annotated[
        Path | None,
        typer.Option(
            "--features",
            metavar="FILE",
            help="SqueezeNet 1.0's arrays (.npz), for a perceptual distance that is not LPIPS.",
        ),
    ] = None,
    lpips: Annotated[
        BackboneChoice | None,
        typer.Option("--lpips", help="True LPIPS with this backbone, which is downloaded."),
    ] = None,
    # Not --start: torchrun would take it for the beginning of one of its own options.
    start: Annotated[
        Path | None,
        typer.Option(
            "--weights", metavar="FILE", help="Weights to go on from, such as igsr's own."
        ),
    ] = None,
    steps: Annotated[int, typer.Option("--steps", help="Batches.")] = 20_000,
    batch: Annotated[int, typer.Option("--batch", help="Crops per step.")] = 8,
    crop: Annotated[int, typer.Option("--crop", help="Side of a crop, pixels.")] = 128,
    rate: Annotated[float, typer.Option("--rate", help="Adam's highest.")] = 1e-3,
    weight_decay: Annotated[float, typer.Option("--weight-decay")] = 1e-4,
    dropout: Annotated[float, typer.Option("--dropout")] = 0.0,
    augment: Annotated[bool, typer.Option("--augment/--no-augment")] = True,
    width: Annotated[int, typer.Option("--width", help="Channels at half resolution.")] = 32,
    residual: Annotated[bool, typer.Option("--residual/--no-residual")] = True,
    buffers: Annotated[bool, typer.Option("--buffers/--no-buffers")] = True,
    photos: Annotated[
        str, typer.Option("--photos", help="concatenated, attention or none.")
    ] = "concatenated",
    device: Annotated[str, typer.Option("--device", help="torch's name of one.")] = "cpu",
    seed: Annotated[int, typer.Option("--seed", help="Same seed, same weights.")] = 0,
    resume: Annotated[
        bool, typer.Option("--resume", help="Go on from the last checkpoint in --out.")
    ] = False,
    as_json: JsonOption = False,
) -> None:
    """Train a denoiser. Several GPUs: torchrun --nproc-per-node N -m igsr.cli denoise train ..."""
    from igsr.denoiser.network import Architecture
    from igsr.denoiser.training.perceptual_distance import (
        Distance,
        SqueezeNetDistance,
        lpips_distance,
    )
    from igsr.denoiser.training.plot_training import plot_training
    from igsr.denoiser.training.train import (
        LOG,
        WEIGHTS,
        Training,
        TrainingProgress,
        is_first_process,
        train,
    )

    with one_sentence(
        lambda: f"Interrupted; go on from the last checkpoint in {out} with --resume."
    ):
        if features is not None and lpips is not None:
            raise IgsrError("--features and --lpips are two distances; give one.")
        distance: Distance | None = None
        if features is not None:
            distance = SqueezeNetDistance(features)
        elif lpips is not None:
            distance = lpips_distance(lpips.value)
        # A fit that was killed leaves a file whose name begins with a dot.
        files = sorted(pairs.glob("[!.]*.npz"))
        if not files:
            raise IgsrError(f"{pairs} holds no .npz of pairs; make some with igsr denoise pairs.")
        with _bar(steps) as show:

            def progress(now: TrainingProgress) -> None:
                show(now.step, now.parts)

            train(
                files,
                out,
                Training(
                    steps, batch, crop, rate, weight_decay, dropout, augment, loss.value, a, seed
                ),
                Architecture(width=width, residual=residual, buffers=buffers, photos=photos),
                distance=distance,
                start=start,
                device=device,
                resume=resume,
                progress=progress,
            )
        if not is_first_process():
            return
        rows = plot_training(out / LOG, out / "loss.png")
    last = {name: value for row in rows for name, value in row.items()}
    if as_json:
        print_json(last)
        return
    output_console().print(
        f"validation {last['validation_psnr_before']:.2f} -> {last['validation_psnr']:.2f} dB: "
        f"{out / WEIGHTS}",
        markup=False,
    )


@contextlib.contextmanager
def _bar(steps: int) -> Iterator[Any]:
    bar = ProgressBar(
        TextColumn("train {task.completed}/{task.total}"),
        BarColumn(bar_width=30),
        TextColumn("{task.fields[parts]}"),
        TimeRemainingColumn(compact=True),
        console=error_console(),
    )
    task = bar.add_task("train", total=steps, parts="")
    with stopped(bar):

        def show(step: int, parts: dict[str, float]) -> None:
            bar.start()
            text = "  ".join(f"{name} {value:.4g}" for name, value in list(parts.items())[:3])
            bar.update(task, completed=step, parts=text)

        yield show


@app.command("apply")
def apply_command(
    scene: Annotated[Path, typer.Argument(metavar="SCENE", help="A splat .ply file.")],
    capture_path: Annotated[
        Path, typer.Option("--capture", metavar="CAPTURE", help="The photos it was fitted to.")
    ],
    out: Annotated[Path, typer.Option("--out", metavar="DIR", help="Folder for the pictures.")],
    holdout: Annotated[
        int | None, typer.Option("--holdout", help="Every how many views one is held out.")
    ] = None,
    split: Annotated[
        SplitChoice | None,
        typer.Option("--split", help="Views to render. Default: those held out, if there are."),
    ] = None,
    weights: Annotated[
        Path | None,
        typer.Option("--weights", metavar="FILE", help="A denoiser. Default: igsr's own."),
    ] = None,
    backend: BackendOption = BackendChoice.auto,
    as_json: JsonOption = False,
) -> None:
    """Render views of a scene and clean them: NAME.png, and NAME.confidence.png (white: sure)."""
    from PIL import Image

    from igsr.denoiser import (
        NetworkDenoiser,
        denoise,
        load_network,
        photo_sources,
        photo_support,
        render_buffers,
    )

    with one_sentence():
        denoiser = NetworkDenoiser(load_network(weights))
        splats = Splats.load(scene)
        capture = load(capture_path, holdout)
        background, behind = default_background(capture), known_background(capture.views)
        on = resolved(backend)
        views = views_of_split(capture, split.value if split else default_split(capture))
        photos = capture.train_views
        support = photo_support(splats, photos, on)
        sources = photo_sources(splats, photos, background, on)
        files = []
        for view in views:
            buffers = render_buffers(splats, view.camera, support, behind, on)
            others = [
                source
                for source, photo in zip(sources, photos, strict=True)
                if photo.name != view.name
            ]
            picture, confidence = denoise(buffers, others, denoiser)
            path = out / picture_name(view.name, ".png")
            path.parent.mkdir(parents=True, exist_ok=True)
            for array, file in ((picture, path), (confidence, path.with_suffix(".confidence.png"))):
                with atomic_write(file) as temporary:
                    eight = np.rint(255.0 * array).astype(np.uint8)
                    Image.fromarray(eight).save(temporary, format="PNG")
                files.append(str(file))
    if as_json:
        print_json({"files": files})
        return
    output_console().print(f"{len(views)} views: {out}", markup=False)
