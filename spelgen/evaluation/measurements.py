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

# Version of the format of evaluation.json. It changes if files of an earlier version cannot be read any more.
SCHEMA = 11


@dataclass(frozen=True)
class Verdict:
    """An assessment in words.

    sentence: suitable uses, failures, and motions to record. because: figures that support the sentence.
    """

    sentence: str
    because: str


@dataclass(frozen=True, repr=False)
class Measurements:
    """All measurements of `evaluate`; `to_dict` is evaluation.json.

    parameters: number of trained parameters. traces: curves from which the figures are computed, with predictions over
    the longest horizon. cutoff: cutoff frequency of the filter of the test logs [Hz]; None without a filter. substeps:
    integrator steps of the model per sample interval. torque: torque errors per predictor; empty if the sample rate is
    too low for accelerations. torque_steps: quantisation steps of torques, see `coarse_torques`. replays: errors of
    replayed commands of an arm under position servos. mass_errors: relative errors of M per predictor, if the true M is
    known. assessment: assessment of the model, which uses the coverage of the training logs; None before it is made.
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
        """Return the results as an object for JSON, whose key `schema` is the version of the format."""
        return {"schema": SCHEMA} | record(self)

    @classmethod
    def from_dict(cls, content: Mapping[str, object]) -> Self:
        """Return the results from an object that `to_dict` has returned. Raises ValueError for other content."""
        return TypeAdapter(cls).validate_python(content)
