"""Run work on the machines of a Ray cluster; lost work is repeated."""

from __future__ import annotations

import contextlib
import socket
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, TypeVar

from igsr import _core
from igsr._internal.worker_processes import THREADS, WorkerLostError
from igsr.errors import IgsrError

T = TypeVar("T")
R = TypeVar("R")

#: Supported releases of Ray, as in pyproject.toml.
MIN_VERSION = (2, 40)
END_VERSION = (3, 0)
#: How often a piece of work is started again after its machine was lost.
MAX_RETRIES = 10
#: Seconds for a machine of the cluster to answer.
NODE_TIMEOUT_S = 120.0
#: Seconds for the head of the cluster to accept a connection.
CONNECT_TIMEOUT_S = 10.0


class RayCluster:
    """A Ray cluster that is joined for the duration of a ``with`` block."""

    def __init__(self, address: str | None = None) -> None:
        """Name the head: "10.0.0.1:6379", "auto" or "local"; None tries "auto", then "local"."""
        self.address = address

    def __enter__(self) -> RayCluster:
        """Join the cluster.

        Raises:
            IgsrError: Ray is missing or of another version, or no cluster answers.
        """
        self._ray = _imported_ray()
        self._joined = not self._ray.is_initialized()
        if self._joined:
            named = {} if self.address is None else {"address": self.address}
            try:
                _check_connection(self.address)
                self._ray.init(log_to_driver=False, logging_level="warning", **named)
            except Exception as error:  # Ray raises exceptions of many types here
                at = "" if self.address is None else f" at {self.address}"
                raise IgsrError(
                    f"Cannot join the Ray cluster{at}: {_first_line(error)}. Start one with "
                    "'ray start --head' and the same version of Ray on all machines."
                ) from error
        return self

    def __exit__(self, *_: object) -> None:
        """Leave the cluster, which ends the work of this process there."""
        if self._joined:
            self._ray.shutdown()

    def check(self, folder: Path) -> list[str]:
        """Check that all machines have this igsr and see a shared folder; return their names.

        Raises:
            IgsrError: a machine lacks igsr, has another version of it, or does not see the folder.
        """
        from ray.util.scheduling_strategies import NodeAffinitySchedulingStrategy

        remote = self._ray.remote(num_cpus=0, max_retries=1)(_describe_node)
        pending = {}
        for listed in self._machines():
            # Soft: Ray lists a lost machine for a while, and another one answers in its place.
            strategy = NodeAffinitySchedulingStrategy(listed["NodeID"], soft=True)
            name = listed.get("NodeManagerHostname") or listed["NodeID"][:8]
            task = remote.options(scheduling_strategy=strategy)
            pending[task.remote(folder)] = name
        hosts: dict[str, str] = {}
        for reference, name in pending.items():
            try:
                answer = self._ray.get(reference, timeout=NODE_TIMEOUT_S)
                node_id, host, igsr_version, sees_folder = answer
            except Exception as error:
                raise IgsrError(
                    f"The machine {name} of the Ray cluster cannot run igsr "
                    f"({_first_line(error)}); install igsr {_core.__version__} there."
                ) from error
            if igsr_version != _core.__version__:
                raise IgsrError(
                    f"The machine {host} of the Ray cluster has igsr {igsr_version}, but this "
                    f"one has {_core.__version__}; install the same on all."
                )
            if not sees_folder:
                raise IgsrError(
                    f"The machine {host} of the Ray cluster does not see {folder}; put "
                    "photos and results on a disk that all machines mount under the same path."
                )
            hosts[node_id] = host
        return list(hosts.values())

    def run(
        self,
        work: Callable[[T], R],
        pieces: Sequence[T],
        keep: Callable[[T, R], None],
        *,
        memory: Callable[[T], int | None] = lambda piece: None,
        spread: bool = False,
        retry: Callable[[T, Exception], T] | None = None,
    ) -> None:
        """Do pieces of work in parallel; a failed piece does not stop the rest.

        Args:
            work: does one piece.
            pieces: the work.
            keep: called with each finished piece and its result.
            memory: returns the bytes that a piece needs, None if unknown.
            spread: whether to divide all cores of a machine among its pieces, instead of one each.
            retry: called with a piece that was lost or ran out of memory and its exception; returns
                the piece to do instead.

        Raises:
            Exception: the first failure, after all pieces have ended; or raised by ``retry``.
        """
        resources = [machine["Resources"] for machine in self._machines()]
        largest = max((each.get("memory", 0.0) for each in resources), default=0.0)
        cores = 1
        if spread and resources:
            pieces_each = -(-max(1, len(pieces)) // len(resources))
            cores = max(1, int(min(each["CPU"] for each in resources)) // pieces_each)

        # Ray does not accept functools.partial.
        @self._ray.remote(
            num_cpus=cores,
            max_retries=MAX_RETRIES,
            runtime_env={"env_vars": dict.fromkeys(THREADS, str(cores))},
        )
        def remote(piece: T) -> R:
            return work(piece)

        def submit(piece: T) -> Any:
            needed = memory(piece)
            # A piece that needs more than any machine has would never start.
            limit = {} if not needed else {"memory": int(min(needed, 0.9 * largest))}
            return remote.options(**limit).remote(piece)

        pending = {submit(piece): piece for piece in pieces}
        failure: Exception | None = None
        try:
            while pending:
                for reference in self._ray.wait(list(pending))[0]:
                    piece = pending.pop(reference)
                    result, error = self._result(reference)
                    if error is None:
                        keep(piece, result)
                    elif retry and isinstance(error, (WorkerLostError, MemoryError)):
                        piece = retry(piece, error)
                        pending[submit(piece)] = piece
                    else:
                        failure = failure or error
        finally:
            for reference in pending:
                with contextlib.suppress(Exception):
                    self._ray.cancel(reference, force=True)
        if failure is not None:
            raise failure

    def _result(self, reference: Any) -> tuple[Any, Exception | None]:
        """The result of a piece, or its exception."""
        errors = self._ray.exceptions
        try:
            return self._ray.get(reference), None
        except (errors.OutOfMemoryError, errors.WorkerCrashedError, errors.NodeDiedError) as error:
            return None, WorkerLostError(
                f"A worker of the Ray cluster ended without a result ({type(error).__name__}); its "
                "machine may have run out of memory."
            )
        except Exception as error:
            cause = getattr(error, "cause", None)
            return None, cause if isinstance(cause, (IgsrError, MemoryError)) else error

    def _machines(self) -> list[Any]:
        """The machines that do work."""
        nodes = self._ray.nodes()
        return [n for n in nodes if n["Alive"] and n["Resources"].get("CPU", 0.0) >= 1.0]


def _check_connection(address: str | None) -> None:
    """Raise OSError if nothing listens at HOST:PORT; Ray itself would try for minutes."""
    host, colon, port = (address or "").rpartition(":")
    if colon and port.isdigit() and "/" not in host:
        socket.create_connection((host.strip("[]"), int(port)), timeout=CONNECT_TIMEOUT_S).close()


def _imported_ray() -> Any:
    try:
        import ray
    except ImportError as error:
        raise IgsrError("--ray needs Ray; install it with: pip install 'igsr[ray]'.") from error
    version = getattr(ray, "__version__", "")
    try:
        number = tuple(int(part) for part in version.split(".")[:2])
    except ValueError:
        number = (0,)
    if not MIN_VERSION <= number < END_VERSION:
        raise IgsrError(
            f"Ray {version} is installed, and igsr needs 2.40 or newer, below 3; install it with: "
            "pip install 'igsr[ray]'."
        )
    return ray


def _first_line(error: BaseException) -> str:
    """The first line of an error, without the tracebacks that Ray appends."""
    cause = getattr(error, "cause", None) or error
    lines = str(cause).strip().splitlines() or [type(cause).__name__]
    return lines[0].rstrip(".")


def _describe_node(folder: Path) -> tuple[str, str, str, bool]:
    """Run on a machine of the cluster: its ID and name, its igsr, and whether it sees a folder."""
    import ray

    node_id = ray.get_runtime_context().get_node_id()
    return node_id, socket.gethostname(), _core.__version__, folder.is_dir()
