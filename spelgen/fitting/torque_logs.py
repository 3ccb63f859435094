"""The base of objectives on logs of torques: windows of the logs, and the URDF's regularizer."""

from __future__ import annotations

from spelgen.dynamics.bristles import bristle_reach
from spelgen.errors import Diagnostic, RunError
from spelgen.fitting.dataset import TrainingData, WindowChoice, prepare_data
from spelgen.fitting.objective import Objective, PreparedLogs
from spelgen.fitting.streaming import LargeLogs, prepare_streamed
from spelgen.fitting.urdf_regularizer import UrdfRegularizer, urdf_regularizer
from spelgen.settings.fits import FitConfig
from spelgen.spec import logged_joints


class TorqueLogObjective(Objective):
    """An `Objective` on logs of torques, which are cut into windows: to fit, or to measure the model on."""

    def _cut_windows(self, window: int, stride: int) -> TrainingData:
        """Cut windows of the logs: to be fitted, and to be validated on. Raises LogError and RunError."""
        request = self.request
        reach = bristle_reach(self.model)
        choice = WindowChoice(window, stride, request.validation, request.seed, reach)
        if not isinstance(request.logs, LargeLogs):
            joints, kinds = logged_joints(self.model), self.model.joint_types
            return prepare_data(request.logs, joints, kinds, request.preprocessing, choice)
        if not isinstance(request.validation, float):
            raise RunError(
                "trajectories to validate logs larger than memory on", expected="a fraction of these logs"
            )
        return prepare_streamed(request.logs, request.preprocessing, choice)

    def _prepared(self, data: TrainingData, config: FitConfig) -> PreparedLogs:
        """Return what windows tell of the logs."""
        return PreparedLogs(
            config=config,
            preprocessing=data.preprocessing,
            record={
                "data_digest": data.digest,
                "training": list(data.training_names),
                "validation": list(data.validation_names),
                "training_windows": len(data.training),
                "validation_windows": len(data.validation),
                "scales": {name: x.tolist() for name, x in data.scales._asdict().items()},
            },
            notes=data.diagnostics,
        )

    def _regularizer(
        self, data: TrainingData, weight: float, notes: list[Diagnostic]
    ) -> UrdfRegularizer | None:
        """Return the regularizer towards the request's URDF, where that has a weight and can be had."""
        urdf = self.request.urdf
        if not weight or urdf is None or not urdf.exists():
            return None
        try:
            return urdf_regularizer(urdf, logged_joints(self.model), self.model, data.training)
        except Exception as error:  # Pinocchio and its parser raise many kinds; the fit goes on without
            reason = " ".join(f"{type(error).__name__}: {error}".split())
            message = f"fitted without the URDF's regularizer: {reason}"
            notes.append(Diagnostic("info", "no-regularizer", urdf.name, None, message))
            return None
