"""Train a network on captures made on the fly: draw a batch, learn from it, log, validate."""

from __future__ import annotations

import json
import os
from collections.abc import Callable
from dataclasses import asdict, replace
from pathlib import Path

import torch
from safetensors.torch import save_file

from igsr._internal.atomic_write import atomic_write, check_writable
from igsr.errors import IgsrError
from igsr.pose.da3.checkpoint import CONFIG, PREFIX, WEIGHTS
from igsr.pose.da3.config import TINY, TRAINED, description
from igsr.pose.da3.network import Da3Network
from igsr.pose.da3.training.capture_source import CaptureSource
from igsr.pose.da3.training.initial_weights import initial_network
from igsr.pose.da3.training.learner import Learner
from igsr.pose.da3.training.training_settings import PoseTraining
from igsr.pose.da3.training.validation import validated
from igsr.synth import RECIPE_VERSION
from igsr.training.training_run import TrainingProgress, TrainingRun

#: The folder in that of a training where captures are kept, unless another is named.
CAPTURES = "captures"


def train(
    out: str | os.PathLike[str],
    training: PoseTraining | None = None,
    *,
    captures: str | os.PathLike[str] | None = None,
    jobs: int = 1,
    device: str = "cpu",
    resume: bool = False,
    progress: Callable[[TrainingProgress], None] | None = None,
    captured: Callable[[int, int], None] | None = None,
    log_every: int = 10,
    checkpoint_every: int | None = None,
) -> Da3Network:
    """Train a network of the size "igsr-tiny" on captures of ``igsr synth``.

    The same arguments give the same weights on one CPU with one number of threads. On a GPU
    gradients of resampled maps are added in no fixed order.

    Args:
        out: folder for ``model.safetensors`` and ``config.json``, which are a checkpoint for
            ``estimator="da3"``, and ``log.jsonl``, ``checkpoint.pt`` and, where tensorboard is
            installed, ``tensorboard/``.
        training: settings; None is ``PoseTraining()``.
        captures: folder where captures are kept, which trainings of the same seed and photos can
            share; None is ``captures`` in ``out``.
        jobs: captures that are made at a time, each on a core.
        device: torch's name of where to train; "cuda" has mixed precision.
        resume: go on from ``out``'s checkpoint, if there is one, to the same end.
        progress: called with each row of the log.
        captured: called with (done, all) for each capture of the validation.
        log_every: steps between rows of the log.
        checkpoint_every: steps between checkpoints, and validations; None is a tenth of all, at
            most 500.

    Returns:
        The network with the moving average of the weights, on the CPU, ready to predict.

    Raises:
        IgsrError: a setting or the device cannot be used, Mitsuba is not installed, the folder of
            captures holds some of other settings, the checkpoint is of another training, or the
            loss is not finite.
    """
    training = training or PoseTraining()
    out = Path(out)
    check_writable(out / WEIGHTS)
    if jobs < 1:
        raise IgsrError(f"jobs is {jobs}; give a whole number of at least 1.")
    config = replace(TINY, resolution=training.resolution)
    learner = Learner(initial_network(config, training.seed), training, _device(device))
    run = TrainingRun(
        out,
        {"network": TRAINED, "synth": RECIPE_VERSION, "settings": asdict(training)},
        training.steps,
        writes=True,
        progress=progress,
        log_every=log_every,
        checkpoint_every=checkpoint_every,
        resume=resume,
    )
    folder = out / CAPTURES if captures is None else Path(captures)
    with CaptureSource(training, folder, jobs).open() as source:
        validation = source.validation(captured)

        def learn(step: int) -> dict[str, float]:
            return learner.learn(source.batch(step), source.shown(step))

        def validate() -> dict[str, float]:
            return validated(learner.averaged, validation, learner.device)

        run.train(learner, learn, validate, validate_first=True)
    network = learner.averaged.to("cpu").eval().requires_grad_(False)
    # The sizes before the weights, which without them would be used at another resolution.
    with atomic_write(out / CONFIG) as temporary:
        content = {**description(config), **run.recipe()}
        temporary.write_text(json.dumps(content, indent=1) + "\n", encoding="utf-8")
    with atomic_write(out / WEIGHTS) as temporary:
        save_file({PREFIX + key: one for key, one in network.state_dict().items()}, temporary)
    return network


def _device(name: str) -> torch.device:
    try:
        return torch.empty(0, device=name).device
    except (RuntimeError, AssertionError) as error:
        reason = str(error).strip().partition("\n")[0].partition(". ")[0] or "no reason given"
        raise IgsrError(f"device {name!r} cannot be used ({reason}); give 'cpu'") from error
