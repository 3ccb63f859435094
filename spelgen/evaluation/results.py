"""The results of an evaluation: the content of evaluation.json, shown in terminals and notebooks."""

from __future__ import annotations

import textwrap
from collections.abc import Mapping
from dataclasses import dataclass, field
from html import escape

from pydantic import TypeAdapter

from spelgen.errors import Diagnostic
from spelgen.evaluation.horizons import Horizon
from spelgen.evaluation.plain import record
from spelgen.evaluation.replay import Replay
from spelgen.evaluation.tables import result_tables
from spelgen.evaluation.torque import TorqueErrors
from spelgen.evaluation.traces import Traces
from spelgen.labels import MODEL, counted
from spelgen.listing import WIDTH

# Version of the format of evaluation.json. It changes if files of an earlier version cannot be read any more.
SCHEMA = 12


@dataclass(frozen=True)
class Verdict:
    """The assessment of an evaluation in words.

    sentence: suitable and unsuitable uses of the model, and motions to record next. because: errors and reasons that
    support the sentence.
    """

    sentence: str
    because: str


@dataclass(frozen=True, repr=False)
class Results:
    """All results of an evaluation, stored in evaluation.json, and shown as an assessment and tables.

    Attributes:
        robot: Name of the robot.
        joints: Names of the joints.
        joint_types: Types of the joints.
        trajectories: Names of the test logs.
        parameters: Number of trained parameters.
        diagnostics: Warnings and notes about the logs and the evaluation.
        traces: Curves from which the errors are computed; predictions are over the longest horizon.
        cutoff: Cutoff frequency of the filter of the test logs [Hz]; None without a filter.
        horizons: Errors of predicted motion, one entry per horizon.
        torque: {predictor: torque errors}; empty if the sample rate is too low for accelerations.
        torque_steps: {joint: quantisation step of its torque [Nm, N]}, see `coarse_torques`.
        replays: Errors of replayed commands, for an arm under position servos.
        mass_errors: {predictor: relative error of M}; empty if the true M is unknown.
        assessment: Assessment of the model in words; None before it is added.
    """

    robot: str
    joints: tuple[str, ...]
    joint_types: tuple[str, ...]
    trajectories: tuple[str, ...]
    parameters: int
    diagnostics: tuple[Diagnostic, ...]
    traces: Traces
    cutoff: float | None = None
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
    def from_dict(cls, content: Mapping[str, object]) -> Results:
        """Return the results of an evaluation from an object that `to_dict` has returned.

        Raises ValueError for other content.
        """
        return TypeAdapter(cls).validate_python(content)

    def text(self) -> str:
        """Return the assessment and all tables as text; a star marks the smallest error of each row."""
        paragraphs = [f"{self._heading()}; * marks the best of a row"]
        paragraphs += [table.text() for table in result_tables(self)]
        if self.assessment is not None:
            words = f"{self.assessment.sentence} {self.assessment.because}"
            # Lines are not broken at hyphens: a text search would not find a name with a line break.
            paragraphs.insert(0, textwrap.fill(words, WIDTH, break_on_hyphens=False))
        return "\n\n".join(paragraphs)

    def __repr__(self) -> str:
        heading = self._heading()
        for last in self.horizons[-1:]:
            error = last.errors[MODEL].mean_relative_rms
            if error is not None:
                heading += f", relative RMS {error:.3g} after {last.name}"
        return f"<Results of {heading}>"

    def _repr_html_(self) -> str:
        sentence = "" if self.assessment is None else self.assessment.sentence
        tables = [table.html() for table in result_tables(self)]
        return "".join([f"<p>{escape(sentence)}</p>", *tables])

    def _heading(self) -> str:
        return f"{self.robot} on {counted(len(self.trajectories), 'test trajectory')}"
