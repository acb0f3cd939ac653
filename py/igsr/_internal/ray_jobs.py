"""The one place that knows Ray: work on the machines of a cluster, each piece retried alone."""

from __future__ import annotations

import contextlib
import socket
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from igsr import _core
from igsr._internal.worker_processes import THREADS, WorkerLostError
from igsr.errors import IgsrError

#: Releases that work as is told here, as in pyproject.toml.
OLDEST, BEFORE = (2, 40), (3, 0)
#: How often a piece of work is begun again because its machine went away.
RETRIES = 10
#: Seconds within which a machine of the cluster must say what it is.
ANSWERS_WITHIN = 120.0
#: Seconds within which the head of a cluster must take a connection.
LISTENS_WITHIN = 10.0


@dataclass(frozen=True)
class Node:
    """A machine of the cluster.

    Attributes:
        host: its name.
        igsr: version of igsr on it.
        instruction_set: of its processor, on which the bits of results depend.
        sees: whether it sees the folder that all share.
    """

    host: str
    igsr: str
    instruction_set: str
    sees: bool


class RayCluster:
    """A Ray cluster, joined for as long as the context lasts.

    Attributes:
        nodes: its machines that do work; empty until ``check``.
    """

    def __init__(self, address: str | None = None) -> None:
        """Name the cluster.

        Args:
            address: of its head, such as "10.0.0.1:6379"; "auto": the one that this machine is
                part of; "local": one on this machine alone. None: that this machine is part of, or
                else a local one.
        """
        self.address = address
        self.nodes: list[Node] = []

    def __enter__(self) -> RayCluster:
        """Join the cluster.

        Raises:
            IgsrError: Ray is missing or of another version, or no cluster answers.
        """
        self._ray = _imported()
        self._joined = not self._ray.is_initialized()
        if self._joined:
            named = {} if self.address is None else {"address": self.address}
            try:
                _check_that_one_listens(self.address)
                self._ray.init(log_to_driver=False, logging_level="warning", **named)
            except Exception as error:  # of any kind, by what is wrong with the cluster
                where = "" if self.address is None else f" at {self.address}"
                raise IgsrError(
                    f"Cannot join the Ray cluster{where}: {_first_line(error)}. Start one with "
                    "'ray start --head' and the same version of Ray on all machines."
                ) from error
        return self

    def __exit__(self, *_: object) -> None:
        """Leave the cluster; what still runs for this process there ends."""
        if self._joined:
            self._ray.shutdown()

    def check(self, folder: Path | None = None) -> list[Node]:
        """Ask all machines what they are.

        A machine that has gone away is left out, also while the cluster still lists it: what it is
        asked is then answered by another.

        Args:
            folder: that all must see under the same path; None asks for none.

        Raises:
            IgsrError: a machine has no igsr or another version of it, or does not see the folder.
        """
        ray = self._ray
        from ray.util.scheduling_strategies import NodeAffinitySchedulingStrategy

        remote = ray.remote(num_cpus=0, max_retries=1)(_what_it_is)
        asked = {}
        for node in self._alive():
            there = NodeAffinitySchedulingStrategy(node["NodeID"], soft=True)
            task = remote.options(scheduling_strategy=there)
            name = node.get("NodeManagerHostname") or node["NodeID"][:8]
            asked[task.remote(None if folder is None else str(folder))] = name
        answered: dict[str, Node] = {}
        for reference, name in asked.items():
            try:
                # An older igsr does not say who answers.
                answer = (*ray.get(reference, timeout=ANSWERS_WITHIN), name)
                node, node_id = Node(*answer[:4]), answer[4]
            except Exception as error:
                reason = _first_line(error)
                raise IgsrError(
                    f"The machine {name} of the Ray cluster cannot run igsr ({reason}); install "
                    f"igsr {_core.__version__} there."
                ) from error
            if node.igsr != _core.__version__:
                raise IgsrError(
                    f"The machine {node.host} of the Ray cluster has igsr {node.igsr} where this "
                    f"one has {_core.__version__}; install the same on all."
                )
            if not node.sees:
                raise IgsrError(
                    f"The machine {node.host} of the Ray cluster does not see {folder}; put "
                    "photos and results on a disk that all machines mount under the same path."
                )
            answered[node_id] = node
        self.nodes = list(answered.values())
        return self.nodes

    def results(
        self,
        work: Callable[[str, Any], Any],
        data: str,
        pieces: Sequence[Any],
        *,
        memory: Sequence[int | None] | None = None,
        spread: bool = False,
        again: Callable[[int, Exception], Any] | None = None,
    ) -> Iterator[tuple[int, Any]]:
        """Do pieces of work, as many at a time as there is room for.

        A piece whose machine goes away is begun again on another.

        Args:
            work: does one, given ``data`` and the piece.
            data: the first argument.
            pieces: what there is to do.
            memory: bytes that each piece takes, None where it is not known.
            spread: whether a piece takes its share of a machine's cores, not one.
            again: called with the number of a piece and the exception where memory ran out or its
                process ended without a result; what it returns is done in its place, if it is not
                None.

        Yields:
            The number of a piece and its result, or the exception that it ended with.
        """
        ray = self._ray
        alive = self._alive()
        most = max((node["Resources"].get("memory", 0.0) for node in alive), default=0.0)
        cores = 1
        if spread and alive:
            each = -(-max(1, len(pieces)) // len(alive))
            cores = max(1, int(min(node["Resources"]["CPU"] for node in alive)) // each)

        # A function: Ray takes no partials.
        @ray.remote(
            num_cpus=cores,
            max_retries=RETRIES,
            runtime_env={"env_vars": dict.fromkeys(THREADS, str(cores))},
        )
        def remote(folder: str, piece: Any) -> Any:
            return work(folder, piece)

        def submit(number: int, piece: Any) -> Any:
            needs = None if memory is None else memory[number]
            # More than the largest machine has would wait for ever.
            options = {} if not needs else {"memory": int(min(needs, 0.9 * most))}
            return remote.options(**options).remote(data, piece)

        pending = {submit(number, piece): number for number, piece in enumerate(pieces)}
        try:
            while pending:
                for reference in ray.wait(list(pending))[0]:
                    number = pending.pop(reference)
                    result = self._result(reference)
                    if again is not None and isinstance(result, (WorkerLostError, MemoryError)):
                        other = again(number, result)
                        if other is not None:
                            pending[submit(number, other)] = number
                            continue
                    yield number, result
        finally:
            for reference in pending:
                with contextlib.suppress(Exception):
                    ray.cancel(reference, force=True)

    def do(
        self,
        work: Callable[[str, Any], Any],
        data: str,
        pieces: Sequence[Any],
        keep: Callable[[int, Any], None],
        **options: Any,
    ) -> None:
        """Do all pieces of work, also where one fails.

        Args:
            work, data, pieces: as for ``results``.
            keep: called with the number of each piece that is done, and its result.
            options: the other arguments of ``results``.

        Raises:
            Exception: what the first piece that failed ended with, after all others.
        """
        failed: Exception | None = None
        for number, result in self.results(work, data, pieces, **options):
            if not isinstance(result, Exception):
                keep(number, result)
            elif failed is None:
                failed = result
        if failed is not None:
            raise failed

    def _result(self, reference: Any) -> Any:
        """What a piece of work returned, or the exception that it ended with."""
        lost = (
            self._ray.exceptions.OutOfMemoryError,
            self._ray.exceptions.WorkerCrashedError,
            self._ray.exceptions.NodeDiedError,
        )
        try:
            return self._ray.get(reference)
        except lost as error:
            return WorkerLostError(
                f"A worker of the Ray cluster ended without a result ({type(error).__name__}); its "
                "machine may have run out of memory."
            )
        except Exception as error:
            cause = getattr(error, "cause", None)
            return cause if isinstance(cause, (IgsrError, MemoryError)) else error

    def _alive(self) -> list[Any]:
        nodes = self._ray.nodes()
        return [n for n in nodes if n["Alive"] and n["Resources"].get("CPU", 0.0) >= 1.0]


def _check_that_one_listens(address: str | None) -> None:
    """Ray itself would try for minutes.

    Raises:
        OSError: nobody listens at this host and port.
    """
    host, colon, port = (address or "").rpartition(":")
    if colon and port.isdigit() and "/" not in host:
        with socket.create_connection((host.strip("[]"), int(port)), timeout=LISTENS_WITHIN):
            pass


def _imported() -> Any:
    try:
        import ray
    except ImportError as error:
        raise IgsrError("--ray needs Ray; install it with: pip install 'igsr[ray]'.") from error
    version = getattr(ray, "__version__", "")
    try:
        number = tuple(int(part) for part in version.split(".")[:2])
    except ValueError:
        number = (0,)
    if not OLDEST <= number < BEFORE:
        raise IgsrError(
            f"Ray {version} is installed, and igsr needs 2.40 or newer, below 3; install it with: "
            "pip install 'igsr[ray]'."
        )
    return ray


def _first_line(error: BaseException) -> str:
    """What an error says first: Ray's go on with tracebacks of other machines."""
    cause = getattr(error, "cause", None) or error
    lines = str(cause).strip().splitlines() or [type(cause).__name__]
    return lines[0].rstrip(".")


def _what_it_is(folder: str | None) -> tuple[str, str, str, bool, str]:
    """On a machine of the cluster: the fields of its ``Node``, and its ID there."""
    import ray

    node_id = ray.get_runtime_context().get_node_id()
    about = _core.backend_info("cpu")
    sees = folder is None or Path(folder).is_dir()
    return socket.gethostname(), _core.__version__, about["instruction_set"], sees, node_id
