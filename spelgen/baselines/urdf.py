"""Baselines with the URDF's own values: rigid bodies, damping and friction, computed by Pinocchio.

A second one adds the drives of the settings beside the URDF, if these define any.
"""

from __future__ import annotations

from spelgen.baselines.baseline import Baseline, EvaluatedArm
from spelgen.baselines.names import URDF, URDF_WITH_DRIVES
from spelgen.baselines.predictor import Predictor, of_dynamics
from spelgen.errors import Diagnostic, in_one_line


class UrdfValues(Baseline):
    """The dynamics that the URDF specifies."""

    def predictors(self, arm: EvaluatedArm) -> list[Predictor]:
        """Return one or two predictors; [] and a note if Pinocchio cannot read the file or is not installed."""
        if arm.urdf is None:
            arm.notes.append(_missing("robot.urdf", "no arm is known"))
            return []
        try:
            from spelgen.dynamics.pinocchio_urdf import drives_known, urdf_dynamics  # an extra

            plain = urdf_dynamics(arm.urdf, arm.joints)
            predictors = [of_dynamics(URDF, plain, arm.probe)]
            if drives_known(arm.urdf, arm.joints):
                driven = urdf_dynamics(arm.urdf, arm.joints, drives=True)
                predictors.append(of_dynamics(URDF_WITH_DRIVES, driven, arm.probe))
        except (
            Exception
        ) as error:  # Pinocchio and its parser raise many kinds; the evaluation continues without it
            arm.notes.append(_missing(arm.urdf.name, in_one_line(error)))
            return []
        return predictors


def _missing(where: str, reason: str) -> Diagnostic:
    return Diagnostic("info", "no-urdf-baseline", where, None, f"no comparison with the URDF: {reason}")
