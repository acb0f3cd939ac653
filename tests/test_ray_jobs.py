"""Work over Ray: messages if Ray, a cluster or a machine cannot be used."""

import socket
import sys

import pytest
from ray_stand_in import stand_in_ray

import igsr
from igsr._internal import ray_jobs
from igsr._internal.ray_jobs import RayCluster
from igsr._internal.worker_processes import WorkerLostError


@pytest.fixture
def ray(monkeypatch):
    return stand_in_ray(monkeypatch)


def test_ray_that_is_missing_or_of_another_version_is_named(ray, monkeypatch):
    for version in ("2.39.0", "3.0.1", "none"):
        monkeypatch.setattr(ray, "__version__", version)
        with pytest.raises(igsr.IgsrError, match=rf"Ray {version} is installed, and igsr needs"):
            RayCluster().__enter__()
    monkeypatch.setitem(sys.modules, "ray", None)
    with pytest.raises(igsr.IgsrError, match=r"install it with: pip install 'igsr\[ray\]'"):
        RayCluster().__enter__()


def test_a_cluster_that_cannot_be_joined_is_named(ray):
    # No head answers at this address, so Ray is not asked.
    with pytest.raises(igsr.IgsrError, match=r"Ray cluster at 127\.0\.0\.1:9: .*refused"):
        RayCluster("127.0.0.1:9").__enter__()
    assert ray.addresses == []
    for error in (
        ConnectionError("Could not find any running Ray instance.\nMore."),
        RuntimeError("Version mismatch: The cluster was started with:\n Ray: 2.1"),
    ):
        ray.refuses = error
        with pytest.raises(igsr.IgsrError, match=f"Ray cluster at auto: {str(error)[:18]}"):
            RayCluster("auto").__enter__()
    assert ray.addresses == ["auto", "auto"]


@pytest.mark.parametrize(
    ("answer", "message"),
    [
        (("1", "far", "0.0.1", True), "far of the Ray cluster has igsr 0.0.1, but this one"),
        (("1", "far", igsr.__version__, False), "far of the Ray cluster does not see"),
        (None, "head of the Ray cluster cannot run igsr .No module named 'igsr'.; install igsr"),
    ],
)
def test_a_machine_that_cannot_do_the_work_is_named(ray, monkeypatch, tmp_path, answer, message):
    def describe_node(folder):
        if answer is None:
            raise ModuleNotFoundError("No module named 'igsr'")
        return answer

    monkeypatch.setattr(ray_jobs, "_describe_node", describe_node)
    with RayCluster() as cluster, pytest.raises(igsr.IgsrError, match=message):
        cluster.check(tmp_path)
    assert not ray.running


def test_a_machine_that_went_away_is_not_counted(ray, tmp_path):
    ray.listed = ["head", "gone"]
    with RayCluster() as cluster:
        assert cluster.check(tmp_path) == [socket.gethostname()]


def test_lost_work_is_retried(ray):
    begun, results = [], {}

    def work(piece):
        begun.append(piece)
        if piece == "large":
            raise ray.exceptions.OutOfMemoryError
        if piece == "larger":
            raise MemoryError
        return f"did {piece}"

    def retry(piece, error):
        assert isinstance(error, WorkerLostError if piece == "large" else MemoryError)
        return f"less of {piece}"

    memory = {"fine": None, "large": 5, "larger": 10**12}
    with RayCluster() as cluster:
        cluster.run(work, [*memory], results.__setitem__, memory=memory.get, retry=retry)
    smaller = ["less of large", "less of larger"]
    assert results == {piece: f"did {piece}" for piece in ["fine", *smaller]}
    assert sorted(begun) == [*memory, *smaller]


@pytest.mark.parametrize(
    ("raised", "expected"), [("OutOfMemoryError", WorkerLostError), (None, RuntimeError)]
)
def test_a_failed_piece_does_not_stop_the_others(ray, raised, expected):
    results = {}

    def work(piece):
        if piece == 2:
            raise ValueError("a bug") if raised is None else getattr(ray.exceptions, raised)
        return piece

    with RayCluster() as cluster, pytest.raises(expected):
        cluster.run(work, [1, 2, 3], results.__setitem__)
    assert results == {1: 1, 3: 3}


def test_a_piece_takes_its_share_of_a_machine(ray):
    for pieces in ([1], [1, 2, 3]):
        with RayCluster() as cluster:
            cluster.run(str, pieces, lambda piece, result: None, spread=True)
    assert [cores for cores, _ in ray.environments] == [2, 1]
