"""Least squares on a run's own training logs, kept in its folder: what any model of the arm has to beat. Of torques, or
of an arm under position servos, of MuJoCo's actuators.
"""

from __future__ import annotations

import importlib.util
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from spelgen.errors import LogError, RunError
from spelgen.evaluation.names import LEAST_SQUARES, LEAST_SQUARES_WITH_MEMORY, POSITION_ACTUATORS
from spelgen.files import write_json
from spelgen.fitting.run_folder import RunFolder, trained_model
from spelgen.fitting.servo_windows import servo_windows
from spelgen.fitting.streaming import LargeLogs
from spelgen.fitting.train import open_logs
from spelgen.identification.friction import FrictionModel
from spelgen.identification.identification import identified_dynamics
from spelgen.identification.identify import identify
from spelgen.identification.method import LeastSquares
from spelgen.loaded_arm import LoadedArm, load_arm
from spelgen.logs.coverage import coverage
from spelgen.logs.preprocessing import Preprocessing
from spelgen.logs.trajectory import Trajectory
from spelgen.settings.log_mapping import LogMapping
from spelgen.spec import read_facts

REMEMBERING = FrictionModel(memory=True)


def run_arm(run: RunFolder) -> LoadedArm:
    """The arm that a run's module was built from. Raises RunError where the run has no URDF."""
    if not run.urdf.exists():
        raise RunError("no robot.urdf", file=run.path, do="train with --robot")
    options = read_facts(run.module).options
    return load_arm(run.urdf, read_facts(run.module).joints, options.tip, options.angle_tolerance)


def keep_baseline(folder: Path | str, logs: Iterable[Path | str] | Sequence[Trajectory]) -> None:
    """Identify a run folder's arm from the logs, or log files, that it was trained on, those of validation included.

    What the logs cover is kept beside it. A run without URDF and logs larger than memory are left as they are; logs
    that are too sparse for accelerations give no parameters. Of an arm under position servos MuJoCo's actuators are
    fitted instead, where MuJoCo is installed.
    """
    run, given = RunFolder(Path(folder)), list(logs)
    record = run.read_config()
    trajectories: Any = [each for each in given if isinstance(each, Trajectory)]
    if not trajectories:
        paths = [each for each in given if not isinstance(each, Trajectory)]
        trajectories = open_logs(run.load_module(), paths, LogMapping(**record["mapping"]))
    if isinstance(trajectories, LargeLogs) or not run.urdf.exists():
        return
    found: dict[str, Any] = {"coverage": coverage(trajectories)}
    arm, used = run_arm(run), Preprocessing(**record["preprocessing"])
    if record["objective"] == "servo":
        found |= _position_actuators(run, arm, trajectories, used)
    else:
        found |= _identified(arm, trajectories, used)
    write_json(run.baseline, found)


def _identified(arm: LoadedArm, trajectories: Sequence[Trajectory], used: Preprocessing) -> dict[str, Any]:
    try:
        fit = identify(arm, trajectories, preprocessing=used)
        remembering = identify(arm, trajectories, LeastSquares(friction=REMEMBERING), preprocessing=used)
    except (LogError, np.linalg.LinAlgError):
        return {}
    found = fit.to_dict() | {"parameters": fit.parameters.tolist()}
    return found | {"parameters_with_memory": remembering.parameters.tolist()}


def _position_actuators(
    run: RunFolder, arm: LoadedArm, trajectories: Sequence[Trajectory], used: Preprocessing
) -> dict[str, Any]:
    if not _has_mujoco():
        return {}
    from spelgen.baselines.position_actuators import MOST, fit_position_actuators

    found = fit_position_actuators(arm, servo_windows(trajectories, used, MOST), trained_model(run))
    return {} if found is None else {"position_actuators": found.to_dict()}


def _has_mujoco() -> bool:
    return importlib.util.find_spec("mujoco") is not None


def read_baseline(run: RunFolder) -> dict[str, Any]:
    """What ``keep_baseline`` found, by name: `RegressorDynamics`, or `PositionActuators`, which follow commands. None
    where it found none, and none in MuJoCo where that is not installed.
    """
    path = run.baseline
    found = run.read_json(path) if path.exists() else {}
    if "position_actuators" in found and _has_mujoco():
        from spelgen.baselines.position_actuators import PositionActuators

        try:
            return {POSITION_ACTUATORS: PositionActuators.from_dict(found["position_actuators"])}
        except (KeyError, TypeError, ValueError, SyntaxError) as error:
            told = " ".join(str(error).split())
            raise RunError(
                f"actuators of MuJoCo that cannot be used ({type(error).__name__}: {told})",
                file=path,
                expected="what `spelgen train` wrote",
                do="train again, or remove the file",
            ) from error
    if "parameters" not in found:
        return {}
    arm = run_arm(run)
    drives = arm.actuation.drives()
    kept = {
        LEAST_SQUARES: (FrictionModel(), found["parameters"]),
        LEAST_SQUARES_WITH_MEMORY: (REMEMBERING, found["parameters_with_memory"]),
    }
    return {
        name: identified_dynamics(arm.arm, friction, np.array(parameters), drives)
        for name, (friction, parameters) in kept.items()
    }
