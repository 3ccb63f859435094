"""Keep in a run's folder what any model of the arm has to beat: baselines fitted to the run's own training logs."""

from __future__ import annotations

import os
from collections.abc import Iterable, Sequence
from pathlib import Path

from spelgen.baselines.registry import BASELINES
from spelgen.baselines.run_arm import run_logs
from spelgen.files import write_json
from spelgen.fitting.run_folder import RunFolder
from spelgen.logs.trajectory import Trajectory, coverage


def keep_baseline(folder: Path | str, logs: Iterable[Path | str] | Sequence[Trajectory]) -> None:
    """Fit baselines to the logs, or log files, that a run was trained on, those of validation included.

    What the logs cover is kept beside them. A run without URDF is left as it is; logs that are too sparse for
    accelerations give no parameters of least squares. Of an arm under position servos MuJoCo's actuators are fitted,
    where MuJoCo is installed: to files when an evaluation first needs them, for it takes as long as the fit.
    """
    run = RunFolder(folder)
    sources = list(logs)
    trajectories = [log for log in sources if isinstance(log, Trajectory)]
    files = [os.fspath(log) for log in sources if not isinstance(log, Trajectory)]
    only_files = not trajectories
    if files:
        trajectories += run_logs(run, files)
    if not run.urdf.exists():  # without an arm there is nothing to identify
        return
    baselines: dict[str, object] = {"coverage": coverage(trajectories)}
    for baseline in BASELINES:
        baselines |= baseline.fit(run, trajectories, files if only_files else ())
    write_json(run.baseline, baselines)
