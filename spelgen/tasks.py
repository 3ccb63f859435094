"""Run independent tasks: one after the other here, or several at a time on Ray, which reruns tasks of dead workers."""

import logging
import os
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, redirect_stdout
from importlib.util import find_spec
from types import ModuleType
from typing import Any, TypeVar

from spelgen.errors import RunError

# Largest number of repetitions of a task whose worker died.
RETRIES = 5

Task = TypeVar("Task")
Result = TypeVar("Result")


def default_jobs() -> int:
    """Return the number of cores that this process may use if Ray is installed, else 1."""
    # Cores are counted by the CPU affinity, because a container or a scheduled job may have fewer than the machine.
    return 1 if find_spec("ray") is None else len(os.sched_getaffinity(0))


def run_tasks(
    work: Callable[[Task], Result], tasks: Sequence[Task], jobs: int = 1, address: str | None = None
) -> Iterator[tuple[Task, Result | Exception]]:
    """Yield each task with its result or its exception, in the order in which the tasks end.

    A single job at a time runs in this process, without Ray. Raises RunError if Ray is not installed, or if no cluster
    answers.

    Args:
        work: Function of a task. With Ray, it must be able to run again, because its worker may die.
        tasks: The tasks, of one core each.
        jobs: Number of parallel tasks on this machine.
        address: Address of a running Ray cluster; "auto" for the cluster of this machine.
    """
    # One job runs in this process: it needs no second interpreter, and errors keep their traceback.
    if jobs == 1 and address is None:
        for task in tasks:
            # An exception is yielded, not raised, so that a failed task does not stop the others.
            try:
                outcome: Result | Exception = work(task)
            except Exception as error:
                outcome = error
            yield task, outcome
        return
    with _ray(jobs, address) as ray:
        remote = ray.remote(num_cpus=1, max_retries=RETRIES)(_work_or_die)
        waiting = {remote.remote(work, task): task for task in tasks}
        try:
            # Results are yielded as tasks end, so that the caller can store each one before a later task fails.
            while waiting:
                (reference,), _ = ray.wait(list(waiting), num_returns=1)
                yield waiting.pop(reference), _outcome(reference)
        finally:
            for reference in waiting:
                ray.cancel(reference, force=True)


@contextmanager
def _ray(jobs: int, address: str | None) -> Iterator[ModuleType]:
    """Context manager that starts Ray on this machine, or connects to a cluster, and yields the module `ray`.

    jobs: number of cores to use on this machine. address: address of the cluster; None: this machine.
    """
    if find_spec("ray") is None:
        do = "pip install 'spelgen[parallel]', or --jobs 1"
        raise RunError("several runs at a time without Ray", expected="the extra parallel", do=do)
    # Ray must not send usage statistics.
    os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")
    # RAY_ACCEL_ENV_VAR_OVERRIDE_ON_ZERO=0 avoids a warning of Ray about a changed default of this variable.
    os.environ.setdefault("RAY_ACCEL_ENV_VAR_OVERRIDE_ON_ZERO", "0")
    import ray

    cluster: dict[str, Any] = {"address": address}
    if address is None:
        # Ray's dashboard would open a port. The object store needs at most 100 MB: tasks exchange paths and numbers.
        cluster = {"num_cpus": jobs, "include_dashboard": False, "object_store_memory": 100_000_000}
    try:
        ray.init(**cluster, log_to_driver=False, logging_level=logging.ERROR)
    except (ConnectionError, RuntimeError, ValueError) as error:
        location = "this machine" if address is None else repr(address)
        reason = " ".join(str(error).split())[:200]
        do = "start one by `ray start --head`, or omit --address"
        raise RunError(f"no Ray cluster at {location} ({reason})", do=do) from error
    try:
        # Ray prints messages about dead workers to stdout, which must contain results only.
        with redirect_stdout(sys.stderr):
            yield ray
    finally:
        ray.shutdown()


def _work_or_die(work: Callable[[Task], Result], task: Task) -> Result:
    """Return work(task) in a worker of Ray. A worker that is interrupted dies at once: Ray then runs its task again."""
    try:
        return work(task)
    except KeyboardInterrupt:
        os._exit(1)


def _outcome(reference: Any) -> Any:
    """Return the result of a Ray task, or the exception that the task raised, without Ray's wrapper."""
    import ray
    from ray.exceptions import RayError, RayTaskError

    try:
        return ray.get(reference)
    except RayTaskError as error:
        return error.cause if isinstance(error.cause, Exception) else error
    except RayError as error:
        # A RayError means that the worker of the task, or a process of Ray, died in all attempts.
        got = f"a worker that died {RETRIES + 1} times ({type(error).__name__})"
        return RunError(got, do="the same command runs the remaining tasks")
