"""Work on Ray: a task for each piece, run again elsewhere when its worker or its machine dies."""

from __future__ import annotations

import logging
import os
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, redirect_stdout
from typing import Any, TypeVar

os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")  # nothing is told to anybody
os.environ.setdefault("RAY_ACCEL_ENV_VAR_OVERRIDE_ON_ZERO", "0")  # its new way, of which it else warns

import ray
from ray.exceptions import LocalRayletDiedError, RayError, RayTaskError

from spelgen.errors import RunError

RETRIES = 5  # of a task whose worker died
OBJECTS = 100_000_000  # bytes of memory that tasks share: they hand over paths and a few numbers

Task = TypeVar("Task")


class RayEngine:
    """Tasks of one processor core each, and of ``gpus``, on the cluster that Ray is connected to."""

    def __init__(self, gpus: float) -> None:
        self._gpus = gpus

    def results(
        self, work: Callable[[Task], Any], tasks: Sequence[Task]
    ) -> Iterator[tuple[Task, Any | Exception]]:
        """See ``Engine``. A task may run again after its worker died, so it must be able to."""
        remote: Any = ray.remote(num_cpus=1, num_gpus=self._gpus, max_retries=RETRIES)(_done)
        waiting = {remote.remote(work, task): task for task in tasks}
        try:
            while waiting:
                ended, _ = ray.wait(list(waiting), num_returns=1)
                yield waiting.pop(ended[0]), _result(ended[0])
        finally:
            for each in waiting:
                ray.cancel(each, force=True)


def _done(work: Callable[[Task], Any], task: Task) -> Any:
    """What a worker does. One that is told to end dies at once, and so its task runs again."""
    try:
        return work(task)
    except KeyboardInterrupt:
        os._exit(1)


def _result(reference: ray.ObjectRef) -> Any | Exception:
    """What a task gave, or its own exception."""
    try:
        return ray.get(reference)
    except RayTaskError as error:
        return error.cause if isinstance(error.cause, Exception) else error
    except LocalRayletDiedError:
        return RunError("Ray's own processes on a machine died", do="the same command does what is left")
    except RayError as error:  # its workers died, each time
        return RunError(f"a worker that died {RETRIES + 1} times ({type(error).__name__})")


@contextmanager
def on_ray(jobs: int, address: str | None, gpus: float) -> Iterator[RayEngine]:
    """An engine of a cluster at ``address``, or of one that lives on this machine, with ``jobs`` cores, while the
    context does. Raises RunError where no cluster answers.
    """
    own: dict[str, Any] = {"num_cpus": jobs, "include_dashboard": False, "object_store_memory": OBJECTS}
    try:
        ray.init(
            **(own if address is None else {"address": address}),
            log_to_driver=False,
            logging_level=logging.ERROR,
        )
    except (ConnectionError, RuntimeError, ValueError) as error:
        place = "this machine" if address is None else repr(address)
        raise RunError(
            f"no Ray cluster at {place} ({' '.join(str(error).split())[:200]})",
            do="start one by `ray start --head`, or leave --address out",
        ) from error
    try:
        with redirect_stdout(sys.stderr):  # where Ray tells of workers that died: stdout is for results
            yield RayEngine(gpus)
    finally:
        ray.shutdown()
