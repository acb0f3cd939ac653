"""Work on a Ray cluster: errors of Ray, of the cluster and of its machines; lost work."""

from __future__ import annotations

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


def test_a_missing_or_unsupported_ray_is_named(ray, monkeypatch):
    for version in ("2.39.0", "3.0.1", "none"):
        monkeypatch.setattr(ray, "__version__", version)
        with pytest.raises(igsr.IgsrError, match=rf"Ray {version} is installed, and igsr needs"):
            RayCluster().__enter__()
    monkeypatch.setitem(sys.modules, "ray", None)
    with pytest.raises(igsr.IgsrError, match=r"install it with: pip install 'igsr\[ray\]'"):
        RayCluster().__enter__()


@pytest.mark.parametrize(
    ("error", "reason"),
    [
        (ConnectionError("Could not find any running Ray instance.\nMore."), "Could not find any"),
        (RuntimeError("Version mismatch: The cluster was started with:\n Ray: 2.1"), "Version mis"),
    ],
)
def test_a_cluster_that_cannot_be_joined_is_named(ray, error, reason):
    ray.refuses = error
    with pytest.raises(igsr.IgsrError, match=f"Ray cluster at auto: {reason}"):
        RayCluster("auto").__enter__()
    assert ray.addresses == ["auto"]


def test_an_address_without_a_listener_is_refused_at_once(ray):
    with pytest.raises(igsr.IgsrError, match=r"Ray cluster at 127\.0\.0\.1:9: .*refused"):
        RayCluster("127.0.0.1:9").__enter__()
    assert ray.addresses == []


@pytest.mark.parametrize(
    ("answer", "message"),
    [
        (("far", "0.0.1", "AVX2", True), "far of the Ray cluster has igsr 0.0.1 where this one"),
        (("far", igsr.__version__, "AVX2", False, "1"), "far of the Ray cluster does not see"),
        (None, "head of the Ray cluster cannot run igsr .No module named 'igsr'.; install igsr"),
    ],
)
def test_an_unsuitable_machine_is_named(ray, monkeypatch, tmp_path, answer, message):
    def what_it_is(folder):
        if answer is None:
            raise ModuleNotFoundError("No module named 'igsr'")
        return answer

    monkeypatch.setattr(ray_jobs, "_what_it_is", what_it_is)
    with RayCluster() as cluster, pytest.raises(igsr.IgsrError, match=message):
        cluster.check(tmp_path)
    assert not ray.running


def test_a_machine_that_went_away_is_not_counted(ray, tmp_path):
    ray.listed = ["head", "gone"]
    with RayCluster() as cluster:
        assert [node.igsr for node in cluster.check(tmp_path)] == [igsr.__version__]
        assert cluster.nodes == cluster.check(tmp_path)


def test_lost_work_is_repeated_or_returned_as_an_error(ray):
    begun = []

    def work(data, piece):
        begun.append(piece)
        if piece in ("large", "larger"):
            raise ray.exceptions.OutOfMemoryError
        if piece == "broken":
            raise ValueError("a bug")
        return f"{data} {piece}"

    def again(number, error):
        assert isinstance(error, WorkerLostError)
        return "small" if number == 1 else None

    pieces = ["fine", "large", "larger", "broken"]
    with RayCluster() as cluster:
        memory = [None, 5, 10**12, 0]
        results = dict(cluster.results(work, "do", pieces, again=again, memory=memory))
    assert (results[0], results[1]) == ("do fine", "do small")
    assert isinstance(results[2], WorkerLostError)
    assert isinstance(results[3], RuntimeError)
    assert sorted(begun) == ["broken", "fine", "large", "larger", "small"]


def test_a_piece_takes_its_share_of_a_machine(ray):
    with RayCluster() as cluster:
        list(cluster.results(lambda data, piece: piece, "", [1], spread=True))
        list(cluster.results(lambda data, piece: piece, "", [1, 2, 3], spread=True))
    assert [cores for cores, _ in ray.environments] == [2, 1]
