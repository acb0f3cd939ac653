"""Trains a denoiser on pairs: batches, steps, checkpoints, logs."""

from __future__ import annotations

import hashlib
import json
import math
import os
import time
import warnings
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from igsr import _core
from igsr._internal.atomic_write import atomic_write
from igsr.denoiser.inputs import BUFFERS, CHOICES, COLOR, PHOTO
from igsr.denoiser.network import MULTIPLE, Architecture, DenoiserNetwork
from igsr.denoiser.training.losses import Loss, Prediction, charbonnier, regret
from igsr.denoiser.training.pair_files import OFFSET, SCALE, Pairs, read_pairs
from igsr.denoiser.training.pairs import capture_of_pairs
from igsr.denoiser.training.perceptual_distance import Distance, distance_name
from igsr.denoiser.weights import load_network, save_network
from igsr.errors import IgsrError

CHECKPOINT = "checkpoint.pt"
LOG = "log.jsonl"
WEIGHTS = "denoiser.safetensors"
#: Part of the files of pairs, at the end of the order of their names, that is never trained on.
VALIDATION = 0.1
#: Crops per validation, the same each time.
VALIDATION_CROPS = 64
#: Each crop lacks all the buffers, or the photos, this often: renders may come without.
LACKING = 0.05
#: A crop whose render is less wrong than this, in squared error, teaches nothing; others are drawn
#: in its place, at most so many.
RIGHT, DRAWN_AGAIN = 1e-5, 3
#: Steps between checkpoints, at most.
MOST_BETWEEN = 500
#: The weights kept are a running mean over about the last tenth of the steps, at most over these.
AVERAGED_STEPS = 500


@dataclass(frozen=True)
class Training:
    """How to train; stored with what comes out.

    Attributes:
        steps: batches.
        batch: crops per step, of all processes together.
        crop: side of a crop, pixels, a multiple of 8; smaller pictures are taken whole.
        rate: Adam's, at its highest; it warms up over the first hundredth and falls as a cosine.
        weight_decay: decoupled, per step in units of the rate.
        dropout: part of the features at an eighth of the resolution that is left out.
        augment: mirror, swap colour channels, change exposure.
        loss: of ``igsr.denoiser.training.losses``.
        a: of loss "gan+lpips".
        seed: of everything that is drawn.
    """

    steps: int = 20_000
    batch: int = 8
    crop: int = 128
    rate: float = 1e-3
    weight_decay: float = 1e-4
    dropout: float = 0.0
    augment: bool = True
    loss: str = "default"
    a: float = 0.9
    seed: int = 0

    def __post_init__(self) -> None:
        """Check the numbers."""
        for name in ("steps", "batch", "crop"):
            if getattr(self, name) < 1:
                raise IgsrError(f"{name} must be at least 1, not {getattr(self, name)}.")
        if self.crop % MULTIPLE:
            raise IgsrError(f"crop must be a multiple of {MULTIPLE}, not {self.crop}.")
        if not (math.isfinite(self.rate) and self.rate > 0.0):
            raise IgsrError(f"rate must be positive, not {self.rate:g}.")
        if self.seed < 0:
            raise IgsrError(f"seed must not be negative, not {self.seed}.")
        for name in ("weight_decay", "dropout"):
            if not 0.0 <= getattr(self, name) < 1.0:
                raise IgsrError(f"{name} must be from 0 to 1, not {getattr(self, name):g}.")


@dataclass(frozen=True)
class TrainingProgress:
    """Where a training stands: steps done of all, the parts of the loss, seconds so far."""

    step: int
    steps: int
    parts: dict[str, float]
    seconds: float


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
        training: how.
        architecture: which network.
        distance: perceptual, for the losses that have it.
        start: weights to go on from, such as igsr's own for pairs of one's own captures; None
            begins with random ones.
        device: torch's name of where to train; "cuda" has mixed precision.
        resume: go on from ``out``'s checkpoint, if there is one, to the same end.
        progress: called now and then.
        log_every: steps between lines of the log.
        checkpoint_every: steps between checkpoints, and validations; None is a tenth of all, at
            most 500.

    Raises:
        IgsrError: a file cannot be used, ``start`` is of another architecture, the checkpoint is
            of another training, or the loss is not finite.
    """
    training, architecture = training or Training(), architecture or Architecture()
    if checkpoint_every is None:
        checkpoint_every = min(MOST_BETWEEN, max(1, training.steps // 10))
    out = Path(out)
    out.mkdir(parents=True, exist_ok=True)
    # By captures: one's name may begin with another's.
    names = sorted((str(path) for path in pairs), key=lambda name: (_capture(name), name))
    if len(names) < 2:
        raise IgsrError("training needs at least two files of pairs, one of them to validate on.")
    kept = _kept_for_validation(names)
    train_set = [read_pairs(name) for name in names[:-kept]]
    validation = _validation_crops([read_pairs(name) for name in names[-kept:]], training)

    processes = _Processes(device)
    if training.batch % processes.count:
        raise IgsrError(
            f"batch must be a multiple of the number of processes, {processes.count}, not "
            f"{training.batch}."
        )
    if isinstance(distance, nn.Module):
        distance = distance.to(processes.device)
    torch.manual_seed(training.seed)
    network = DenoiserNetwork(architecture, training.dropout)
    if start is not None:
        begun = load_network(start)
        if begun.architecture != architecture:
            raise IgsrError(f"{start} is of {begun.architecture}; train that, or without start.")
        network.load_state_dict(begun.state_dict())
    loss = Loss(training.loss, distance, training.a)
    learner = _Learner(network, loss, training, processes)
    state = {
        "pairs": [Path(name).name for name in names],
        "pairs_sha256": _hash_of_all(names),
        "training": asdict(training),
        "distance": distance_name(distance),
        "processes": processes.count,
    }
    if start is not None:
        state["start"] = hashlib.sha256(Path(start).read_bytes()).hexdigest()
    state["architecture"] = json.loads(json.dumps(asdict(architecture)))
    if resume and (out / CHECKPOINT).is_file():
        learner.restore(out / CHECKPOINT, state)
    if processes.first:
        _cut_log(out / LOG, learner.step)
    board = _board(out) if processes.first else None
    started = time.monotonic() - learner.seconds

    while learner.step < training.steps:
        batch = _batch(train_set, training, learner.step, processes)
        parts = learner.learn(*batch)
        learner.seconds = time.monotonic() - started
        last = learner.step == training.steps
        if not all(math.isfinite(part) for part in parts.values()):
            raise IgsrError(
                f"the loss is not finite at step {learner.step}; train with a lower rate, in "
                "another --out."
            )
        row: dict[str, Any] = {}
        if learner.step % log_every == 0 or last:
            row |= parts
        checkpoint = learner.step % checkpoint_every == 0 or last
        if checkpoint:
            row |= _validated(learner.averaged, validation, distance, processes.device)
        if row and processes.first:
            _write_log(out / LOG, board, learner.step, learner.seconds, row)
            if progress is not None:
                progress(TrainingProgress(learner.step, training.steps, row, learner.seconds))
        # After its line of the log: what comes later is cut from there, what lacks stays lacking.
        if checkpoint and processes.first:
            learner.save(out / CHECKPOINT, state)
    if processes.first:
        recipe = {"igsr": _core.__version__, **state, "seconds": round(learner.seconds)}
        save_network(learner.averaged, out / WEIGHTS, recipe)
    processes.end()
    return learner.averaged.to("cpu").eval()


def is_first_process() -> bool:
    """Whether this is the process that writes, of those that torchrun started."""
    return int(os.environ.get("RANK", "0")) == 0


class _Processes:
    """This process among those that torchrun started; alone if it did not."""

    def __init__(self, device: str) -> None:
        self.count = int(os.environ.get("WORLD_SIZE", "1"))
        self.rank = int(os.environ.get("RANK", "0"))
        self.first = is_first_process()
        index = os.environ.get("LOCAL_RANK")
        self.device = torch.device(f"cuda:{index}" if device == "cuda" and index else device)
        if self.count > 1:
            torch.distributed.init_process_group("nccl" if device == "cuda" else "gloo")

    def shared(self, network: nn.Module) -> nn.Module:
        """The network, its gradients averaged over the processes."""
        if self.count == 1:
            return network
        return nn.parallel.DistributedDataParallel(network)

    def average_gradients(self, network: nn.Module) -> None:
        """Make each gradient the mean over the processes, of what ``shared`` does not wrap."""
        if self.count == 1:
            return
        for parameter in network.parameters():
            if parameter.grad is not None:
                torch.distributed.all_reduce(parameter.grad)
                parameter.grad /= self.count

    def end(self) -> None:
        if self.count > 1:
            torch.distributed.destroy_process_group()


def _capture(name: str) -> str:
    return capture_of_pairs(Path(name).name)


def _kept_for_validation(names: Sequence[str]) -> int:
    """How many files at the end to keep: whole captures, so that none of them is trained on."""
    captures = [_capture(name) for name in names]
    kept = max(1, round(VALIDATION * len(names)))
    if len(set(captures)) == 1:
        warnings.warn(
            "All pairs are of one capture: validation is of the scene that is trained on.",
            stacklevel=3,
        )
        return kept
    while kept < len(names) and captures[-kept - 1] == captures[-kept]:
        kept += 1
    if kept < len(names):
        return kept
    # The tenth reached into the first capture: the last alone is kept.
    return captures.count(captures[-1])


def _hash_of_all(names: Sequence[str]) -> str:
    digest = hashlib.sha256()
    for name in names:
        digest.update(hashlib.sha256(Path(name).read_bytes()).digest())
    return digest.hexdigest()


class _Learner:
    """A network with its optimiser, its discriminator and the running mean of its weights."""

    def __init__(
        self, network: DenoiserNetwork, loss: Loss, training: Training, processes: _Processes
    ) -> None:
        self.network = _placed(network, processes.device).train()
        self.shared = processes.shared(self.network)
        self.averaged = _placed(DenoiserNetwork(network.architecture), processes.device).eval()
        self.averaged.load_state_dict(network.state_dict())
        self.loss, self.training, self.processes = loss, training, processes
        self.device = processes.device
        self.adam = _adam(self.network, training)
        self.judge = loss.discriminator.to(self.device) if loss.discriminator else None
        self.judge_adam = _adam(self.judge, training) if self.judge else None
        self.step = 0
        self.seconds = 0.0

    def learn(self, inputs: Tensor, truth: Tensor) -> dict[str, float]:
        """One step; the parts of the loss before it."""
        rate = self.training.rate * _schedule(self.step, self.training.steps)
        inputs, truth = inputs.to(self.device), truth.to(self.device)
        truth, known = truth[:, :COLOR], truth[:, COLOR:] > 0.5
        torch.manual_seed(self.training.seed * 1_000_003 + self.step)  # of the dropout
        with torch.autocast(self.device.type, torch.bfloat16, enabled=self.device.type == "cuda"):
            image, log_error = self.shared(inputs)
        # Where the truth is unknown everything is right as it is, and no gradient comes from there.
        image = torch.where(known, image.float(), truth)
        log_error = torch.where(known, log_error.float(), log_error.detach().float())
        made = Prediction(inputs[:, :COLOR], image, log_error, truth)
        total, parts = self.loss(made)
        _stepped(self.adam, total, rate)  # ``shared`` has averaged its gradients
        if self.judge is not None and self.judge_adam is not None:
            judged = self.judge.loss(made)
            judge = self.judge
            _stepped(self.judge_adam, judged, rate, lambda: self.processes.average_gradients(judge))
            parts["discriminator"] = float(judged.detach())
        self.step += 1
        share = 1.0 / min(1.0 + self.step / 10.0, AVERAGED_STEPS)
        with torch.no_grad():
            for mean, now in zip(
                self.averaged.parameters(), self.network.parameters(), strict=True
            ):
                mean.lerp_(now, share)
        return parts

    def _states(self) -> dict[str, Any]:
        states = {"network": self.network, "averaged": self.averaged, "adam": self.adam}
        if self.judge is not None:
            states |= {"judge": self.judge, "judge_adam": self.judge_adam}
        return states

    def save(self, path: Path, about: dict[str, Any]) -> None:
        content = {name: part.state_dict() for name, part in self._states().items()}
        content |= {"step": self.step, "seconds": self.seconds, "about": about}
        with atomic_write(path) as temporary:
            torch.save(content, temporary)

    def restore(self, path: Path, about: dict[str, Any]) -> None:
        try:
            content = torch.load(path, weights_only=True, map_location=self.device)
            same = content["about"] == about
        except Exception as error:  # torch raises anything at all on damaged files
            raise IgsrError(
                f"{path} is no whole checkpoint; delete it to train from the start."
            ) from error
        if not same:
            raise IgsrError(
                f"{path} is of a training with other pairs or settings; repeat those, or use "
                "another --out."
            )
        for name, part in self._states().items():
            part.load_state_dict(content[name])
        self.step, self.seconds = content["step"], content["seconds"]


def _placed(network: DenoiserNetwork, device: torch.device) -> DenoiserNetwork:
    return network.to(device).to(memory_format=torch.channels_last)


def _adam(network: nn.Module, training: Training) -> torch.optim.AdamW:
    return torch.optim.AdamW(network.parameters(), weight_decay=training.weight_decay)


def _stepped(
    adam: torch.optim.AdamW,
    loss: Tensor,
    rate: float,
    before: Callable[[], None] | None = None,
) -> None:
    for group in adam.param_groups:
        group["lr"] = rate
    adam.zero_grad()
    loss.backward()
    if before is not None:
        before()
    nn.utils.clip_grad_norm_([p for g in adam.param_groups for p in g["params"]], 1.0)
    adam.step()


def _schedule(step: int, steps: int) -> float:
    warm_up = max(1, steps // 100)
    if step < warm_up:
        return (step + 1) / warm_up
    return 0.5 + 0.5 * math.cos(math.pi * (step - warm_up) / max(1, steps - warm_up))


def _batch(
    pairs: list[Pairs], training: Training, step: int, processes: _Processes
) -> tuple[Tensor, Tensor]:
    """Crops drawn by (seed, step) alone, so that nothing random has to be saved."""
    random = np.random.default_rng([training.seed, step, 0xBA7C])
    # A file counts by its number of views.
    weights = np.array([len(one.truth) for one in pairs], np.float64)
    chosen = random.choice(len(pairs), size=training.batch, p=weights / weights.sum())
    seeds = random.integers(2**63, size=training.batch)
    mine = range(processes.rank, training.batch, processes.count)
    crops = []
    for k in mine:
        own = np.random.default_rng(int(seeds[k]))
        for _ in range(1 + DRAWN_AGAIN):
            crop = _crop(pairs[chosen[k]], training.crop, own)
            if float((crop[0][:COLOR] - crop[1][:COLOR]).square().mean()) > RIGHT:
                break
        crops.append(_augmented(*crop, own) if training.augment else crop)
    return _stacked(crops)


def _stacked(crops: list[tuple[Tensor, Tensor]]) -> tuple[Tensor, Tensor]:
    inputs = torch.stack([inputs for inputs, _ in crops])
    truth = torch.stack([truth for _, truth in crops])
    return inputs.contiguous(memory_format=torch.channels_last), truth


def _crop(pairs: Pairs, side: int, random: np.random.Generator) -> tuple[Tensor, Tensor]:
    """Inputs [``CHANNELS``, side, side] and truth [4, side, side].

    The truth's fourth channel is 1 where it is known; elsewhere it is the render.
    """
    view = random.integers(len(pairs.truth))
    height, width = pairs.truth.shape[2:]
    top = random.integers(max(1, height - side + 1))
    left = random.integers(max(1, width - side + 1))
    at = (view, slice(None), slice(top, top + side), slice(left, left + side))
    inputs = pairs.inputs[at] * SCALE[:, None, None] + OFFSET[:, None, None]
    truth = pairs.truth[at].astype(np.float32) / np.float32(255.0)
    known = pairs.masks[view, at[2], at[3]]
    truth = np.concatenate([np.where(known, truth, inputs[:COLOR]), known[None].astype(np.float32)])
    short = [(0, 0), (0, max(0, side - height)), (0, max(0, side - width))]
    if height < side or width < side:
        inputs, truth = np.pad(inputs, short, mode="edge"), np.pad(truth, short, mode="edge")
    return torch.from_numpy(inputs), torch.from_numpy(truth)


#: Channels that hold colours, three each.
_COLORS = (0, *(COLOR + BUFFERS + k * PHOTO for k in range(CHOICES)))
_NORMAL_X, _NORMAL_Y = COLOR + 3, COLOR + 4


def _augmented(inputs: Tensor, truth: Tensor, random: np.random.Generator) -> tuple[Tensor, Tensor]:
    """Mirrored, turned, with colour channels swapped and exposure changed; sometimes lacking."""
    inputs, truth = inputs.clone(), truth.clone()
    if random.uniform() < 0.5:
        inputs, truth = inputs.flip(2), truth.flip(2)
        inputs[_NORMAL_X] *= -1.0
    if random.uniform() < 0.5:
        inputs, truth = inputs.flip(1), truth.flip(1)
        inputs[_NORMAL_Y] *= -1.0
    order = torch.from_numpy(random.permutation(3))
    gain = float(np.exp(random.uniform(-0.4, 0.2)))
    for at in _COLORS:
        inputs[at : at + 3] = (gain * inputs[at : at + 3][order]).clamp(0.0, 1.0)
    truth[:COLOR] = (gain * truth[:COLOR][order]).clamp(0.0, 1.0)
    if random.uniform() < LACKING:
        inputs[COLOR : COLOR + BUFFERS] = 0.0
    if random.uniform() < LACKING:
        inputs[COLOR + BUFFERS :] = 0.0
    return inputs, truth


def _validation_crops(pairs: list[Pairs], training: Training) -> list[tuple[Tensor, Tensor]]:
    random = np.random.default_rng(0xDA7A)
    return [_crop(pairs[k % len(pairs)], training.crop, random) for k in range(VALIDATION_CROPS)]


def _validated(
    network: DenoiserNetwork,
    crops: list[tuple[Tensor, Tensor]],
    distance: Distance | None,
    device: torch.device,
) -> dict[str, float]:
    """Mean scores over the validation crops, before and after."""
    sums: dict[str, float] = {}
    with torch.no_grad():
        for crop in crops:
            inputs, truth = (part.to(device) for part in _stacked([crop]))
            truth, known = truth[:, :COLOR], truth[:, COLOR:] > 0.5
            image, log_error = network(inputs)
            image = torch.where(known, image.clamp(0.0, 1.0), truth)
            render = inputs[:, :COLOR]
            scores = {
                "validation_charbonnier": charbonnier(Prediction(render, image, log_error, truth)),
                "validation_regret": regret(Prediction(render, image, log_error, truth)),
                "validation_psnr_before": _psnr(render, truth),
                "validation_psnr": _psnr(image, truth),
            }
            if distance is not None:
                scores["validation_perceptual_before"] = distance(render, truth).mean()
                scores["validation_perceptual"] = distance(image, truth).mean()
            for name, score in scores.items():
                sums[name] = sums.get(name, 0.0) + float(score) / len(crops)
    return sums


def _psnr(image: Tensor, truth: Tensor) -> Tensor:
    return -10.0 * (image - truth).square().mean().clamp_min(1e-10).log10()


def _board(out: Path) -> Any:
    try:
        from torch.utils.tensorboard import SummaryWriter
    except ImportError:
        return None
    return SummaryWriter(out / "tensorboard")


def _cut_log(path: Path, step: int) -> None:
    """Leave the log's whole lines up to ``step``: later ones are written again."""
    try:
        lines = path.read_text(encoding="utf-8").splitlines()
    except FileNotFoundError:
        return
    kept = []
    for line in lines if step else []:
        try:
            row = json.loads(line)
        except ValueError:  # torn when a training was killed
            continue
        if row["step"] <= step:
            kept.append(f"{line}\n")
    with atomic_write(path) as temporary:
        temporary.write_text("".join(kept), encoding="utf-8")


def _write_log(path: Path, board: Any, step: int, seconds: float, row: dict[str, float]) -> None:
    with path.open("a", encoding="utf-8") as file:
        file.write(json.dumps({"step": step, "seconds": round(seconds, 1), **row}) + "\n")
    if board is not None:
        for name, value in row.items():
            board.add_scalar(name, value, step)
