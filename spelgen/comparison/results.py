"""The results of the runs of a comparison, as result.json has them."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from pydantic import TypeAdapter, ValidationError

from spelgen.comparison.metrics import Prediction, Sizes
from spelgen.errors import RunError
from spelgen.evaluation.drawn_motions import PredictedMotion
from spelgen.evaluation.invariants import Invariants
from spelgen.evaluation.plain import record
from spelgen.files import read_json, write_json


@dataclass(frozen=True)
class LearnedMass:
    """error: of M, see `truth.mass_error`. along: M (T, n, n) at the measured positions of the example."""

    error: float
    along: list[list[list[float]]]


@dataclass(frozen=True)
class RunResult:
    """The measurements of a trained variant.

    seconds: of training. train, test: errors over windows as long as those of training; prediction: over 1 s of tests.
    """

    variant: str
    seed: int
    seconds: float
    substeps: int
    sizes: Sizes
    train: Prediction
    test: Prediction
    prediction: Prediction
    invariants: Invariants
    mass: LearnedMass
    example: PredictedMotion | None

    def save(self, path: Path) -> None:
        """Write it as JSON."""
        write_json(path, record(self))

    @classmethod
    def read(cls, path: Path) -> RunResult:
        """Read what `save` wrote. Raises RunError."""
        try:
            return TypeAdapter(cls).validate_python(read_json(path, RunError))
        except ValidationError as error:
            raise RunError("other values than a result has", file=path, do="remove it") from error
