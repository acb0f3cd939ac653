"""Train a denoiser on pairs: draw a batch, learn from it, log, validate, to the last step."""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Callable, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import torch
from torch import nn

from igsr.denoiser.architecture import Architecture
from igsr.denoiser.network import DenoiserNetwork
from igsr.denoiser.weights import load_network, save_network
from igsr.errors import IgsrError
from igsr_lab.denoiser.crops import draw_batch, validation_crops
from igsr_lab.denoiser.distributed import Processes
from igsr_lab.denoiser.learner import Learner
from igsr_lab.denoiser.losses import Loss
from igsr_lab.denoiser.pair_sets import PairSets, read_pair_sets
from igsr_lab.denoiser.perceptual_distance import Distance, distance_name
from igsr_lab.denoiser.training_run import TrainingProgress, TrainingRun
from igsr_lab.denoiser.training_settings import Training
from igsr_lab.denoiser.validation import validated

WEIGHTS = "denoiser.safetensors"


def train(
    pairs: Sequence[str | os.PathLike[str]],
    out: str | os.PathLike[str],
    training: Training | None = None,
    architecture: Architecture | None = None,
    *,
    distance: Distance | None = None,
    start: str | os.PathLike[str] | None = None,
    device: str = "cpu",
    resume: bool = False,
    progress: Callable[[TrainingProgress], None] | None = None,
    log_every: int = 100,
    checkpoint_every: int | None = None,
) -> DenoiserNetwork:
    """Train a denoiser; the same arguments give the same weights on one machine.

    Under torchrun each process takes its share of every batch.

    Args:
        pairs: files of ``make_pairs``; those of the last captures by name, a tenth of all files,
            are kept for validation. Of a single capture the last files are, with a warning: what
            they score is then of a scene that was trained on.
        out: folder for ``denoiser.safetensors``, ``log.jsonl``, ``checkpoint.pt`` and, where
            tensorboard is installed (``pip install 'igsr[tensorboard]'``), ``tensorboard/``.
        training: settings; None is ``Training()``.
        architecture: which network; None is ``Architecture()``.
        distance: perceptual, for the losses that have it.
        start: weights to go on from, such as igsr's own for pairs of one's own captures; None
            begins with random ones.
        device: torch's name of where to train; "cuda" has mixed precision.
        resume: go on from ``out``'s checkpoint, if there is one, to the same end.
        progress: called with each row of the log.
        log_every: steps between rows of the log.
        checkpoint_every: steps between checkpoints, and validations; None is a tenth of all, at
            most 500.

    Returns:
        The denoiser with the moving average of the weights, on the CPU, ready for use.

    Raises:
        IgsrError: a file cannot be used, ``start`` is of another architecture, the checkpoint is
            of another training, or the loss is not finite.
    """
    training, architecture = training or Training(), architecture or Architecture()
    out = Path(out)
    out.mkdir(parents=True, exist_ok=True)
    sets = read_pair_sets(pairs)
    validation = validation_crops(sets.validation, training.crop)
    processes = Processes(device)
    share = processes.share_of(training.batch)
    if isinstance(distance, nn.Module):
        distance = distance.to(processes.device)
    torch.manual_seed(training.seed)
    network = _first_network(architecture, training, start)
    learner = Learner(network, Loss(training.loss, distance, training.a), training, processes)
    run = TrainingRun(
        out,
        _about(sets, training, architecture, distance, processes, start),
        training.steps,
        writes=processes.first,
        progress=progress,
        log_every=log_every,
        checkpoint_every=checkpoint_every,
        resume=resume,
    )

    def learn(step: int) -> dict[str, float]:
        return learner.learn(draw_batch(sets.train, training, step, share, processes.device))

    def validate() -> dict[str, float]:
        return validated(learner.averaged, validation, distance, processes.device)

    run.train(learner, learn, validate)
    if processes.first:
        save_network(learner.averaged, out / WEIGHTS, run.recipe())
    processes.end()
    return learner.averaged.to("cpu").eval()


def _first_network(
    architecture: Architecture, training: Training, start: str | os.PathLike[str] | None
) -> DenoiserNetwork:
    """The network to train: with random weights, or with those of ``start``."""
    network = DenoiserNetwork(architecture, training.dropout)
    if start is not None:
        given = load_network(start)
        if given.architecture != architecture:
            raise IgsrError(f"{start} is of {given.architecture}; train that, or without start.")
        network.load_state_dict(given.state_dict())
    return network


def _about(
    sets: PairSets,
    training: Training,
    architecture: Architecture,
    distance: Distance | None,
    processes: Processes,
    start: str | os.PathLike[str] | None,
) -> dict[str, Any]:
    """All that the weights depend on, as it stands in checkpoints and beside the weights."""
    about = {
        "pairs": sets.names,
        "pairs_sha256": sets.sha256,
        "training": asdict(training),
        "distance": distance_name(distance),
        "processes": processes.count,
    }
    if start is not None:
        about["start"] = hashlib.sha256(Path(start).read_bytes()).hexdigest()
    about["architecture"] = json.loads(json.dumps(asdict(architecture)))
    return about
