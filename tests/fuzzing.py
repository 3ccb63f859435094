"""How files drawn at random are tried: in `make test` always the same few, in `make fuzz` new ones until time is up.

A test hands over what it does with one example, which must end within SECONDS (of the reference in machine.py) as
users may expect: with an answer or a SpelgenError whose lines name what is wrong. The memory that all of them took is
looked at in the end.
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
from machine import slowness

from spelgen.errors import SpelgenError

MINUTES = float(
    os.environ.get("FUZZ_MINUTES", "0")
)  # of all tests that fuzz; 0: the same examples every time
TESTS = 7  # among which they are shared
SECONDS = 10
MEMORY = 1_000_000  # kB beside what the process had before


def fuzz(draw: st.SearchStrategy, examples: int, use: Callable[[Any], Any]) -> None:
    """Use examples of what is drawn."""
    kept = {"deadline": None, "database": None, "suppress_health_check": list(HealthCheck)}

    def run(number: int) -> None:
        def once(example: Any) -> None:
            answered(lambda: use(example))

        drawn = seed(number)(given(draw)(once))
        settings(max_examples=examples, derandomize=not MINUTES, print_blob=bool(MINUTES), **kept)(drawn)()

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
    """Whether there was an answer; if not, that it was refused as users may expect."""
    for each in (signal.SIGALRM, signal.SIGPROF):
        signal.signal(each, _late)
    seconds = SECONDS * _slowness()
    signal.setitimer(signal.ITIMER_PROF, seconds)  # of its own time: others may use the machine
    signal.alarm(int(10 * seconds))  # and what waits uses none
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
