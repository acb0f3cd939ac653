"""A GPU that fails: "auto" warns and takes the CPU; a fit ends in one message, its file kept."""

from __future__ import annotations

import re
import warnings

import numpy as np
import pytest
from scenes import capture as made_up_capture

import igsr
from igsr import _core

pytestmark = pytest.mark.usefixtures("faults_end")


@pytest.fixture(scope="module")
def verdicts(tmp_path_factory):
    """A folder of verdicts that only these tests write to."""
    return tmp_path_factory.mktemp("verdicts")


@pytest.fixture
def faults_end(monkeypatch, verdicts):
    """Every test opens devices of its own."""
    monkeypatch.setenv("IGSR_GPU_CACHE", str(verdicts))
    yield
    _core.inject_gpu_faults([])


@pytest.mark.parametrize(
    ("fault", "words"),
    [
        ("shader", "Shader"),
        ("values", "computes wrong values: rasterize is off by"),
        ("limits", "max_storage_buffers_per_shader_stage is 4, but igsr needs 8"),
    ],
)
def test_auto_warns_once_and_takes_the_cpu(fault, words):
    _core.inject_gpu_faults(["real", fault])
    with pytest.warns(UserWarning, match=words) as caught:
        assert _core.resolve_backend("auto") == "cpu"
    message = str(caught[0].message)
    name = message.removeprefix("backend gpu: ").split(" (")[0]
    assert name in message
    assert message.endswith("The CPU computes instead")
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert _core.resolve_backend("auto") == "cpu"
    with pytest.raises(RuntimeError, match=words):
        _core.resolve_backend("gpu")


def test_a_software_adapter_is_no_reason_for_a_warning():
    _core.inject_gpu_faults([])
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert _core.resolve_backend("auto") in ("cpu", "gpu")


def test_the_verdict_is_remembered_for_sound_devices_alone(monkeypatch, tmp_path):
    monkeypatch.setenv("IGSR_GPU_CACHE", str(tmp_path / "verdicts"))
    _core.inject_gpu_faults(["real", "values"])
    with pytest.warns(UserWarning, match="computes wrong values"):
        _core.resolve_backend("auto")
    assert not (tmp_path / "verdicts").exists()
    _core.inject_gpu_faults([])
    _core.resolve_backend("gpu")
    (verdict,) = (tmp_path / "verdicts").iterdir()
    assert verdict.suffix == ".passed"
    assert "passed" in verdict.read_text()
    # A verdict on this driver does not speak for a device that is found out to fail.
    _core.inject_gpu_faults(["real", "values"])
    with pytest.warns(UserWarning, match="computes wrong values"):
        _core.resolve_backend("auto")


def test_a_device_lost_in_mid_fit_keeps_the_checkpoint_and_the_next_call_works(tmp_path):
    capture = made_up_capture(views=4)
    checkpoint = tmp_path / "checkpoint.npz"
    settings = {"steps": 1200, "seed": 0, "backend": "gpu", "checkpoint": checkpoint}

    def lose(now):
        if now.step >= 600:
            _core.lose_gpu()

    with pytest.raises(RuntimeError, match="was lost") as caught:
        igsr.fit(capture, **settings, progress=lose)
    assert re.search(rf"{re.escape(str(checkpoint))} keeps step [1-9]\d\d", str(caught.value))
    resumed = igsr.fit(capture, **settings, resume=True)
    whole = igsr.fit(capture, **{**settings, "checkpoint": None})
    np.testing.assert_array_equal(resumed.means, whole.means)


def test_out_of_memory_in_a_fit_is_one_message_and_a_smaller_call_works():
    _core.inject_gpu_faults(["memory"])
    capture = made_up_capture(views=4)
    with pytest.raises(RuntimeError, match="is out of memory; use fewer splats"):
        igsr.fit(capture, steps=2000, seed=0, backend="gpu", max_splats=200_000)
    splats = igsr.fit(capture, steps=20, seed=0, backend="gpu", max_splats=100)
    assert len(splats) > 0
