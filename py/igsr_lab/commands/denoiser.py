"""``python -m igsr_lab pairs`` and ``train``: make training pairs and train a denoiser on them."""

from __future__ import annotations

import dataclasses
import inspect
from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Any, Literal

import typer

from igsr._internal.progress_bar import progress_bar
from igsr._internal.settings import Setting, settings_of
from igsr.cli.error_messages import error_messages
from igsr.cli.options import FitBackendOption, JsonOption, option, resolved
from igsr.cli.output import error_console, output_console, print_json
from igsr.denoiser.architecture import Architecture
from igsr.errors import IgsrError
from igsr_lab.commands.options import JobsOption, RayOption, TimeLeft
from igsr_lab.denoiser.training_settings import Training


def settings_options(cls: type) -> Callable[[Callable[..., None]], Callable[..., None]]:
    """A decorator that replaces the parameter ``given`` by an option per setting of a class.

    The command receives ``given``, a dictionary of the settings that are not None.
    """
    settings = settings_of(cls)

    def with_options(command: Callable[..., None]) -> Callable[..., None]:
        parameters: list[inspect.Parameter] = []
        for parameter in inspect.signature(command, eval_str=True).parameters.values():
            if parameter.name == "given":
                parameters += [_parameter(setting) for setting in settings.values()]
            else:
                parameters.append(parameter.replace(kind=inspect.Parameter.KEYWORD_ONLY))

        def wrapped(**values: Any) -> None:
            given = {name: values.pop(name) for name in settings}
            command(**values, given={k: v for k, v in given.items() if v is not None})

        wrapped.__doc__ = command.__doc__
        wrapped.__signature__ = inspect.Signature(parameters)  # type: ignore[attr-defined]
        wrapped.__annotations__ = {one.name: one.annotation for one in parameters}
        return wrapped

    return with_options


def _parameter(setting: Setting) -> inspect.Parameter:
    dashed = setting.name.replace("_", "-")
    name = f"--{dashed}/--no-{dashed}" if setting.kind is bool else f"--{dashed}"
    kind: Any = Literal[setting.choices] if setting.choices else setting.kind
    default = None if setting.default is dataclasses.MISSING else setting.default
    return inspect.Parameter(
        setting.name,
        inspect.Parameter.KEYWORD_ONLY,
        default=default,
        annotation=Annotated[kind | None, option(name, help=setting.help)],
    )


def pairs_command(
    captures: Annotated[
        list[Path], typer.Argument(metavar="CAPTURES", help="Captures with known cameras.")
    ],
    out: Annotated[Path, option("--out", metavar="PAIRS", help="Folder for the pairs.")],
    recipes: Annotated[
        list[str] | None,
        option(
            "--recipe",
            metavar="NAME",
            help="sparse, underfit, noise, paper, scattered or leave-one-out; repeatable. "
            "Default: the first three.",
        ),
    ] = None,
    fits: Annotated[int, option("--fits", help="Fits per capture and recipe.")] = 1,
    views: Annotated[int, option("--views", help="Novel views rendered per fit.")] = 8,
    steps: Annotated[
        int | None, option("--steps", help="Steps of each fit. Default: as igsr fit.")
    ] = None,
    all_views: Annotated[bool, option("--all-views", help="Also use the held-out views.")] = False,
    seed: Annotated[int, option("--seed", help="Random seed.")] = 0,
    jobs: JobsOption = 1,
    ray: RayOption = False,
    backend: FitBackendOption = "auto",
    as_json: JsonOption = False,
) -> None:
    """Make training pairs: renders of novel views of degraded fits, and the true photos.

    Finished fits are kept in --out; the same command continues from there.
    """
    from igsr_lab.denoiser.pair_files import DEFAULT_RECIPES
    from igsr_lab.denoiser.pairs import make_pairs

    with error_messages(
        lambda: "Interrupted; finished fits are kept, the same command continues from there."
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
            recipes=recipes or DEFAULT_RECIPES,
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
    output_console().print(f"{renders} pairs of {len(rows)} fits: {out}")


@settings_options(Training)
def train_command(
    pairs: Annotated[
        Path, option("--pairs", metavar="PAIRS", help="Folder of pairs made by `pairs`.")
    ],
    out: Annotated[
        Path, option("--out", metavar="DIR", help="Folder for weights, log and checkpoint.")
    ],
    given: dict[str, Any],
    features: Annotated[
        Path | None,
        option(
            "--features",
            metavar="FILE",
            help="SqueezeNet 1.0 arrays (.npz), for a perceptual distance (not LPIPS).",
        ),
    ] = None,
    lpips: Annotated[
        Literal["alex", "vgg", "squeeze"] | None,
        option("--lpips", help="LPIPS with this backbone, which is downloaded."),
    ] = None,
    # Not --start: torchrun has options that begin with it.
    start: Annotated[
        Path | None,
        option("--weights", metavar="FILE", help="Initial weights, such as igsr's own."),
    ] = None,
    width: Annotated[
        int, option("--width", help="Channels at half resolution.")
    ] = Architecture.width,
    device: Annotated[str, option("--device", help="torch device: cpu, cuda ...")] = "cpu",
    resume: Annotated[
        bool, option("--resume", help="Continue from the checkpoint in --out.")
    ] = False,
    as_json: JsonOption = False,
) -> None:
    """Train a denoiser. Several GPUs: torchrun --nproc-per-node N -m igsr_lab train ..."""
    from igsr_lab.denoiser.perceptual_distance import (
        Distance,
        SqueezeNetDistance,
        lpips_distance,
    )
    from igsr_lab.denoiser.train_network import LOG, WEIGHTS, is_first_process, plot_training, train

    with error_messages(lambda: f"Interrupted; continue from the checkpoint in {out} by --resume."):
        if features is not None and lpips is not None:
            raise IgsrError("--features and --lpips both name a perceptual distance; give one.")
        distance: Distance | None = None
        if features is not None:
            distance = SqueezeNetDistance(features)
        elif lpips is not None:
            distance = lpips_distance(lpips)
        # Files of killed runs begin with a dot.
        files = sorted(pairs.glob("[!.]*.npz"))
        if not files:
            raise IgsrError(
                f"{pairs} holds no .npz of pairs; make some with python -m igsr_lab pairs."
            )
        with progress_bar() as progress:
            train(
                files,
                out,
                Training(**given),
                Architecture(width),
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
        f"{out / WEIGHTS}"
    )
