"""Blocks over a real Ray cluster of three nodes; one is killed during the fit."""

import json
import threading
import time
from dataclasses import replace

import pytest

import igsr
from igsr._internal.ray_jobs import RayCluster
from igsr.blocks import BlockOptions, fit_in_blocks
from igsr_lab.large_scenes import towns

pytestmark = pytest.mark.long

#: Long enough for all nodes to work at the same time, and to kill one well before its block ends.
SETTINGS = {"steps": 4000, "max_splats": 2000}
STORE = 80 * 2**20


@pytest.fixture(scope="module")
def cluster():
    import ray
    from ray.cluster_utils import Cluster

    head = {"num_cpus": 1, "object_store_memory": STORE, "include_dashboard": False}
    cluster = Cluster(initialize_head=True, head_node_args=head)
    for _ in range(2):
        cluster.add_node(num_cpus=1, object_store_memory=STORE)
    yield cluster
    ray.shutdown()
    cluster.shutdown()


def progress_of_blocks(out):
    """The progress of each block that is being fitted."""
    found = {}
    for path in (out / "blocks").glob("block-*/progress.json"):
        try:
            found[path.parent.name] = json.loads(path.read_text())
        except (OSError, ValueError):
            continue
    return found


def test_a_killed_node_changes_no_bits(cluster, tmp_path):
    folder = towns.written(towns.town(2, 2, 8, 64, 48, points=150, sharp=1), tmp_path / "town")
    options = BlockOptions(blocks=4, holdout=8, settings=SETTINGS)
    whole, _ = fit_in_blocks(folder, tmp_path / "whole", options)

    out, failures = tmp_path / "out", []

    def kill():
        """Wait until blocks run on all three nodes, and kill one without the driver."""
        deadline = time.monotonic() + 300.0
        early = SETTINGS["steps"] // 2
        while sum(0 < one["step"] < early for one in progress_of_blocks(out).values()) < 3:
            if time.monotonic() > deadline:
                failures.append("no three blocks ran at the same time")
                return
            time.sleep(0.05)
        node = cluster.worker_nodes and next(iter(cluster.worker_nodes))
        cluster.remove_node(node, allow_graceful=False)

    killer = threading.Thread(target=kill)
    killer.start()
    splats, report = fit_in_blocks(folder, out, replace(options, ray=cluster.address))
    killer.join()
    assert not failures
    assert splats == whole
    assert max(block["attempts"] for block in report["blocks"]) == 2, "nothing was lost"
    assert len({block["process"] for block in report["blocks"]}) >= 2


def test_all_nodes_are_checked(cluster, tmp_path):
    with RayCluster(cluster.address) as joined:
        # Ray itself lists a killed node for a while.
        assert len(joined.check(tmp_path)) == len(cluster.list_all_nodes())
        with pytest.raises(igsr.IgsrError, match=r"does not see .*none"):
            joined.check(tmp_path / "none")
