"""GPUs that fail: "auto" warns and uses the CPU; a fit ends with one message and its checkpoint."""

import re
import warnings

import pytest
import scenes

from igsr import _core

pytestmark = pytest.mark.usefixtures("no_faults_after")


@pytest.fixture
def no_faults_after(monkeypatch, tmp_path_factory):
    """Open new devices for each test, whose verdicts are in a folder of these tests."""
    monkeypatch.setenv("IGSR_GPU_CACHE", str(tmp_path_factory.getbasetemp() / "verdicts"))
    yield
    _core.inject_gpu_faults([])


@pytest.mark.parametrize(
    ("fault", "message"),
    [
        ("shader", "Shader"),
        ("values", "computes wrong values: rasterize is off by"),
        ("limits", "max_storage_buffers_per_shader_stage is 4, but igsr needs 8"),
    ],
)
def test_auto_warns_once_and_uses_the_cpu(fault, message):
    _core.inject_gpu_faults(["real", fault])
    with pytest.warns(UserWarning, match=message) as caught:
        assert _core.resolve_backend("auto") == "cpu"
    assert str(caught[0].message).endswith("The CPU computes instead")
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert _core.resolve_backend("auto") == "cpu"
    with pytest.raises(RuntimeError, match=message):
        _core.resolve_backend("gpu")


def test_plain_kernels_replace_kernels_for_gpus_that_fail():
    _core.inject_gpu_faults(["real", "blocks"])
    with pytest.warns(UserWarning, match="computes wrong values: rasterize") as caught:
        assert _core.resolve_backend("auto") == "gpu"
    assert str(caught[0].message).endswith("Slower kernels, which pass, are used instead")
    kernels = _core.backend_info("gpu")["instruction_set"]
    assert kernels == "WGSL for software drivers, because that for GPUs fails here"


@pytest.mark.filterwarnings("error")
def test_a_software_adapter_gives_no_warning():
    _core.inject_gpu_faults([])
    assert _core.resolve_backend("auto") in ("cpu", "gpu")


def test_verdicts_are_kept_for_sound_devices_only(monkeypatch, tmp_path):
    folder = tmp_path / "verdicts"
    monkeypatch.setenv("IGSR_GPU_CACHE", str(folder))

    def check_faulty():
        _core.inject_gpu_faults(["real", "values"])
        with pytest.warns(UserWarning, match="computes wrong values"):
            _core.resolve_backend("auto")

    check_faulty()
    assert not folder.exists()
    _core.inject_gpu_faults([])
    _core.resolve_backend("gpu")
    (verdict,) = folder.iterdir()
    assert verdict.suffix == ".passed"
    assert "passed" in verdict.read_text()
    check_faulty()


def test_a_fit_whose_device_is_lost_resumes_with_the_same_bits(tmp_path):
    capture, path = scenes.capture(views=4), tmp_path / "checkpoint.npz"
    options = {"steps": 1200, "backend": "gpu"}

    def lose(event):
        if event.done >= 600:
            _core.lose_gpu()

    with pytest.raises(RuntimeError, match="was lost") as caught:
        scenes.fit(capture, checkpoint=path, report=lose, **options)
    assert re.search(rf"{re.escape(str(path))} has step [1-9]\d\d, and resume", str(caught.value))
    resumed = scenes.fit(capture, checkpoint=path, resume=True, **options)
    assert resumed == scenes.fit(capture, **options)


def test_a_fit_out_of_memory_is_one_message_and_a_smaller_one_works():
    _core.inject_gpu_faults(["memory"])
    capture = scenes.capture(views=4)
    with pytest.raises(RuntimeError, match="is out of memory; use fewer splats"):
        scenes.fit(capture, steps=2000, backend="gpu", max_splats=200_000)
    assert len(scenes.fit(capture, steps=20, backend="gpu", max_splats=100)) > 0
