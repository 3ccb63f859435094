"""The delayed command and linear servos with the parameters that a fit of position servos keeps in its record."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from spelgen.baselines.baseline import Baseline
from spelgen.baselines.linear_servos import DelayedCommand, LinearServos
from spelgen.baselines.names import DELAYED_COMMAND, LINEAR_SERVOS
from spelgen.baselines.predictor import CommandFollower
from spelgen.errors import Diagnostic


class FittedServos(Baseline):
    """`LinearServos` and `DelayedCommand` with the parameters of a fit's record."""

    def followers(
        self, linear_servos: Mapping[str, Any] | None, notes: list[Diagnostic]
    ) -> dict[str, CommandFollower]:
        """Return both; {} and a note for a model without a record."""
        if linear_servos is None:
            message = "no linear servos to compare with: they are fitted by `train`"
            notes.append(Diagnostic("info", "no-linear-servos", "logs", None, message))
            return {}
        servos = LinearServos(**linear_servos)
        return {LINEAR_SERVOS: servos, DELAYED_COMMAND: DelayedCommand(servos.late)}
