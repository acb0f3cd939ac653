"""Training of the denoiser: losses, crops, pairs, the training itself, its plot."""

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
from igsr_lab.denoiser import losses, pair_files
from igsr_lab.denoiser.crops import MIN_ERROR, draw_batch
from igsr_lab.denoiser.learner import Processes
from igsr_lab.denoiser.losses import LOSSES, Loss, Prediction
from igsr_lab.denoiser.pair_files import Pairs, read_pairs, write_pairs
from igsr_lab.denoiser.perceptual_distance import SqueezeNetDistance, _Lpips, lpips_distance
from igsr_lab.denoiser.train_network import CHECKPOINT, LOG, WEIGHTS, plot_training, train
from igsr_lab.denoiser.training_settings import Training

SMALL = Architecture(width=4, blocks=(1, 1, 1))
TINY = Training(steps=60, batch=4, crop=32, rate=5e-3)


def random_network(architecture=SMALL, seed=0):
    """A network that is not the identity."""
    torch.manual_seed(seed)
    made = DenoiserNetwork(architecture).eval()
    with torch.no_grad():
        for parameter in made.parameters():
            parameter.copy_(0.3 * torch.randn_like(parameter))
    return made


def prediction(image, truth, render=None, log_error=-3.0):
    render = torch.zeros_like(image) if render is None else render
    return Prediction(render, image, torch.full_like(image[:, :1], log_error), truth)


def mean_distance(first, second):
    return (first - second).abs().mean(dim=(1, 2, 3))


def equal_weights(first, second):
    pairs = zip(first.parameters(), second.parameters(), strict=True)
    return all(torch.equal(one, other) for one, other in pairs)


def test_regret_counts_only_errors_that_grow():
    truth = torch.full((1, 3, 2, 2), 0.5)
    render = truth + 0.1
    assert losses.regret(prediction(truth + 0.05, truth, render)) == 0.0
    assert losses.regret(prediction(truth - 0.3, truth, render)).item() == pytest.approx(0.2)


def test_a_decibel_counts_the_same_in_good_and_bad_pictures():
    truth = torch.full((2, 3, 8, 8), 0.5)
    off = torch.tensor([0.3, 0.1]).reshape(2, 1, 1, 1)
    gained = 10.0 ** (-1.0 / 20.0)

    def ratio(image, truth, render):
        return losses.squared_ratio(prediction(image, truth, render)).item()

    both = ratio(truth + gained * off, truth, truth + off)
    assert both == pytest.approx(-0.23, abs=0.003)
    bad = ratio(truth[:1] + gained * 0.3, truth[:1], truth[:1] + 0.3)
    assert bad == pytest.approx(both, rel=0.02)
    assert 0.0 < ratio(truth + 1e-3, truth, truth) < 0.02


def test_smoothing_costs_structure():
    random = torch.Generator().manual_seed(0)
    truth = torch.rand(2, 3, 24, 24, generator=random)
    render = (truth + 0.2 * torch.randn(truth.shape, generator=random)).clamp(0.0, 1.0)
    blurred = torch.nn.functional.avg_pool2d(render, 3, 1, 1)

    def ratio(image, truth=truth, render=render):
        return losses.structure_ratio(prediction(image, truth, render)).item()

    assert ratio(render) == 0.0
    assert ratio(0.5 * (render + truth)) < -0.5
    assert ratio(blurred) > 0.1
    assert ratio(*[truth[..., :8, :8]] * 3) == 0.0


def test_the_perceptual_ratio_uses_some_pictures_of_a_batch():
    truth = torch.full((4, 3, 8, 8), 0.5)
    image = truth.clone()
    image[:2] += 0.1
    image[2:] += 10.0
    image.requires_grad_()
    given = Prediction(truth + 0.2, image, image[:, :1], truth)
    value = losses.perceptual_ratio(given, mean_distance)
    assert value.item() == pytest.approx(np.log(0.11 / 0.21), rel=1e-4)
    value.backward()
    assert image.grad[:2].abs().sum() > 0.0
    assert image.grad[2:].abs().sum() == 0.0


def test_the_likelihood_is_best_at_the_true_error_and_does_not_reach_the_picture():
    truth = torch.zeros(1, 3, 4, 4)
    image = torch.full_like(truth, 0.1, requires_grad=True)
    values = {
        log: losses.error_likelihood(prediction(image, truth, log_error=log)).item()
        for log in (-4.0, float(np.log(0.1)), -1.0)
    }
    assert min(values, key=values.get) == float(np.log(0.1))
    log_error = torch.full((1, 1, 4, 4), -3.0, requires_grad=True)
    losses.error_likelihood(Prediction(truth, image, log_error, truth)).backward()
    assert image.grad is None
    assert log_error.grad.abs().sum() > 0.0


@pytest.mark.parametrize("name", LOSSES)
def test_every_loss_has_its_parts_and_gradients(name):
    loss = Loss(name, mean_distance, a=0.25)
    network = random_network()
    inputs, truth = torch.rand(1, CHANNELS, 32, 32), torch.rand(1, 3, 32, 32)
    image, log_error = network(inputs)
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
        weighted = 0.75 * parts["gan"] + 0.25 * parts["perceptual"] + 0.1 * parts["likelihood"]
        assert total.item() == pytest.approx(weighted, rel=1e-5)
    total.backward()
    assert network.tail.weight.grad.abs().sum() > 0.0


def test_the_discriminator_sees_clamped_colors():
    torch.manual_seed(0)
    loss, render = Loss("gan", None), torch.full((1, 3, 32, 32), 0.5)
    bright = [prediction(torch.full_like(render, value), render, render) for value in (1.0, 3.0)]
    values = [(loss(one)[1]["gan"], loss.discriminator.loss(one).item()) for one in bright]
    assert values[0] == values[1]


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: Loss("mse", None), "loss must be one of default, charbonnier, gan"),
        (lambda: Loss("lpips", None), "loss lpips needs a perceptual distance"),
        (lambda: Loss("gan+lpips", mean_distance, a=1.5), "a must be from 0 to 1"),
        (lambda: lpips_distance("resnet"), "backbone must be one of alex, vgg, squeeze"),
        (lambda: Training(crop=30), "crop must be a multiple of 8"),
        (lambda: Training(loss="mse"), "loss must be one of default, charbonnier, gan"),
        (lambda: Training(seed=2**60), "seed must be from 0 to"),
    ],
)
def test_invalid_settings_are_refused(make, message):
    with pytest.raises(igsr.IgsrError, match=message):
        make()


def made_pairs(folder, count=3, size=40):
    """Smooth photos, and renders with coarse noise."""
    random = np.random.default_rng(0)
    paths = []
    for k in range(count):
        y, x = np.mgrid[:size, :size] / size
        truth = np.stack([np.sin(4 * x + k), np.cos(5 * y), np.sin(3 * (x + y))]) * 0.4 + 0.5
        inputs = np.zeros((2, CHANNELS, size, size), np.uint8)
        noise = random.normal(scale=0.1, size=(2, 3, size // 4, size // 4))
        inputs[:, :3] = np.clip(255 * (truth + noise.repeat(4, 2).repeat(4, 3)), 0, 255)
        whole = np.repeat((255 * truth).astype(np.uint8)[None], 2, 0)
        write_pairs(folder / f"{k}.npz", Pairs(inputs, whole, np.ones((2, size, size), np.bool_)))
        paths.append(folder / f"{k}.npz")
    return paths


def log_of(out):
    return [json.loads(line) for line in (out / LOG).read_text().splitlines()]


def test_training_improves_validation_and_has_ten_checkpoints(tmp_path):
    training = replace(TINY, steps=150)
    pairs = made_pairs(tmp_path / "pairs")
    train(pairs, tmp_path, training, Architecture(8, (1, 1, 1)), log_every=50)
    rows = log_of(tmp_path)
    assert [row["step"] for row in rows] == sorted({*range(15, 151, 15), 50, 100})
    assert [row["step"] for row in rows if "validation_psnr" in row] == [*range(15, 151, 15)]
    assert rows[-1]["validation_psnr"] > rows[-1]["validation_psnr_before"] + 0.2
    assert load_network(tmp_path / WEIGHTS).architecture == Architecture(8, (1, 1, 1))


@pytest.mark.parametrize("loss", ["default", "gan"])
def test_a_resumed_training_ends_with_the_same_weights(tmp_path, loss):
    pairs = made_pairs(tmp_path / "pairs")
    training = replace(TINY, steps=12, loss=loss, dropout=0.2)
    every = {"log_every": 4, "checkpoint_every": 4}

    class Stop(Exception):
        pass

    def stop(event):
        assert event.total == 12
        if event.done == 8:
            raise Stop

    whole = train(pairs, tmp_path / "a", training, SMALL, **every)
    other = train(pairs, tmp_path / "c", replace(training, seed=1), SMALL, **every)
    assert not equal_weights(whole, other)
    out = tmp_path / "b"
    with pytest.raises(Stop):
        train(pairs, out, training, SMALL, **every, progress=stop)
    with pytest.raises(igsr.IgsrError, match="is of an earlier training; continue it by --resume"):
        train(pairs, out, training, SMALL)
    assert equal_weights(whole, train(pairs, out, training, SMALL, **every, resume=True))

    # Rows after the checkpoint are written once; incomplete ones are removed.
    assert [row["step"] for row in log_of(out)] == [4, 8, 12]
    with (out / LOG).open("a") as file:
        file.write('{"step": 13}\n{"ste')
    train(pairs, out, training, SMALL, **every, resume=True)
    assert [row["step"] for row in log_of(out)] == [4, 8, 12]

    darker = made_pairs(tmp_path / "darker")
    content = read_pairs(darker[0])
    write_pairs(darker[0], replace(content, truth=content.truth // 2))
    for files, settings, distance in (
        (pairs, replace(training, rate=1e-4), None),
        (pairs, training, mean_distance),
        (darker, training, None),
    ):
        with pytest.raises(igsr.IgsrError, match="is of a training with other data or settings"):
            train(files, out, settings, SMALL, resume=True, distance=distance)
    (out / CHECKPOINT).write_bytes((out / CHECKPOINT).read_bytes()[:999])
    with pytest.raises(igsr.IgsrError, match=r"checkpoint\.pt is damaged"):
        train(pairs, out, training, SMALL, resume=True)


def test_hidden_pixels_do_not_influence_training(tmp_path):
    weights = []
    for name, hidden_truth in (("a", 0), ("b", 255)):
        files = made_pairs(tmp_path / name, count=2)
        for path in files:
            pairs = read_pairs(path)
            pairs.masks[:, :20] = False
            pairs.truth[:, :, :20] = hidden_truth
            write_pairs(path, pairs)
        weights.append(train(files, tmp_path / f"{name}-out", replace(TINY, steps=4), SMALL))
    assert equal_weights(*weights)

    pairs.masks[:] = False
    write_pairs(files[0], pairs)
    rested = replace(TINY, steps=3, weight_decay=0.0)
    network = train(files, tmp_path / "out", rested, SMALL)
    torch.manual_seed(rested.seed)
    assert equal_weights(network, DenoiserNetwork(SMALL))


def test_training_can_start_from_weights(tmp_path):
    pairs, start = made_pairs(tmp_path / "pairs", count=2), tmp_path / "start.safetensors"
    save_network(random_network(seed=3), start, {})
    slow = replace(TINY, steps=1, rate=1e-9, weight_decay=0.0)
    trained = train(pairs, tmp_path / "out", slow, SMALL, start=start)
    for one, other in zip(trained.parameters(), load_network(start).parameters(), strict=True):
        assert torch.allclose(one, other, atol=1e-6)
    with pytest.raises(igsr.IgsrError, match="is of Architecture"):
        train(pairs, tmp_path / "out", slow, Architecture(8), start=start)


def test_crops_without_errors_are_drawn_again(tmp_path):
    (path, _) = made_pairs(tmp_path, count=2)
    made = read_pairs(path)
    inputs = made.inputs.copy()
    inputs[0, :COLOR] = made.truth[0]  # one of the two views has no errors
    training = replace(TINY, batch=64, augment=False)
    pairs = [Pairs(inputs, made.truth, made.masks)]
    batch = draw_batch(pairs, training, 0, range(64), torch.device("cpu"))
    drawn = (batch.inputs[:, :COLOR] - batch.truth).square().mean(dim=(1, 2, 3)) > MIN_ERROR
    assert 0.85 < drawn.float().mean() < 1.0, "all except a sixteenth"


def test_no_capture_is_in_both_sets(tmp_path):
    def kept(*names):
        return pair_files.validation_count([f"{name}-seed0-cpu.npz" for name in names])

    assert kept("a-noise-0", "a-sparse-0", "b-noise-0", "b-sparse-0") == 2
    assert kept(*(f"{c}-sparse-0" for c in "abcdefghijklmnopqrst")) == 2
    assert kept("a-b-sparse-0", "a-sparse-0", "a-sparse-1", "a-sparse-2") == 3
    with pytest.warns(UserWarning, match="validation uses the scene that is trained on"):
        assert kept("a-leave-one-out-0", "a-leave-one-out-1", "a-leave-one-out-2") == 1
    assert pair_files.capture_of_pairs("k.1-leave-one-out-3-seed0-cpu.npz") == "k.1"
    assert pair_files.capture_of_pairs("mine.npz") == "mine.npz"

    # The name of a capture begins with the name of another capture.
    names = ("a-noise-0", "a-p2-noise-0", "a-p2-sparse-0", "a-sparse-0", "a-sparse-1")
    files = zip(made_pairs(tmp_path / "all", count=5), names, strict=True)
    named = [path.rename(tmp_path / f"{name}-seed0-cpu.npz") for path, name in files]
    train(named, tmp_path / "out", replace(TINY, steps=1), SMALL)
    about = torch.load(tmp_path / "out" / CHECKPOINT, weights_only=True)["about"]
    ends = [name.split("-seed")[0] for name in about["pairs"]]
    assert ends == ["a-noise-0", "a-sparse-0", "a-sparse-1", "a-p2-noise-0", "a-p2-sparse-0"]


SEVERAL = """
import os, sys
from pathlib import Path
from igsr.denoiser.architecture import Architecture
from igsr_lab.denoiser.learner import Learner
from igsr_lab.denoiser.train_network import train
from igsr_lab.denoiser.training_settings import Training

folder, seen = sys.argv[1], []
real = Learner.learn
def learn(self, batch):
    out = real(self, batch)
    parts = (self.network, self.discriminator)
    seen[:] = [p.detach().double().sum().item() for q in parts for p in q.parameters()]
    return out
Learner.learn = learn
train(sorted(Path(folder, 'pairs').glob('*.npz')), Path(folder, 'out'),
      Training(steps=3, batch=4, crop=32, loss='gan'), Architecture(4, (1, 1, 1)))
Path(folder, os.environ['RANK']).write_text(repr(seen))
"""


def test_processes_train_one_network_and_one_discriminator(tmp_path):
    made_pairs(tmp_path / "pairs")
    (tmp_path / "learn.py").write_text(SEVERAL)
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


def test_bad_arguments_are_refused(tmp_path, monkeypatch):
    pairs = made_pairs(tmp_path, 2)
    for count, options, message in (
        (1, {}, "at least two files of pairs"),
        (2, {"log_every": 0}, "must be at least 1"),
        (2, {"checkpoint_every": 0}, "must be at least 1"),
    ):
        with pytest.raises(igsr.IgsrError, match=message):
            train(pairs[:count], tmp_path / "out", TINY, SMALL, **options)
    monkeypatch.setenv("WORLD_SIZE", "3")
    monkeypatch.setattr("torch.distributed.init_process_group", lambda backend: None)
    with pytest.raises(igsr.IgsrError, match="batch must be a multiple of the number of proc"):
        Processes("cpu").share_of(4)


def test_lpips_gets_pictures_from_minus_one_to_one():
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


def test_the_feature_distance_grows_with_blur_and_is_differentiable(tmp_path):
    squeezenet_file(tmp_path / "s.npz")
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


def test_files_without_squeezenet_are_refused(tmp_path):
    arrays = squeezenet_file(tmp_path / "s.npz")
    del arrays["fire4/conv1x1_1.bias"]
    np.savez(tmp_path / "lacking.npz", **arrays)
    (tmp_path / "torn.npz").write_bytes((tmp_path / "s.npz").read_bytes()[:5000])
    for name, message in (
        ("lacking", "lacks .*fire4/conv1x1_1.bias"),
        ("torn", "is a damaged .npz file"),
        ("none", "does not exist"),
    ):
        with pytest.raises(igsr.IgsrError, match=message):
            SqueezeNetDistance(tmp_path / f"{name}.npz")


def test_the_plot_has_an_axis_per_quantity(tmp_path, monkeypatch):
    axes = []

    def kept(figure, file, **_):
        axes.extend({line.get_label(): line for line in axis.lines} for axis in figure.axes)
        Path(file).write_bytes(b"png")

    monkeypatch.setattr("matplotlib.figure.Figure.savefig", kept)
    log, plot = tmp_path / "log.jsonl", tmp_path / "loss.png"
    rows = [
        {"step": 100, "squared": -0.1, "perceptual": 0.3},
        {"step": 200, "squared": -0.2, "perceptual": 0.2, "validation_psnr": 20.0},
    ]
    rows[1] |= {"validation_perceptual": 0.4, "validation_perceptual_before": 0.5}
    log.write_text("\n".join(json.dumps(row) for row in rows))
    assert plot_training(log, plot) == rows
    squared, perceptual, psnr = axes
    assert squared["squared"].get_linestyle() == "-"
    assert squared["squared"].get_marker() in ("", "None", None)
    names = {"perceptual", "validation perceptual", "validation perceptual before"}
    assert set(perceptual) == names, "validation shares the axis"
    assert psnr["validation psnr"].get_marker() == "o", "a single point has no line"
    log.write_text("")
    with pytest.raises(igsr.IgsrError, match="holds nothing to plot"):
        plot_training(log, plot)
