"""What runs many independent pieces of work: one after the other in this process, or on Ray."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager, nullcontext
from importlib.util import find_spec
from typing import Any, Protocol, TypeVar

from spelgen.errors import RunError

Task = TypeVar("Task")


class Engine(Protocol):
    """Runs pieces of work; a context, within which its workers live."""

    def results(
        self, work: Callable[[Task], Any], tasks: Sequence[Task]
    ) -> Iterator[tuple[Task, Any | Exception]]:
        """Each task with what ``work`` makes of it, or the exception it ended with, in the order in which they end."""
        ...


class InProcess:
    """One task after the other, here."""

    def results(
        self, work: Callable[[Task], Any], tasks: Sequence[Task]
    ) -> Iterator[tuple[Task, Any | Exception]]:
        """See ``Engine``."""
        for task in tasks:
            try:
                found = work(task)
            except Exception as error:
                found = error
            yield task, found


def engine(jobs: int, address: str | None = None, gpus: float = 0.0) -> AbstractContextManager[Engine]:
    """This process for one job at a time; else Ray, of this machine with so many at a time or of a cluster.

    address: of a cluster that runs already, "auto" for this machine's. gpus: what each task needs. Raises RunError
    without Ray, and where no cluster answers.
    """
    if jobs == 1 and address is None:
        return nullcontext(InProcess())
    if find_spec("ray") is None:
        raise RunError(
            "several runs at a time, and no Ray", expected="the extra fleet",
            do="pip install 'spelgen[fleet]', or --jobs 1",
        )  # fmt: skip
    from spelgen.fleet.ray_engine import on_ray

    return on_ray(jobs, address, gpus)
