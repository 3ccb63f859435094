"""Random files for tests: `make test` uses the same FEW files in each run, `make fuzz` new files until time is up.

Each example must end within SECONDS (times the slowness of the machine, see time_bounds.py) with a result or with a
SpelgenError. `make fuzz` also checks that the examples of a test increase the memory by less than MEMORY.
"""

from __future__ import annotations

import os
import resource
import signal
import time
from collections.abc import Callable
from functools import cache
from typing import Any

from hypothesis import HealthCheck, given, seed, settings
from hypothesis import strategies as st
from time_bounds import slowness

from spelgen.errors import SpelgenError

MINUTES = float(
    os.environ.get("FUZZ_MINUTES", "0")
)  # minutes of `make fuzz` for all fuzz tests together; 0: the same examples in each run
TESTS = 7  # number of fuzz tests, which share MINUTES equally
FEW = 12  # largest number of examples per test in `make test`
SECONDS = 10
MEMORY = 1_000_000  # [kB] limit of the memory that the examples of a test add to this process


def fuzz(draw: st.SearchStrategy, examples: int, use: Callable[[Any], Any]) -> None:
    """Call ``use`` with random examples of a strategy.

    `make test` uses one seed with at most FEW (12) examples. `make fuzz` uses new seeds, with ``examples`` examples
    each, until the time of the test is up.
    """
    count = examples if MINUTES else min(examples, FEW)
    kept = {"deadline": None, "database": None, "suppress_health_check": list(HealthCheck)}

    def run(number: int) -> None:
        def once(example: Any) -> None:
            answered(lambda: use(example))

        drawn = seed(number)(given(draw)(once))
        settings(max_examples=count, derandomize=not MINUTES, print_blob=bool(MINUTES), **kept)(drawn)()

    if not MINUTES:
        run(0)
        return
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    first = number = int(time.time())
    end = time.monotonic() + 60 * MINUTES / TESTS
    while time.monotonic() < end:
        number += 1
        run(number)
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before < MEMORY
    assert resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss < 1.1 * MEMORY
    print(f"\n{(number - first) * examples} examples, seeds {first + 1} to {number}")


def answered(use: Callable[[], Any]) -> bool:
    """Return True if ``use`` returns, False if it raises a SpelgenError with a text; any other exception is raised."""
    for each in (signal.SIGALRM, signal.SIGPROF):
        signal.signal(each, _late)
    seconds = SECONDS * _slowness()
    # processor time of this process, which other processes do not affect
    signal.setitimer(signal.ITIMER_PROF, seconds)
    signal.alarm(int(10 * seconds))  # wall time as well, as a process that waits uses no processor time
    try:
        use()
        return True
    except SpelgenError as error:
        assert str(error).strip()
        return False
    finally:
        signal.setitimer(signal.ITIMER_PROF, 0)
        signal.alarm(0)


@cache
def _slowness() -> float:
    return slowness()


def _late(number: int, frame: object) -> None:
    raise AssertionError(f"no answer within {SECONDS} s")
