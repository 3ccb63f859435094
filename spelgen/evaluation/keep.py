"""Keep in a run's folder what any model of the arm has to beat: least squares on the run's own training logs.

They are least squares of torques or, of an arm under position servos, MuJoCo's actuators.
"""

from __future__ import annotations

import importlib.util
import os
from collections.abc import Iterable, Sequence
from pathlib import Path

from spelgen.baselines.baseline import CommandFollower
from spelgen.baselines.names import POSITION_ACTUATORS
from spelgen.baselines.registry import BASELINES
from spelgen.baselines.run_arm import run_arm
from spelgen.errors import LogError, RunError
from spelgen.files import write_json
from spelgen.fitting.dataset import digest
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
    fitted instead, where MuJoCo is installed: to files when an evaluation first needs them, for it takes as long as
    the fit.
    """
    run = RunFolder(Path(folder))
    trajectories, paths = [], []
    for log in logs:
        if isinstance(log, Trajectory):
            trajectories.append(log)
        else:
            paths.append(log)
    only_files = not trajectories
    if paths:
        opened = _opened(run, paths)
        if isinstance(opened, LargeLogs):  # least squares takes all samples at once
            return
        trajectories += opened
    if not run.urdf.exists():  # without an arm there is nothing to identify
        return
    baselines: dict[str, object] = {"coverage": coverage(trajectories)}
    if run.read_config()["objective"] == "servo":
        if only_files:
            baselines["files"] = [os.path.abspath(path) for path in paths]
        else:
            baselines |= _fit_position_actuators(run, trajectories)
    else:
        for baseline in BASELINES:
            baselines |= baseline.fit(run, trajectories, _preprocessing(run))
    write_json(run.baseline, baselines)


def _opened(run: RunFolder, paths: Iterable[Path | str]) -> Sequence[Trajectory] | LargeLogs:
    """Return log files read as those that the run was trained on. Raises LogError."""
    return open_logs(run.load_module(), paths, LogMapping(**run.read_config()["mapping"]))


def _preprocessing(run: RunFolder) -> Preprocessing:
    return Preprocessing(**run.read_config()["preprocessing"])


def _fit_position_actuators(run: RunFolder, trajectories: Sequence[Trajectory]) -> dict[str, object]:
    if not _has_mujoco():
        return {}
    from spelgen.evaluation.position_actuators import TUNING, fit_position_actuators

    windows = servo_windows(trajectories, _preprocessing(run), TUNING.windows)
    actuators = fit_position_actuators(run_arm(run), windows, trained_model(run))
    if actuators is None:
        return {}
    return {"position_actuators": actuators.to_dict()}


def _fitted_to_files(run: RunFolder, files: Sequence[str]) -> dict[str, object]:
    """Return MuJoCo's actuators, fitted to the files that the run was trained on; none where these have changed."""
    try:
        logs = _opened(run, files)
    except LogError:  # moved or removed
        return {}
    if isinstance(logs, LargeLogs) or digest(logs) != run.read_config()["data_digest"]:
        return {}
    return _fit_position_actuators(run, logs)


def _has_mujoco() -> bool:
    return importlib.util.find_spec("mujoco") is not None


def read_followers(run: RunFolder) -> dict[str, CommandFollower]:
    """Return by name the actuators of MuJoCo that were fitted to the run's training logs, or are now.

    There are none where these logs are gone, or where MuJoCo is not installed.
    """
    path = run.baseline
    record = run.read_json(path) if path.exists() else {}
    if not _has_mujoco():
        return {}
    if "files" in record and "position_actuators" not in record:
        record |= _fitted_to_files(run, record["files"])
        write_json(path, record)
    if "position_actuators" not in record:
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
