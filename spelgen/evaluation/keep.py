"""Least squares on a run's own training logs, kept in its folder: what any model of the arm has to beat. Of torques, or
of an arm under position servos, of MuJoCo's actuators.
"""

from __future__ import annotations

import importlib.util
from collections.abc import Iterable, Sequence
from pathlib import Path

from spelgen.baselines.baseline import CommandFollower
from spelgen.baselines.names import POSITION_ACTUATORS
from spelgen.baselines.registry import BASELINES
from spelgen.baselines.run_arm import run_arm
from spelgen.errors import RunError
from spelgen.files import write_json
from spelgen.fitting.run_folder import RunFolder, trained_model
from spelgen.fitting.servo.windows import servo_windows
from spelgen.fitting.streaming import LargeLogs
from spelgen.fitting.train import open_logs
from spelgen.logs.coverage import coverage
from spelgen.logs.preprocessing import Preprocessing
from spelgen.logs.trajectory import Trajectory
from spelgen.settings.log_mapping import LogMapping


def keep_baseline(folder: Path | str, logs: Iterable[Path | str] | Sequence[Trajectory]) -> None:
    """Identify a run folder's arm from the logs, or log files, that it was trained on, those of validation included.

    What the logs cover is kept beside it. A run without URDF and logs larger than memory are left as they are; logs
    that are too sparse for accelerations give no parameters. Of an arm under position servos MuJoCo's actuators are
    fitted instead, where MuJoCo is installed.
    """
    run = RunFolder(Path(folder))
    record = run.read_config()
    trajectories, paths = [], []
    for log in logs:
        if isinstance(log, Trajectory):
            trajectories.append(log)
        else:
            paths.append(log)
    if paths:
        opened = open_logs(run.load_module(), paths, LogMapping(**record["mapping"]))
        if isinstance(opened, LargeLogs):  # least squares takes all samples at once
            return
        trajectories += opened
    if not run.urdf.exists():  # without an arm there is nothing to identify
        return
    baselines: dict[str, object] = {"coverage": coverage(trajectories)}
    preprocessing = Preprocessing(**record["preprocessing"])
    if record["objective"] == "servo":
        baselines |= _fit_position_actuators(run, trajectories, preprocessing)
    else:
        for baseline in BASELINES:
            baselines |= baseline.fit(run, trajectories, preprocessing)
    write_json(run.baseline, baselines)


def _fit_position_actuators(
    run: RunFolder, trajectories: Sequence[Trajectory], preprocessing: Preprocessing
) -> dict[str, object]:
    if not _has_mujoco():
        return {}
    from spelgen.evaluation.position_actuators import TUNING, fit_position_actuators

    windows = servo_windows(trajectories, preprocessing, TUNING.windows)
    actuators = fit_position_actuators(run_arm(run), windows, trained_model(run))
    if actuators is None:
        return {}
    return {"position_actuators": actuators.to_dict()}


def _has_mujoco() -> bool:
    return importlib.util.find_spec("mujoco") is not None


def read_followers(run: RunFolder) -> dict[str, CommandFollower]:
    """Return the actuators of MuJoCo that `keep_baseline` fitted, by name; none where it fitted none, or where MuJoCo
    is not installed.
    """
    path = run.baseline
    record = run.read_json(path) if path.exists() else {}
    if "position_actuators" not in record or not _has_mujoco():
        return {}
    from spelgen.evaluation.position_actuators import PositionActuators

    try:
        return {POSITION_ACTUATORS: PositionActuators.from_dict(record["position_actuators"])}
    except (KeyError, TypeError, ValueError, SyntaxError) as error:
        reason = " ".join(str(error).split())
        raise RunError(
            f"actuators of MuJoCo that cannot be used ({type(error).__name__}: {reason})",
            file=path,
            expected="what `spelgen train` wrote",
            do="train again, or remove the file",
        ) from error
