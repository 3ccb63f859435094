"""Run many independent tasks: on Ray, which runs a task again when its worker or its machine dies."""

from __future__ import annotations

import logging
import os
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, redirect_stdout
from importlib.util import find_spec
from typing import Any, Protocol, TypeVar

from spelgen.errors import RunError

RETRIES = 5  # of a task whose worker died
OBJECT_STORE = 100_000_000  # bytes of memory that tasks share: they hand over paths and a few numbers

Task = TypeVar("Task")
Result = TypeVar("Result")


class RunTasks(Protocol):
    """Run tasks; see ``workers``."""

    def __call__(
        self, work: Callable[[Task], Result], tasks: Sequence[Task]
    ) -> Iterator[tuple[Task, Result | Exception]]:
        """Yield each task with what ``work`` returns for it, or the exception it ended with, as they end."""
        ...


def run_here(
    work: Callable[[Task], Result], tasks: Sequence[Task]
) -> Iterator[tuple[Task, Result | Exception]]:
    """Run one task after the other in this process."""
    for task in tasks:
        try:
            outcome: Result | Exception = work(task)
        except Exception as error:
            outcome = error
        yield task, outcome


@contextmanager
def workers(jobs: int, address: str | None = None) -> Iterator[RunTasks]:
    """Give a function that runs tasks, ``jobs`` at a time on a Ray of this machine, or on the cluster at an address.

    One job at a time needs no Ray. address: of a cluster that runs already, "auto" for this machine's. Raises
    RunError without Ray, and where no cluster answers.
    """
    if jobs == 1 and address is None:
        yield run_here
        return
    if find_spec("ray") is None:
        raise RunError(
            "several runs at a time, and no Ray",
            expected="the extra fleet",
            do="pip install 'spelgen[fleet]', or --jobs 1",
        )
    os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")  # nothing is reported to anybody
    os.environ.setdefault("RAY_ACCEL_ENV_VAR_OVERRIDE_ON_ZERO", "0")  # or Ray warns of its new default
    import ray

    cluster: dict[str, Any] = {"address": address}
    if address is None:
        cluster = {"num_cpus": jobs, "include_dashboard": False, "object_store_memory": OBJECT_STORE}
    try:
        ray.init(**cluster, log_to_driver=False, logging_level=logging.ERROR)
    except (ConnectionError, RuntimeError, ValueError) as error:
        location = "this machine" if address is None else repr(address)
        raise RunError(
            f"no Ray cluster at {location} ({' '.join(str(error).split())[:200]})",
            do="start one by `ray start --head`, or omit --address",
        ) from error
    try:
        with redirect_stdout(sys.stderr):  # Ray reports workers that died there: stdout is for results
            yield _run_on_ray
    finally:
        ray.shutdown()


def _run_on_ray(
    work: Callable[[Task], Result], tasks: Sequence[Task]
) -> Iterator[tuple[Task, Result | Exception]]:
    """Run tasks of one processor core each. A task may run again after its worker died, so it must be able to."""
    import ray

    remote: Any = ray.remote(num_cpus=1, max_retries=RETRIES)(_work_or_die)
    waiting = {remote.remote(work, task): task for task in tasks}
    try:
        while waiting:
            (reference,), _ = ray.wait(list(waiting), num_returns=1)
            yield waiting.pop(reference), _outcome(reference)
    finally:
        for reference in waiting:
            ray.cancel(reference, force=True)


def _work_or_die(work: Callable[[Task], Result], task: Task) -> Result:
    """Do a task in a worker. One that is asked to end dies at once, and so its task runs again."""
    try:
        return work(task)
    except KeyboardInterrupt:
        os._exit(1)


def _outcome(reference: Any) -> Any:
    """Return the result of a task, or its own exception."""
    import ray
    from ray.exceptions import RayError, RayTaskError

    try:
        return ray.get(reference)
    except RayTaskError as error:
        if isinstance(error.cause, Exception):
            return error.cause
        return error
    except RayError as error:  # its workers died each time, or Ray's own processes did
        return RunError(
            f"a worker that died {RETRIES + 1} times ({type(error).__name__})",
            do="the same command does what is left",
        )
