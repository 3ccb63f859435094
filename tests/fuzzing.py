"""Random files for tests: the same FEW in each run of `make test`, new ones until the time is up in `make fuzz`.

Each example must end within SECONDS (of the reference in time_bounds.py) with a result or with a SpelgenError.
`make fuzz` also bounds the memory that all examples took.
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
)  # for all tests together; 0: the same examples in each run
TESTS = 7  # tests that share these minutes
FEW = 12  # examples of a test in `make test`
SECONDS = 10
MEMORY = 1_000_000  # kB in addition to the memory before the example


def fuzz(draw: st.SearchStrategy, examples: int, use: Callable[[Any], Any]) -> None:
    """Call ``use`` with examples of a strategy: ``examples`` at a time in `make fuzz`, at most FEW otherwise."""
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
    """True if ``use`` returns a result; else check that it raises an error with a text."""
    for each in (signal.SIGALRM, signal.SIGPROF):
        signal.signal(each, _late)
    seconds = SECONDS * _slowness()
    signal.setitimer(signal.ITIMER_PROF, seconds)  # of its own time: others may use the machine
    signal.alarm(int(10 * seconds))  # a process that waits uses none
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
