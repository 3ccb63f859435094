"""The figures and curves of an evaluation: the content of evaluation.json."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Self

from pydantic import TypeAdapter

from spelgen.errors import Diagnostic
from spelgen.evaluation.horizons import Horizon
from spelgen.evaluation.plain import record
from spelgen.evaluation.replay import Replay
from spelgen.evaluation.torque import TorqueErrors
from spelgen.evaluation.traces import Traces

SCHEMA = 11


@dataclass(frozen=True)
class Verdict:
    """An assessment. sentence: uses, failures, motions to record. because: the figures behind it."""

    sentence: str
    because: str


@dataclass(frozen=True, repr=False)
class Measurements:
    """All measurements of `evaluate`; `to_dict` is evaluation.json.

    parameters: number of trained parameters. traces: curves behind the figures, of predictions over the longest
    horizon. cutoff: of the filter of the test logs [Hz], None without one. substeps: integrator steps of the model per
    sample interval. torque: errors by predictor, empty if the logs are too sparse for accelerations. torque_steps: see
    `coarse_torques`. replays: of the commands of an arm under position servos. mass_errors: relative errors of M by
    predictor, if the truth is known. assessment: of the model, with the coverage of its training logs; None before
    the assessment.
    """

    robot: str
    joints: tuple[str, ...]
    joint_types: tuple[str, ...]
    trajectories: tuple[str, ...]
    parameters: int
    diagnostics: tuple[Diagnostic, ...]
    traces: Traces
    cutoff: float | None = None
    substeps: int = 1
    horizons: tuple[Horizon, ...] = ()
    torque: dict[str, TorqueErrors] = field(default_factory=dict)
    torque_steps: dict[str, float] = field(default_factory=dict)
    replays: tuple[Replay, ...] = ()
    mass_errors: dict[str, float] = field(default_factory=dict)
    assessment: Verdict | None = None

    def to_dict(self) -> dict[str, object]:
        """Return the JSON form, versioned by `schema`."""
        return {"schema": SCHEMA} | record(self)

    @classmethod
    def from_dict(cls, content: Mapping[str, object]) -> Self:
        """Return the measurements of a `to_dict`. Raises ValueError for other content."""
        return TypeAdapter(cls).validate_python(content)
