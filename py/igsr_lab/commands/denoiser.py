"""``python -m igsr_lab pairs`` and ``train``: make training pairs and train a denoiser on them."""

from __future__ import annotations

import enum
from pathlib import Path
from typing import Annotated, Any

import typer

from igsr.cli.error_messages import error_messages
from igsr.cli.settings_options import settings_options
from igsr.cli.shared import (
    FitBackendChoice,
    FitBackendOption,
    JsonOption,
    error_console,
    output_console,
    print_json,
    resolved,
)
from igsr.denoiser.architecture import Architecture
from igsr.errors import IgsrError
from igsr_lab.commands.options import JobsOption, RayOption, TimeLeft
from igsr_lab.commands.training_bar import training_bar
from igsr_lab.denoiser.training_settings import Training


class RecipeChoice(str, enum.Enum):
    """How fits are degraded for training pairs."""

    sparse = "sparse"
    underfit = "underfit"
    noise = "noise"
    paper = "paper"
    scattered = "scattered"
    leave_one_out = "leave-one-out"


class BackboneChoice(str, enum.Enum):
    """Backbone of LPIPS."""

    alex = "alex"
    vgg = "vgg"
    squeeze = "squeeze"


def pairs_command(
    captures: Annotated[
        list[Path], typer.Argument(metavar="CAPTURES", help="Captures with known cameras.")
    ],
    out: Annotated[Path, typer.Option("--out", metavar="PAIRS", help="Folder for the pairs.")],
    recipes: Annotated[
        list[RecipeChoice] | None,
        typer.Option("--recipe", help="Repeat it for several. Default: sparse, underfit, noise."),
    ] = None,
    fits: Annotated[int, typer.Option("--fits", help="Fits per capture and recipe.")] = 1,
    views: Annotated[int, typer.Option("--views", help="Novel views rendered per fit.")] = 8,
    steps: Annotated[
        int | None, typer.Option("--steps", help="Steps of each fit. Default: as igsr fit.")
    ] = None,
    all_views: Annotated[
        bool, typer.Option("--all-views", help="Also use the held-out views.")
    ] = False,
    seed: Annotated[
        int, typer.Option("--seed", help="Pairs are deterministic for a given seed.")
    ] = 0,
    jobs: JobsOption = 1,
    ray: RayOption = False,
    backend: FitBackendOption = FitBackendChoice.auto,
    as_json: JsonOption = False,
) -> None:
    """Make training pairs: degraded fits' renders of novel views beside the true photos.

    Finished fits are kept in --out; the same command goes on from there.
    """
    from igsr_lab.denoiser.pairs import DEFAULT_RECIPES, make_pairs

    with error_messages(
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


@settings_options(Training)
def train_command(
    pairs: Annotated[
        Path, typer.Option("--pairs", metavar="PAIRS", help="Folder that `pairs` made.")
    ],
    out: Annotated[
        Path, typer.Option("--out", metavar="DIR", help="Folder for weights, log and checkpoint.")
    ],
    given: dict[str, Any],
    features: Annotated[
        Path | None,
        typer.Option(
            "--features",
            metavar="FILE",
            help="SqueezeNet 1.0 arrays (.npz), for a perceptual distance that is not LPIPS.",
        ),
    ] = None,
    lpips: Annotated[
        BackboneChoice | None,
        typer.Option("--lpips", help="LPIPS with this backbone, which is downloaded."),
    ] = None,
    # Not --start: torchrun would take it for the beginning of one of its own options.
    start: Annotated[
        Path | None,
        typer.Option(
            "--weights", metavar="FILE", help="Weights to go on from, such as igsr's own."
        ),
    ] = None,
    width: Annotated[
        int, typer.Option("--width", help="Channels at half resolution.")
    ] = Architecture.width,
    residual: Annotated[
        bool, typer.Option("--residual/--no-residual", help="Add the output to the render.")
    ] = Architecture.residual,
    buffers: Annotated[
        bool, typer.Option("--buffers/--no-buffers", help="Look at alpha, depth, normals ...")
    ] = Architecture.buffers,
    photos: Annotated[
        str, typer.Option("--photos", help="concatenated, attention or none.")
    ] = Architecture.photos,
    device: Annotated[
        str, typer.Option("--device", help="Where to train, as torch names it: cpu, cuda ...")
    ] = "cpu",
    resume: Annotated[
        bool, typer.Option("--resume", help="Go on from the checkpoint in --out.")
    ] = False,
    as_json: JsonOption = False,
) -> None:
    """Train a denoiser. Several GPUs: torchrun --nproc-per-node N -m igsr_lab train ..."""
    from igsr_lab.denoiser.distributed import is_first_process
    from igsr_lab.denoiser.perceptual_distance import (
        Distance,
        SqueezeNetDistance,
        lpips_distance,
    )
    from igsr_lab.denoiser.plot_training import plot_training
    from igsr_lab.denoiser.train_network import WEIGHTS, train
    from igsr_lab.denoiser.training_run import LOG

    with error_messages(
        lambda: f"Interrupted; go on from the last checkpoint in {out} with --resume."
    ):
        if features is not None and lpips is not None:
            raise IgsrError("--features and --lpips both name a perceptual distance; give one.")
        distance: Distance | None = None
        if features is not None:
            distance = SqueezeNetDistance(features)
        elif lpips is not None:
            distance = lpips_distance(lpips.value)
        # A fit that was killed leaves a file whose name begins with a dot.
        files = sorted(pairs.glob("[!.]*.npz"))
        if not files:
            raise IgsrError(
                f"{pairs} holds no .npz of pairs; make some with python -m igsr_lab pairs."
            )
        training = Training(**given)
        with training_bar(training.steps) as progress:
            train(
                files,
                out,
                training,
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
