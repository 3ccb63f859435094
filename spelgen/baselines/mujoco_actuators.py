"""MuJoCo's position actuators, fitted to the training logs of a run where MuJoCo is installed."""

from __future__ import annotations

import importlib.util
import os
from collections.abc import Sequence

from spelgen.baselines.baseline import Baseline, CommandFollower
from spelgen.baselines.names import POSITION_ACTUATORS
from spelgen.baselines.run_arm import run_arm, run_logs
from spelgen.errors import Diagnostic, LogError, RunError, in_one_line
from spelgen.files import write_json
from spelgen.fitting.dataset import digest
from spelgen.fitting.fitted import Fit
from spelgen.fitting.run_folder import RunFolder, trained_model
from spelgen.fitting.servo.windows import servo_windows
from spelgen.fitting.streaming import LargeLogs
from spelgen.logs.preprocessing import Preprocessing
from spelgen.logs.trajectory import Trajectory

KEPT = "position_actuators"
FILES = "files"


class MujocoActuators(Baseline):
    """Predict an arm as most people simulate it."""

    def fit(self, run: RunFolder, logs: Sequence[Trajectory], files: Sequence[str]) -> dict[str, object]:
        """Return actuators fitted to logs with commands.

        Of files only the paths are kept: it takes as long as the fit, and `followers` does it when an evaluation
        first needs them.
        """
        if any(log.u is None for log in logs):
            return {}
        if files:
            return {FILES: [os.path.abspath(path) for path in files]}
        return fitted_actuators(run, logs)

    def followers(self, fit: Fit | None, notes: list[Diagnostic]) -> dict[str, CommandFollower]:
        """Return the actuators; none, and a note, where the training logs are gone or MuJoCo is not installed."""
        actuators = None
        if fit is not None and fit.folder is not None:
            actuators = kept_actuators(RunFolder(fit.folder))
        if actuators is None:
            message = (
                "no actuators of MuJoCo to compare with: they are fitted where MuJoCo is installed, to the training "
                "logs as long as these stay where they are"
            )
            notes.append(Diagnostic("info", "no-position-actuators", "logs", None, message))
            return {}
        return {POSITION_ACTUATORS: actuators}


def kept_actuators(run: RunFolder) -> CommandFollower | None:
    """Return the actuators that were fitted to the run's training logs, or are now. Raises RunError."""
    if not _has_mujoco() or not run.baseline.exists():
        return None
    record = run.read_json(run.baseline)
    if FILES in record and KEPT not in record:
        record |= _fitted_to_files(run, record[FILES])
        write_json(run.baseline, record)
    if KEPT not in record:
        return None
    from spelgen.baselines.position_actuators import PositionActuators

    try:
        return PositionActuators.of_arm(run_arm(run), **record[KEPT])
    except (TypeError, ValueError) as error:
        raise RunError(
            f"actuators of MuJoCo that cannot be used ({in_one_line(error)})",
            file=run.baseline,
            expected="what `spelgen train` wrote",
            do="train again, or remove the file",
        ) from error


def _fitted_to_files(run: RunFolder, files: Sequence[str]) -> dict[str, object]:
    """Return actuators fitted to the files that the run was trained on; none where these have changed."""
    try:
        logs = run_logs(run, files)
    except LogError:  # moved or removed
        return {}
    if isinstance(logs, LargeLogs) or digest(logs) != run.read_config()["data_digest"]:
        return {}
    return fitted_actuators(run, logs)


def fitted_actuators(run: RunFolder, logs: Sequence[Trajectory]) -> dict[str, object]:
    """Return actuators fitted to these logs; none where MuJoCo is not installed or cannot have the arm's servos."""
    if not _has_mujoco():
        return {}
    from spelgen.baselines.position_actuators import fit_position_actuators
    from spelgen.baselines.tuning import ACTUATORS

    preprocessing = Preprocessing(**run.read_config()["preprocessing"])
    windows = servo_windows(logs, preprocessing, ACTUATORS.windows)
    actuators = fit_position_actuators(run_arm(run), windows, trained_model(run))
    return {} if actuators is None else {KEPT: actuators.to_dict()}


def _has_mujoco() -> bool:
    return importlib.util.find_spec("mujoco") is not None
