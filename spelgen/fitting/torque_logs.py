"""What the objectives on logs of torques have in common: windows of the logs, and the URDF's regularizer."""

from __future__ import annotations

from typing import TYPE_CHECKING

from spelgen.dynamics.bristles import bristle_reach
from spelgen.dynamics.protocol import has_servos
from spelgen.errors import Diagnostic, OptionError, RunError
from spelgen.fitting.dataset import TrainingData, WindowChoice, prepare_data
from spelgen.fitting.objective import FitRequest, PreparedLogs
from spelgen.fitting.streaming import LargeLogs, prepare_streamed
from spelgen.fitting.urdf_regularizer import UrdfRegularizer, urdf_regularizer
from spelgen.settings.fits import FitConfig
from spelgen.settings.log_mapping import LogMapping
from spelgen.spec import logged_joints

if TYPE_CHECKING:
    from spelgen.emission.loading import EmittedModel


def require_torque_input(model: EmittedModel, config: FitConfig) -> None:
    """Raise OptionError for an arm under position servos, whose logs have no torques."""
    if has_servos(model):
        raise OptionError(
            "objective", f"{config.objective} belongs to logs of torques, this arm has position servos"
        )


def prepare_windows(request: FitRequest, window: int = 5, stride: int = 1) -> TrainingData:
    """Cut windows of the logs of a request: to be fitted, and to be validated on. Raises LogError and RunError."""
    reach = bristle_reach(request.model)
    choice = WindowChoice(window, stride, request.validation, request.seed, reach)
    if not isinstance(request.logs, LargeLogs):
        joints, kinds = logged_joints(request.model), request.model.joint_types
        return prepare_data(request.logs, joints, kinds, request.preprocessing, choice)
    if not isinstance(request.validation, float):
        raise RunError(
            "trajectories to validate logs larger than memory on", expected="a fraction of these logs"
        )
    return prepare_streamed(request.logs, request.preprocessing, choice)


def prepared_logs(request: FitRequest, data: TrainingData, config: FitConfig) -> PreparedLogs:
    """Return what windows tell of the logs."""
    return PreparedLogs(
        config=config,
        preprocessing=data.preprocessing,
        digest=data.digest,
        training=data.training_names,
        validation=data.validation_names,
        training_windows=data.size,
        validation_windows=len(data.validation),
        mapping=request.mapping or LogMapping(),
        notes=data.diagnostics,
        further={"scales": {name: getattr(data.scales, name).tolist() for name in ("q", "qd", "tau")}},
    )


def regularizer_of(
    request: FitRequest, data: TrainingData, weight: float, notes: list[Diagnostic]
) -> UrdfRegularizer | None:
    """Return the regularizer towards the request's URDF, where that has a weight and can be had."""
    urdf = request.urdf
    if not weight or urdf is None or not urdf.exists():
        return None
    try:
        return urdf_regularizer(urdf, logged_joints(request.model), request.model, data.training)
    except Exception as error:  # Pinocchio and its parser raise many kinds; the fit goes on without
        reason = " ".join(f"{type(error).__name__}: {error}".split())
        message = f"fitted without the URDF's regularizer: {reason}"
        notes.append(Diagnostic("info", "no-regularizer", urdf.name, None, message))
        return None
