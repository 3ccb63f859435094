"""The figures and curves of an evaluation, as evaluation.json has them."""

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

SCHEMA = 10


@dataclass(frozen=True, repr=False)
class Measurements:
    """Gather what `evaluate` measures; `to_dict` is evaluation.json.

    cutoff: of the filter on the test logs [Hz], None without. substeps: of the integrator between samples, for the
    model. parameters: its trained numbers. torque: by predictor, empty where the logs are too sparse. traces: the
    curves behind the figures; those of predictions are the longest horizon's. replays: of commands, of an arm under
    position servos. mass_errors: relative errors of M by predictor, if the truth is known. torque_steps: of joints
    whose torque is logged in steps of its own size, by name [Nm, N].
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

    def to_dict(self) -> dict[str, object]:
        """Return the JSON form, versioned by `schema`."""
        return {"schema": SCHEMA} | record(self)

    @classmethod
    def from_dict(cls, content: Mapping[str, object]) -> Self:
        """Return what `to_dict` gave. Raises ValueError where it is something else."""
        return TypeAdapter(cls).validate_python(content)
