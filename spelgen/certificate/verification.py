"""The result of a numerical verification of the derived facts, as text and as JSON."""

from __future__ import annotations

import textwrap
from dataclasses import asdict, dataclass
from typing import Literal

from spelgen.listing import WIDTH, Listing

Verdict = Literal["agrees", "differs", "undecided"]
_MARKS = {"agrees": "ok", "differs": "DIFFERS", "undecided": "open"}


@dataclass(frozen=True)
class FactCheck:
    """A derived fact, the result of an independent computation, and whether the two agree.

    ``undecided``: neither confirmed nor refuted in double precision, or by the other program.
    """

    fact: str
    derived: str
    found: str
    verdict: Verdict

    def __str__(self) -> str:
        return f"{self.fact}: {self.derived}; {self.found}"


@dataclass(frozen=True, repr=False)
class Verification:
    """The checks of an arm at ``samples`` random configurations from ``seed``."""

    means: str
    samples: int
    seed: int
    checks: tuple[FactCheck, ...]

    @property
    def agrees(self) -> bool:
        """Whether no result contradicts the derivation."""
        return not self.differences

    @property
    def differences(self) -> tuple[FactCheck, ...]:
        """The checks that contradict the derivation, or the reading of the file."""
        return tuple(check for check in self.checks if check.verdict == "differs")

    def __repr__(self) -> str:
        return f"<Verification: {len(self.checks)} checks, {len(self.differences)} of them differ>"

    def _repr_html_(self) -> str:
        rows = [(check.fact, check.derived, check.found, check.verdict) for check in self.checks]
        head = ("fact", "derived", "found", "")
        return Listing(f"Verified by {self.means}", head, tuple(rows), left=(0, 1, 2, 3)).html()

    def to_dict(self) -> dict[str, object]:
        """Return a JSON object."""
        return {
            "agrees": self.agrees,
            "means": self.means,
            "samples": self.samples,
            "seed": self.seed,
            "checks": list(map(asdict, self.checks)),
        }

    def text(self) -> str:
        """Return a paragraph for a terminal, with one or more lines per check."""
        lines = textwrap.wrap(f"Verified by {self.means}", WIDTH)
        for check in self.checks:
            mark = f"  {_MARKS[check.verdict]:<7} "
            lines += textwrap.wrap(
                str(check), WIDTH, initial_indent=mark, subsequent_indent=" " * 12, break_on_hyphens=False
            )
        return "\n".join(lines)


def size_text(size: float) -> str:
    """Return the order of magnitude of an error: ``3e-12``, or ``0``."""
    if not size:
        return "0"
    return f"{size:.0e}"
