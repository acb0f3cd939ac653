"""``train``: train a denoiser on pairs, with a log, validation and checkpoints."""

from __future__ import annotations

import hashlib
import json
import math
import os
import time
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn

from igsr import _core
from igsr._internal.atomic_write import atomic_write
from igsr._internal.event import Event, Listener
from igsr.denoiser.architecture import Architecture
from igsr.denoiser.inputs import COLOR
from igsr.denoiser.network import DenoiserNetwork
from igsr.denoiser.weights import load_network, save_network
from igsr.errors import IgsrError
from igsr_lab.denoiser.crops import Crop, draw_batch, stacked, validation_crops
from igsr_lab.denoiser.learner import Learner, Processes
from igsr_lab.denoiser.losses import Loss, Prediction, charbonnier, regret
from igsr_lab.denoiser.pair_files import PairSets, read_pair_sets
from igsr_lab.denoiser.perceptual_distance import Distance, distance_name
from igsr_lab.denoiser.training_settings import Training
from igsr_lab.report_parts import new_figure, save_figure

WEIGHTS = "denoiser.safetensors"
CHECKPOINT = "checkpoint.pt"
LOG = "log.jsonl"
#: Maximum number of steps between checkpoints.
MAX_CHECKPOINT_STEPS = 500
#: Number of parts of the loss in the message of an event.
SHOWN_PARTS = 3
#: Ending of the baselines of scores, which are plotted with the scores.
BASELINE = "_before"


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
    progress: Listener | None = None,
    log_every: int = 100,
    checkpoint_every: int | None = None,
) -> DenoiserNetwork:
    """Train a denoiser; the same arguments give the same weights on one machine.

    Under torchrun, each process takes its share of every batch.

    Args:
        pairs: files of ``make_pairs``; a tenth of them, from the last captures by name, are
            kept for validation. A single capture gives a warning.
        out: folder for ``denoiser.safetensors``, ``log.jsonl``, ``checkpoint.pt`` and, if
            tensorboard is installed (``pip install 'igsr[tensorboard]'``), ``tensorboard/``.
        training: settings; None is ``Training()``.
        architecture: of the network; None is ``Architecture()``.
        distance: the perceptual distance of the losses that use one.
        start: initial weights; None is random.
        device: torch's name of the device; "cuda" trains in mixed precision.
        resume: continue from the checkpoint in ``out``, if there is one.
        progress: called with an ``igsr.Event`` for each row of the log.
        log_every: steps between rows of the log.
        checkpoint_every: steps between checkpoints and validations; None is a tenth of all, at
            most 500.

    Returns:
        The denoiser with averaged weights, on the CPU.

    Raises:
        IgsrError: a file or argument cannot be used, the checkpoint is of another training, or the
            loss is not finite.
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
    about = _about(sets, training, architecture, distance, processes, start)
    files = TrainingFiles(
        out, about, training.steps, progress, resume=resume, writes=is_first_process()
    )
    if log_every < 1 or (checkpoint_every is not None and checkpoint_every < 1):
        raise IgsrError("log_every and checkpoint_every must be at least 1.")
    every = checkpoint_every or min(MAX_CHECKPOINT_STEPS, max(1, training.steps // 10))
    files.begin(learner)
    while learner.step < training.steps:
        batch = draw_batch(sets.train, training, learner.step, share, processes.device)
        parts = learner.learn(batch)
        step = learner.step
        if not all(math.isfinite(part) for part in parts.values()):
            raise IgsrError(
                f"the loss is not finite at step {step}; train with a lower rate, in another --out."
            )
        is_last = step == training.steps
        row = dict(parts) if step % log_every == 0 or is_last else {}
        if step % every == 0 or is_last:
            row |= validated(learner.averaged, validation, distance, processes.device)
            files.write_row(step, row)
            files.save_checkpoint(learner)  # after its row, so that a resumed log is complete
        elif row:
            files.write_row(step, row)
    if is_first_process():
        seconds = round(files.seconds)
        recipe = {"igsr": _core.__version__, **about, "seconds": seconds}
        save_network(learner.averaged, out / WEIGHTS, recipe)
    processes.end()
    return learner.averaged.to("cpu").eval()


def is_first_process() -> bool:
    """Whether this process is the first one of torchrun, which writes the files."""
    return int(os.environ.get("RANK", "0")) == 0


def _first_network(
    architecture: Architecture, training: Training, start: str | os.PathLike[str] | None
) -> DenoiserNetwork:
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
    """Everything that the weights depend on, for checkpoints and the weights' file."""
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


def validated(
    network: DenoiserNetwork, crops: Sequence[Crop], distance: Distance | None, device: torch.device
) -> dict[str, float]:
    """Mean scores over crops after denoising and, with names "..._before", before.

    Returns:
        "validation_charbonnier", "validation_regret", "validation_psnr" (dB) and, if there is a
        ``distance``, "validation_perceptual".
    """
    sums: dict[str, float] = {}
    with torch.no_grad():
        for crop in crops:
            batch = stacked([crop], device)
            image, log_error = network(batch.inputs)
            image = torch.where(batch.known, image.clamp(0.0, 1.0), batch.truth)
            render = batch.inputs[:, :COLOR]
            prediction = Prediction(render, image, log_error, batch.truth)
            scores = {
                "validation_charbonnier": charbonnier(prediction),
                "validation_regret": regret(prediction),
                "validation_psnr_before": _psnr(render, batch.truth),
                "validation_psnr": _psnr(image, batch.truth),
            }
            if distance is not None:
                scores["validation_perceptual_before"] = distance(render, batch.truth).mean()
                scores["validation_perceptual"] = distance(image, batch.truth).mean()
            for name, score in scores.items():
                sums[name] = sums.get(name, 0.0) + float(score) / len(crops)
    return sums


def _psnr(image: Tensor, truth: Tensor) -> Tensor:
    return -10.0 * (image - truth).square().mean().clamp_min(1e-10).log10()


class TrainingFiles:
    """Log and checkpoint of a training, and its time.

    ``about`` identifies the training: a checkpoint of another one is refused. ``writes`` is whether
    this process writes files and reports progress.
    """

    def __init__(
        self,
        out: Path,
        about: dict[str, Any],
        steps: int,
        progress: Listener | None,
        *,
        resume: bool,
        writes: bool,
    ) -> None:
        if not resume and (out / CHECKPOINT).is_file():
            raise IgsrError(
                f"{out / CHECKPOINT} is of an earlier training; continue it by --resume "
                "(resume=True), or give another --out."
            )
        self._out, self._about, self._steps = out, about, steps
        self._writes, self._progress = writes, progress
        self._earlier_seconds, self._started = 0.0, time.monotonic()
        self._board: Any = None

    @property
    def seconds(self) -> float:
        """Time spent, including earlier runs that were resumed."""
        return self._earlier_seconds + time.monotonic() - self._started

    def begin(self, learner: Learner) -> None:
        """Load the checkpoint, if there is one, and remove later rows of the log."""
        if (self._out / CHECKPOINT).is_file():
            self._restore(learner)
        if self._writes:
            _cut_log(self._out / LOG, learner.step)
            self._board = _tensorboard(self._out)
        self._started = time.monotonic()

    def write_row(self, step: int, row: dict[str, float]) -> None:
        """Write a row of the log and report progress."""
        if not self._writes:
            return
        seconds = self.seconds
        line = json.dumps({"step": step, "seconds": round(seconds, 1), **row})
        with (self._out / LOG).open("a", encoding="utf-8") as file:
            file.write(line + "\n")
        if self._board is not None:
            for name, value in row.items():
                self._board.add_scalar(name, value, step)
        if self._progress is not None:
            parts = [f"{name} {value:.4g}" for name, value in [*row.items()][:SHOWN_PARTS]]
            rate = f"{step / seconds:.3g} steps/s" if seconds else ""
            message = "  ".join([*parts, rate])
            self._progress(Event("train", step, self._steps, message, values=row))

    def save_checkpoint(self, learner: Learner) -> None:
        """Write the checkpoint."""
        if not self._writes:
            return
        content = learner.state() | {"seconds": self.seconds, "about": self._about}
        with atomic_write(self._out / CHECKPOINT) as temporary:
            torch.save(content, temporary)

    def _restore(self, learner: Learner) -> None:
        path = self._out / CHECKPOINT
        try:
            content = torch.load(path, weights_only=True, map_location=learner.device)
            same = content["about"] == self._about
        except Exception as error:  # torch raises many kinds on damaged files
            raise IgsrError(f"{path} is damaged; delete it to train from the start.") from error
        if not same:
            raise IgsrError(
                f"{path} is of a training with other data or settings; repeat those, or use "
                "another --out."
            )
        learner.load_state(content)
        self._earlier_seconds = content["seconds"]


def _cut_log(path: Path, step: int) -> None:
    """Keep the log's complete lines up to ``step``; later ones will be written again."""
    try:
        lines = path.read_text(encoding="utf-8").splitlines()
    except FileNotFoundError:
        return
    kept = []
    for line in lines if step else []:
        try:
            row = json.loads(line)
        except ValueError:  # an incomplete line of a killed training
            continue
        if row["step"] <= step:
            kept.append(f"{line}\n")
    with atomic_write(path) as temporary:
        temporary.write_text("".join(kept), encoding="utf-8")


def _tensorboard(out: Path) -> Any:
    """A writer of TensorBoard's files, or None if it is not installed."""
    try:
        from torch.utils.tensorboard import SummaryWriter
    except ImportError:
        return None
    return SummaryWriter(out / "tensorboard")


def plot_training(log: Path, path: Path) -> list[dict[str, Any]]:
    """Plot every quantity of a training's log over its steps; return the log's rows."""
    try:
        rows = [json.loads(line) for line in log.read_text(encoding="utf-8").splitlines()]
    except (OSError, ValueError) as error:
        raise IgsrError(f"{log} cannot be read ({error}); train again.") from error
    names = list(dict.fromkeys(key for row in rows for key in row))
    # Baselines share the axis of their score, and validation shares the axis of training.
    drawn = [
        name
        for name in names
        if name not in ("step", "seconds")
        and not name.endswith(BASELINE)
        and name.removeprefix("validation_") not in set(names) - {name}
    ]
    if not drawn:
        raise IgsrError(f"{log} holds nothing to plot; train again.")
    figure = new_figure(10.0, 2.4 * -(-len(drawn) // 2))
    axes = figure.subplots(-(-len(drawn) // 2), 2, squeeze=False).ravel()
    for axis in axes[len(drawn) :]:
        axis.remove()
    for axis, name in zip(axes, drawn, strict=False):
        for start in (name, f"validation_{name}"):
            for end, style in (("", "-"), (BASELINE, "--")):
                key = f"{start}{end}"
                known = [(row["step"], row[key]) for row in rows if key in row]
                if known:
                    marker = "o" if len(known) == 1 else ""  # a single point has no line
                    label = key.replace("_", " ")
                    axis.plot(*zip(*known, strict=True), style + marker, label=label)
        axis.set_xlabel("step")
        axis.grid(alpha=0.3)
        axis.legend(fontsize=8)
    save_figure(figure, path)
    return rows
