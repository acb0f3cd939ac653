"""A stand-in for the parts of Ray that igsr uses, in this process; test_blocks_ray.py uses Ray."""

import functools
import sys
import types


class StandInRay(types.ModuleType):
    """A module that runs calls when their results are requested, the last call first."""

    __version__ = "2.50.0"

    def __init__(self):
        super().__init__("ray")
        self.environments = []
        self.running = False
        self.refuses = None
        self.addresses = []
        self.listed = ["head"]
        lost = ("OutOfMemoryError", "WorkerCrashedError", "NodeDiedError")
        self.exceptions = types.SimpleNamespace(**{n: type(n, (Exception,), {}) for n in lost})

    def is_initialized(self):
        return self.running

    def init(self, log_to_driver, logging_level, address=None):
        self.addresses.append(address)
        if self.refuses is not None:
            raise self.refuses
        self.running = True

    def shutdown(self):
        self.running = False

    def nodes(self):
        resources = {"CPU": 2.0, "memory": 4e9}
        return [{"Alive": True, "NodeID": node, "Resources": resources} for node in self.listed]

    def get_runtime_context(self):
        return types.SimpleNamespace(get_node_id=lambda: "head")

    def remote(self, num_cpus, max_retries, runtime_env=None):
        self.environments.append((num_cpus, (runtime_env or {}).get("env_vars")))

        def decorate(function):
            class Remote:
                remote = staticmethod(lambda *arguments: functools.partial(function, *arguments))
                options = staticmethod(lambda **_: Remote)

            return Remote

        return decorate

    def wait(self, references):
        return references[-1:], references[:-1]

    def get(self, reference, timeout=None):
        try:
            return reference()
        except tuple(vars(self.exceptions).values()):
            raise
        except Exception as error:
            wrapped = RuntimeError("a worker's traceback")
            wrapped.cause = error
            raise wrapped from None

    def cancel(self, reference, force=False):
        pass


def stand_in_ray(monkeypatch):
    """Replace the module ray."""
    ray = StandInRay()
    strategies = types.ModuleType("ray.util.scheduling_strategies")
    strategies.NodeAffinitySchedulingStrategy = lambda node, soft: node
    monkeypatch.setitem(sys.modules, "ray", ray)
    monkeypatch.setitem(sys.modules, "ray.util", types.ModuleType("ray.util"))
    monkeypatch.setitem(sys.modules, "ray.util.scheduling_strategies", strategies)
    return ray
