"""Judge the URDF's own values: rigid bodies with its damping and friction, by Pinocchio.

A second baseline has the drives of the settings beside the URDF, where these name any.
"""

from __future__ import annotations

from spelgen.baselines.baseline import Baseline, JudgedArm
from spelgen.baselines.names import URDF, URDF_WITH_DRIVES
from spelgen.baselines.predictor import Predictor, of_dynamics
from spelgen.errors import Diagnostic, in_one_line


class UrdfValues(Baseline):
    """Take an arm for what its URDF says."""

    def predictors(self, judged: JudgedArm) -> list[Predictor]:
        """Return one or two predictors; none, and a note, where Pinocchio cannot read the file or is not installed."""
        if judged.urdf is None:
            judged.notes.append(_missing("robot.urdf", "no arm is known"))
            return []
        try:
            from spelgen.dynamics.pinocchio_urdf import has_drives, urdf_dynamics  # an extra

            plain = urdf_dynamics(judged.urdf, judged.joints)
            predictors = [of_dynamics(URDF, plain, judged.probe)]
            if has_drives(judged.urdf, judged.joints):
                driven = urdf_dynamics(judged.urdf, judged.joints, drives=True)
                predictors.append(of_dynamics(URDF_WITH_DRIVES, driven, judged.probe))
        except Exception as error:  # Pinocchio and its parser raise many kinds; the evaluation stands without
            judged.notes.append(_missing(judged.urdf.name, in_one_line(error)))
            return []
        return predictors


def _missing(where: str, reason: str) -> Diagnostic:
    return Diagnostic("info", "no-urdf-baseline", where, None, f"no comparison with the URDF: {reason}")
