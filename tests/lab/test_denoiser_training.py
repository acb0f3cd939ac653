"""Training of the denoiser: losses, pairs of pictures, the training itself."""

import json
import os
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from feature_files import squeezenet_file

import igsr
from igsr.denoiser import load_network, save_network
from igsr.denoiser.architecture import Architecture
from igsr.denoiser.inputs import CHANNELS, COLOR
from igsr.denoiser.network import DenoiserNetwork
from igsr_lab.denoiser.crops import RIGHT, draw_batch
from igsr_lab.denoiser.distributed import Processes
from igsr_lab.denoiser.losses import (
    LOSSES,
    Loss,
    Prediction,
    error_likelihood,
    perceptual_ratio,
    regret,
    squared_ratio,
    structure_ratio,
)
from igsr_lab.denoiser.pair_files import Pairs, read_pairs, write_pairs
from igsr_lab.denoiser.pair_sets import kept_for_validation
from igsr_lab.denoiser.pairs import capture_of_pairs
from igsr_lab.denoiser.perceptual_distance import SqueezeNetDistance, _Lpips, lpips_distance
from igsr_lab.denoiser.plot_training import plot_training
from igsr_lab.denoiser.train_network import WEIGHTS, train
from igsr_lab.denoiser.training_run import CHECKPOINT, LOG
from igsr_lab.denoiser.training_settings import Training

SMALL = Architecture(width=4, blocks=(1, 1, 1))


def network(architecture=SMALL, seed=0):
    """With random weights everywhere, so that nothing is the identity."""
    torch.manual_seed(seed)
    made = DenoiserNetwork(architecture).eval()
    with torch.no_grad():
        for parameter in made.parameters():
            parameter.copy_(0.3 * torch.randn_like(parameter))
    return made


def prediction(image, truth, render=None, log_error=-3.0):
    render = torch.zeros_like(image) if render is None else render
    return Prediction(render, image, torch.full_like(image[:, :1], log_error), truth)


def test_regret_is_what_was_made_worse_only():
    truth = torch.full((1, 3, 2, 2), 0.5)
    render = truth + 0.1
    better, worse = truth + 0.05, truth - 0.3
    assert regret(prediction(better, truth, render)) == 0.0
    assert regret(prediction(worse, truth, render)).item() == pytest.approx(0.2)


def test_a_decibel_counts_the_same_in_good_and_bad_pictures():
    truth = torch.full((2, 3, 8, 8), 0.5)
    off = torch.tensor([0.3, 0.1]).reshape(2, 1, 1, 1)
    gained = 10.0 ** (-1.0 / 20.0)
    both = squared_ratio(prediction(truth + gained * off, truth, truth + off))
    assert both.item() == pytest.approx(-0.23, abs=0.003)
    bad = squared_ratio(prediction(truth[:1] + gained * 0.3, truth[:1], truth[:1] + 0.3))
    assert bad.item() == pytest.approx(both.item(), rel=0.02)
    # What cannot be seen is not worth a change elsewhere.
    invisible = squared_ratio(prediction(truth + 1e-3, truth, truth))
    assert 0.0 < invisible.item() < 0.02


def test_structure_counts_beside_the_squared_error():
    random = torch.Generator().manual_seed(0)
    truth = torch.rand(2, 3, 24, 24, generator=random)
    render = (truth + 0.2 * torch.randn(truth.shape, generator=random)).clamp(0.0, 1.0)
    blurred = torch.nn.functional.avg_pool2d(render, 3, 1, 1)
    nearer = 0.5 * (render + truth)
    same, better, smooth = (
        structure_ratio(prediction(image, truth, render)).item()
        for image in (render, nearer, blurred)
    )
    assert same == 0.0
    assert better < -0.5
    assert smooth > 0.1, "what is smoothed is like nothing that was there"
    small = truth[..., :8, :8]
    assert structure_ratio(prediction(small, small, small)).item() == 0.0


def test_the_perceptual_ratio_looks_at_some_pictures_of_a_batch():
    truth = torch.full((4, 3, 8, 8), 0.5)
    image = truth.clone()
    image[:2] += 0.1
    image[2:] += 10.0
    image.requires_grad_()
    value = perceptual_ratio(Prediction(truth + 0.2, image, image[:, :1], truth), mean_distance)
    assert value.item() == pytest.approx(np.log(0.11 / 0.21), rel=1e-4)
    value.backward()
    assert image.grad[:2].abs().sum() > 0.0
    assert image.grad[2:].abs().sum() == 0.0


def test_the_likelihood_is_best_at_the_true_error_and_leaves_the_picture_alone():
    truth = torch.zeros(1, 3, 4, 4)
    image = torch.full_like(truth, 0.1, requires_grad=True)
    values = {
        log: error_likelihood(prediction(image, truth, log_error=log)).item()
        for log in (-4.0, float(np.log(0.1)), -1.0)
    }
    assert min(values, key=values.get) == float(np.log(0.1))
    log_error = torch.full((1, 1, 4, 4), -3.0, requires_grad=True)
    error_likelihood(Prediction(truth, image, log_error, truth)).backward()
    assert image.grad is None
    assert log_error.grad.abs().sum() > 0.0


def mean_distance(first, second):
    return (first - second).abs().mean(dim=(1, 2, 3))


@pytest.mark.parametrize("name", LOSSES)
def test_every_loss_has_its_parts_and_moves_the_network(name):
    loss = Loss(name, mean_distance, a=0.25)
    made = network()
    inputs, truth = torch.rand(1, CHANNELS, 32, 32), torch.rand(1, 3, 32, 32)
    image, log_error = made(inputs)
    total, parts = loss(Prediction(inputs[:, :COLOR], image, log_error, truth))
    expected = {
        "default": {"squared_ratio", "structure_ratio", "perceptual_ratio", "likelihood"},
        "charbonnier": {"charbonnier", "perceptual", "likelihood"},
        "gan": {"gan", "likelihood"},
        "gan+lpips": {"gan", "perceptual", "likelihood"},
        "lpips": {"perceptual", "likelihood"},
    }[name]
    assert set(parts) == expected | {"total"}
    assert parts["total"] == pytest.approx(total.item())
    if name == "gan+lpips":
        weighed = 0.75 * parts["gan"] + 0.25 * parts["perceptual"] + 0.1 * parts["likelihood"]
        assert total.item() == pytest.approx(weighed, rel=1e-5)
    total.backward()
    assert made.tail.weight.grad.abs().sum() > 0.0
    with pytest.raises(igsr.IgsrError, match="a must be from 0 to 1"):
        Loss(name, mean_distance, a=1.5)


def test_the_discriminator_is_shown_colours_that_a_picture_can_have():
    torch.manual_seed(0)
    loss, render = Loss("gan", None), torch.full((1, 3, 32, 32), 0.5)
    bright = [
        Prediction(render, torch.full_like(render, value), torch.zeros(1, 1, 32, 32), render)
        for value in (1.0, 3.0)
    ]
    values = [(loss(one)[1]["gan"], loss.discriminator.loss(one).item()) for one in bright]
    assert values[0] == values[1]


def test_losses_that_cannot_be_had_are_refused():
    with pytest.raises(igsr.IgsrError, match="loss must be one of default, charbonnier, gan"):
        Loss("mse", None)
    with pytest.raises(igsr.IgsrError, match="loss lpips needs a perceptual distance"):
        Loss("lpips", None)
    with pytest.raises(igsr.IgsrError, match="backbone must be one of alex, vgg, squeeze"):
        lpips_distance("resnet")


def pair_files(folder, count=3, size=40):
    """Truth is smooth; renders are the truth with coarse noise."""
    random = np.random.default_rng(0)
    paths = []
    for k in range(count):
        y, x = np.mgrid[:size, :size] / size
        truth = np.stack([np.sin(4 * x + k), np.cos(5 * y), np.sin(3 * (x + y))]) * 0.4 + 0.5
        inputs = np.zeros((2, CHANNELS, size, size), np.uint8)
        noise = (
            random.normal(scale=0.1, size=(2, 3, size // 4, size // 4)).repeat(4, 2).repeat(4, 3)
        )
        inputs[:, :3] = np.clip(255 * (truth + noise), 0, 255)
        whole = np.repeat((255 * truth).astype(np.uint8)[None], 2, 0)
        known = np.ones((2, size, size), np.bool_)
        write_pairs(folder / f"{k}.npz", Pairs(inputs, whole, known))
        paths.append(folder / f"{k}.npz")
    return paths


TINY = Training(steps=60, batch=4, crop=32, rate=5e-3)


def log_of(out):
    return [json.loads(line) for line in (out / LOG).read_text().splitlines()]


def test_training_makes_validation_better(tmp_path):
    training = replace(TINY, steps=150)
    pairs = pair_files(tmp_path / "pairs")
    train(pairs, tmp_path, training, Architecture(8, (1, 1, 1)), log_every=50, checkpoint_every=75)
    rows = log_of(tmp_path)
    assert [row["step"] for row in rows] == [50, 75, 100, 150]
    assert rows[-1]["validation_psnr"] > rows[-1]["validation_psnr_before"] + 0.2
    assert load_network(tmp_path / WEIGHTS).architecture == Architecture(8, (1, 1, 1))


def test_training_repeats_to_the_bit(tmp_path):
    pairs = pair_files(tmp_path / "pairs")
    training = replace(TINY, steps=6)
    first, second = (train(pairs, tmp_path / out, training, SMALL) for out in "ab")
    for one, other in zip(first.parameters(), second.parameters(), strict=True):
        assert torch.equal(one, other)
    other = train(pairs, tmp_path / "c", replace(training, seed=1), SMALL)
    assert not torch.equal(first.tail.weight, other.tail.weight)


@pytest.mark.parametrize("loss", ["default", "gan"])
def test_a_training_that_was_stopped_ends_with_the_same_weights(tmp_path, loss):
    pairs = pair_files(tmp_path / "pairs")
    training = replace(TINY, steps=12, loss=loss, dropout=0.2)

    class Stop(Exception):
        pass

    def stop(now):
        if now.step == 8:
            raise Stop

    whole = train(pairs, tmp_path / "a", training, SMALL, log_every=4, checkpoint_every=4)
    with pytest.raises(Stop):
        train(
            pairs, tmp_path / "b", training, SMALL, log_every=4, checkpoint_every=4, progress=stop
        )
    resumed = train(
        pairs, tmp_path / "b", training, SMALL, log_every=4, checkpoint_every=4, resume=True
    )
    for one, other in zip(whole.parameters(), resumed.parameters(), strict=True):
        assert torch.equal(one, other)

    # The rows that were written after the checkpoint, and one torn by a kill, are not there twice.
    assert [row["step"] for row in log_of(tmp_path / "b")] == [4, 8, 12]
    with (tmp_path / "b" / LOG).open("a") as file:
        file.write('{"step": 13}\n{"ste')
    train(pairs, tmp_path / "b", training, SMALL, log_every=4, checkpoint_every=4, resume=True)
    assert [row["step"] for row in log_of(tmp_path / "b")] == [4, 8, 12]

    other = "is of a training with other data or settings"
    with pytest.raises(igsr.IgsrError, match=other):
        train(pairs, tmp_path / "b", replace(training, rate=1e-4), SMALL, resume=True)
    with pytest.raises(igsr.IgsrError, match=other):
        train(pairs, tmp_path / "b", training, SMALL, resume=True, distance=mean_distance)
    once = read_pairs(pairs[0])
    write_pairs(pairs[0], replace(once, truth=once.truth // 2))
    with pytest.raises(igsr.IgsrError, match=other):
        train(pairs, tmp_path / "b", training, SMALL, resume=True)
    write_pairs(pairs[0], once)
    data = (tmp_path / "b" / CHECKPOINT).read_bytes()
    (tmp_path / "b" / CHECKPOINT).write_bytes(data[:999])
    with pytest.raises(igsr.IgsrError, match="is no whole checkpoint"):
        train(pairs, tmp_path / "b", training, SMALL, resume=True)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"steps": 0}, "steps must be from 1 to 1000000000, not 0"),
        ({"batch": 2.5}, "batch must be a whole number, not 2.5"),
        ({"crop": 30}, "crop must be a multiple of 8"),
        ({"rate": float("nan")}, "rate must be a number from 1e-12 to 1000, not nan"),
        ({"rate": 0.0}, "rate must be a number from 1e-12 to 1000, not 0.0"),
        ({"loss": "mse"}, "loss must be one of default, charbonnier, gan"),
        ({"a": 1.5}, "a must be a number from 0 to 1, not 1.5"),
        ({"dropout": 1.0}, "dropout must be a number from 0 to 0.9999, not 1.0"),
        ({"weight_decay": -0.1}, "weight_decay must be a number from 0 to"),
        ({"seed": -1}, "seed must be from 0 to"),
        ({"seed": 2**60}, "seed must be from 0 to"),
    ],
)
def test_bad_settings_of_a_training(options, message):
    with pytest.raises(igsr.IgsrError, match=message):
        Training(**options)


def test_nothing_is_learned_where_the_truth_is_hidden(tmp_path):
    weights = []
    for name, hidden_truth in (("a", 0), ("b", 255)):
        for path in pair_files(tmp_path / name, count=2):
            pairs = read_pairs(path)
            pairs.masks[:, :20] = False
            pairs.truth[:, :, :20] = hidden_truth
            write_pairs(path, pairs)
        files = sorted((tmp_path / name).glob("*.npz"))
        weights.append(train(files, tmp_path / f"{name}-out", replace(TINY, steps=4), SMALL))
    for one, other in zip(*(network.parameters() for network in weights), strict=True):
        assert torch.equal(one, other)


def test_hidden_pixels_teach_no_confidence(tmp_path):
    (path, _) = pair_files(tmp_path / "pairs", count=2)
    pairs = read_pairs(path)
    pairs.masks[:] = False
    write_pairs(path, pairs)
    files = sorted((tmp_path / "pairs").glob("*.npz"))
    rested = replace(TINY, steps=3, weight_decay=0.0)
    network = train(files, tmp_path / "out", rested, SMALL)
    torch.manual_seed(rested.seed)
    for one, other in zip(network.parameters(), DenoiserNetwork(SMALL).parameters(), strict=True):
        assert torch.equal(one, other)


def test_a_training_can_go_on_from_weights(tmp_path):
    pairs = pair_files(tmp_path / "pairs", count=2)
    save_network(network(seed=3), tmp_path / "start.safetensors", {})
    slow = replace(TINY, steps=1, rate=1e-9, weight_decay=0.0)
    on = train(pairs, tmp_path / "out", slow, SMALL, start=tmp_path / "start.safetensors")
    begun = load_network(tmp_path / "start.safetensors")
    for one, other in zip(on.parameters(), begun.parameters(), strict=True):
        assert torch.allclose(one, other, atol=1e-6)
    with pytest.raises(igsr.IgsrError, match="is of Architecture"):
        train(pairs, tmp_path / "out", slow, Architecture(8), start=tmp_path / "start.safetensors")


def test_crops_that_are_right_already_are_drawn_again(tmp_path):
    (path, _) = pair_files(tmp_path, count=2)
    made = read_pairs(path)
    inputs = made.inputs.copy()
    inputs[0, :COLOR] = made.truth[0]  # one of the two views is right everywhere
    training = replace(TINY, batch=64, augment=False)
    pairs = [Pairs(inputs, made.truth, made.masks)]
    batch = draw_batch(pairs, training, 0, range(64), torch.device("cpu"))
    drawn = (batch.inputs[:, :COLOR] - batch.truth).square().mean(dim=(1, 2, 3)) > RIGHT
    assert 0.85 < drawn.float().mean() < 1.0, "half to the power of four stays right"


def test_no_scene_of_validation_is_trained_on():
    def kept(*names):
        return kept_for_validation([f"{name}-seed0-cpu.npz" for name in names])

    assert kept("a-noise-0", "a-sparse-0", "b-noise-0", "b-sparse-0") == 2
    assert kept(*(f"{c}-sparse-0" for c in "abcdefghijklmnopqrst")) == 2
    assert kept("a-b-sparse-0", "a-sparse-0", "a-sparse-1", "a-sparse-2") == 3
    with pytest.warns(UserWarning, match="validation is of the scene that is trained on"):
        assert kept("a-leave-one-out-0", "a-leave-one-out-1", "a-leave-one-out-2") == 1
    assert capture_of_pairs("k.1-leave-one-out-3-seed0-cpu.npz") == "k.1"
    assert capture_of_pairs("mine.npz") == "mine.npz"


def test_processes_learn_one_network_and_one_discriminator(tmp_path):
    pair_files(tmp_path / "pairs")
    code = (
        "import os, sys\n"
        "from pathlib import Path\n"
        "from igsr.denoiser.architecture import Architecture\n"
        "from igsr_lab.denoiser import Training, train\n"
        "from igsr_lab.denoiser.learner import Learner\n"
        "folder, seen = sys.argv[1], []\n"
        "real = Learner.learn\n"
        "def learn(self, batch):\n"
        "    out = real(self, batch)\n"
        "    parts = (self.network, self.discriminator)\n"
        "    seen[:] = [p.detach().double().sum().item() for q in parts for p in q.parameters()]\n"
        "    return out\n"
        "Learner.learn = learn\n"
        "train(sorted(Path(folder, 'pairs').glob('*.npz')), Path(folder, 'out'),\n"
        "      Training(steps=3, batch=4, crop=32, loss='gan'), Architecture(4, (1, 1, 1)))\n"
        "Path(folder, os.environ['RANK']).write_text(repr(seen))\n"
    )
    (tmp_path / "learn.py").write_text(code)
    started = [sys.executable, "-m", "torch.distributed.run", "--standalone", "--nproc-per-node"]
    done = subprocess.run(
        [*started, "2", str(tmp_path / "learn.py"), str(tmp_path)],
        capture_output=True, text=True, timeout=300, env=os.environ | {"OMP_NUM_THREADS": "1"},
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    first, second = ((tmp_path / rank).read_text() for rank in "01")
    assert len(first) > 100
    assert first == second
    assert [row["step"] for row in log_of(tmp_path / "out")] == [1, 2, 3]


def test_a_batch_is_shared_evenly(tmp_path, monkeypatch):
    monkeypatch.setattr(Processes, "__init__", lambda self, device: vars(self).update(count=3))
    with pytest.raises(igsr.IgsrError, match="batch must be a multiple of the number of proc"):
        train(pair_files(tmp_path / "pairs"), tmp_path / "out", TINY, SMALL)


def test_training_needs_two_files_of_pairs(tmp_path):
    with pytest.raises(igsr.IgsrError, match="at least two files of pairs"):
        train(pair_files(tmp_path, count=1), tmp_path / "out", TINY, SMALL)


def test_a_training_has_checkpoints_on_its_way(tmp_path):
    train(pair_files(tmp_path / "pairs"), tmp_path, replace(TINY, steps=20), SMALL)
    validated = [row["step"] for row in log_of(tmp_path) if "validation_psnr" in row]
    assert validated == list(range(2, 21, 2))


def test_captures_are_kept_together_where_one_name_begins_with_another(tmp_path):
    pairs = pair_files(tmp_path / "all", count=5)
    named = []
    for path, name in zip(
        pairs,
        ("a-noise-0", "a-p2-noise-0", "a-p2-sparse-0", "a-sparse-0", "a-sparse-1"),
        strict=True,
    ):
        named.append(path.rename(tmp_path / f"{name}-seed0-cpu.npz"))
    train(named, tmp_path / "out", replace(TINY, steps=1), SMALL)
    about = torch.load(tmp_path / "out" / CHECKPOINT, weights_only=True)["about"]
    ends = [name.split("-seed")[0] for name in about["pairs"]]
    assert ends == ["a-noise-0", "a-sparse-0", "a-sparse-1", "a-p2-noise-0", "a-p2-sparse-0"]


def test_lpips_is_given_pictures_from_minus_one_to_one():
    class Network(torch.nn.Module):
        def forward(self, first, second):
            assert first.min() == second.max() == -1.0
            assert first.max() == 1.0
            return (first - second).abs().mean(dim=(1, 2, 3), keepdim=True)

    distance = _Lpips(Network(), "alex")
    first = torch.stack([torch.linspace(0.0, 1.0, 75).reshape(3, 5, 5), torch.zeros(3, 5, 5)])
    found = distance(first, torch.zeros(2, 3, 5, 5))
    assert found.tolist() == pytest.approx([1.0, 0.0])
    assert distance.name == "LPIPS v0.1 alex"


def test_the_feature_distance_grows_with_blur_and_carries_gradients(tmp_path):
    arrays = squeezenet_file(tmp_path / "s.npz")
    distance = SqueezeNetDistance(tmp_path / "s.npz")
    picture = torch.rand(2, 3, 48, 48)
    kernel = torch.ones(3, 1, 5, 5) / 25
    blurred = torch.nn.functional.conv2d(picture, kernel, padding=2, groups=3)
    slightly = 0.8 * picture + 0.2 * blurred
    assert (distance(picture, picture) == 0.0).all()
    assert (distance(picture, slightly) < distance(picture, blurred)).all()
    slightly.requires_grad_()
    distance(picture, slightly).sum().backward()
    assert slightly.grad.abs().sum() > 0.0
    with pytest.raises(igsr.IgsrError, match="pictures must be at least 32 pixels"):
        distance(picture[..., :20], picture[..., :20])

    del arrays["fire4/conv1x1_1.bias"]
    np.savez(tmp_path / "lacking.npz", **arrays)
    (tmp_path / "torn.npz").write_bytes((tmp_path / "s.npz").read_bytes()[:5000])
    np.save(tmp_path / "array", np.zeros(3))
    (tmp_path / "array.npy").rename(tmp_path / "array.npz")
    for name, message in (
        ("array", "is no whole .npz file"),
        ("lacking", "lacks .*fire4/conv1x1_1.bias"),
        ("torn", "is no whole .npz file"),
        ("none", "does not exist"),
    ):
        with pytest.raises(igsr.IgsrError, match=message):
            SqueezeNetDistance(tmp_path / f"{name}.npz")


def test_a_single_validation_shows_in_the_plot(tmp_path, monkeypatch):
    lines = {}

    def kept(figure, file, **_):
        for line in (line for axis in figure.axes for line in axis.lines):
            lines[line.get_label()] = line
        file.write(b"png") if hasattr(file, "write") else Path(file).write_bytes(b"png")

    monkeypatch.setattr("matplotlib.figure.Figure.savefig", kept)
    rows = [{"step": 100, "squared": -0.1}, {"step": 200, "squared": -0.2, "validation_psnr": 20.0}]
    (tmp_path / "log.jsonl").write_text("\n".join(json.dumps(row) for row in rows))
    assert plot_training(tmp_path / "log.jsonl", tmp_path / "loss.png") == rows
    assert lines["validation psnr"].get_marker() == "o"
    assert lines["squared"].get_marker() in ("", "None", None)
    assert lines["squared"].get_linestyle() == "-"


def test_training_and_validation_have_one_axis(tmp_path, monkeypatch):
    seen = []

    def kept(figure, file, **_):
        seen.extend({line.get_label() for line in axis.lines} for axis in figure.axes)
        Path(file).write_bytes(b"png")

    monkeypatch.setattr("matplotlib.figure.Figure.savefig", kept)
    row = {"step": 1, "perceptual": 0.3, "validation_perceptual": 0.4}
    (tmp_path / "log.jsonl").write_text(json.dumps(row | {"validation_perceptual_before": 0.5}))
    plot_training(tmp_path / "log.jsonl", tmp_path / "loss.png")
    assert seen == [{"perceptual", "validation perceptual", "validation perceptual before"}]
    (tmp_path / "log.jsonl").write_text("")
    with pytest.raises(igsr.IgsrError, match="holds nothing to plot"):
        plot_training(tmp_path / "log.jsonl", tmp_path / "loss.png")


def test_a_training_that_never_logs_is_refused(tmp_path):
    for name in ("log_every", "checkpoint_every"):
        with pytest.raises(igsr.IgsrError, match="must be at least 1"):
            train(pair_files(tmp_path / "pairs"), tmp_path / "out", TINY, SMALL, **{name: 0})
