"""Commands that come late, and linear servos: what fits of position servos find first and keep in their record."""

from __future__ import annotations

from spelgen.baselines.baseline import Baseline, CommandFollower
from spelgen.baselines.names import DELAYED_COMMAND, LINEAR_SERVOS
from spelgen.errors import Diagnostic
from spelgen.fitting.fitted import Fit
from spelgen.fitting.servo.linear_servos import DelayedCommand, LinearServos


class FittedServos(Baseline):
    """Predict each joint by itself."""

    def followers(self, fit: Fit | None, notes: list[Diagnostic]) -> dict[str, CommandFollower]:
        """Return linear servos, and the delayed command; none, and a note, for a model without a record."""
        if fit is None or "servo" not in fit.record:
            message = "no linear servos to compare with: they are fitted by `train`"
            notes.append(Diagnostic("info", "no-linear-servos", "logs", None, message))
            return {}
        servos = LinearServos(**fit.record["servo"]["linear"])
        return {LINEAR_SERVOS: servos, DELAYED_COMMAND: DelayedCommand(servos.late)}
