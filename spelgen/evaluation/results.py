"""The results of an evaluation: evaluation.json, and its figures as people read them, in terminals and notebooks."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from html import escape

from pydantic import TypeAdapter

from spelgen.baselines.names import MODEL
from spelgen.errors import Diagnostic
from spelgen.evaluation.horizons import Horizon
from spelgen.evaluation.plain import record
from spelgen.evaluation.replay import Replay
from spelgen.evaluation.tables import result_tables
from spelgen.evaluation.torque import TorqueErrors
from spelgen.evaluation.traces import Traces
from spelgen.evaluation.verdict import verdict
from spelgen.labels import counted

SCHEMA = 9


@dataclass(frozen=True, repr=False)
class Results:
    """Gather what `evaluate` measures; `to_dict` is evaluation.json.

    cutoff: of the filter on the test logs [Hz], None without. substeps: of the integrator between samples, for the
    model. parameters: its trained numbers. torque: by predictor, empty where the logs are too sparse. traces: the
    curves behind the figures; those of predictions are the longest horizon's. replays: of commands, of an arm under
    position servos. torque_steps: of joints whose torque is logged in steps of its own size, by name [Nm, N].
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

    def to_dict(self) -> dict[str, object]:
        """Return the JSON form, versioned by `schema`."""
        return {"schema": SCHEMA} | record(self)

    @classmethod
    def from_dict(cls, content: Mapping[str, object]) -> Results:
        """Return what `to_dict` gave. Raises ValueError where it is something else."""
        return TypeAdapter(cls).validate_python(content)

    def text(self) -> str:
        """Return every table for a terminal, the best of each row starred."""
        tables = [table.text() for table in result_tables(self)]
        return "\n\n".join([f"{self._heading()}; * marks the best of a row", *tables])

    def __repr__(self) -> str:
        heading = self._heading()
        if self.horizons:
            last = self.horizons[-1]
            error = last.errors[MODEL].mean_relative_rms
            if error is not None:
                heading += f", relative RMS {error:.3g} after {last.name}"
        return f"<Results of {heading}>"

    def _repr_html_(self) -> str:
        tables = [table.listing().html() for table in result_tables(self)]
        return "".join([f"<p>{escape(verdict(self).sentence)}</p>", *tables])

    def _heading(self) -> str:
        return f"{self.robot} on {counted(len(self.trajectories), 'test trajectory')}"
