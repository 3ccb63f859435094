"""Errors on real logs, compared with published baselines: all numbers of docs/real_logs.md in one command.

    python benchmarks/real_logs.py [FOLDER]

FOLDER is made by `python benchmarks/recordings.py FOLDER`, by default runs/recordings. Torque errors are nMSE (mean
squared error divided by the torque's variance, mean over joints), once over the moving samples and once with the pauses
between motions; the published errors of the baselines include pauses. All fits have the default settings of `spelgen
train`, which also estimates the delay of the torques. Least squares is fitted to the same samples.
"""

from __future__ import annotations

import copy
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch

sys.path.insert(0, str(Path(__file__).parent))
sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))

from delan_characters import TESTS as CHARACTERS
from delan_characters import read_characters, write_arm
from recordings import folder_of, panda_urdf

import spelgen
from spelgen.arm.arm import Chain
from spelgen.arm.configured_arm import load_arm
from spelgen.baselines.predictor import Solver
from spelgen.dynamics.bristles import bristle_reach, reach_of
from spelgen.dynamics.friction import FrictionModel
from spelgen.emission.build import build
from spelgen.errors import LogError
from spelgen.evaluation.horizons import end_errors
from spelgen.evaluation.torque import mean_nmse, predicted_torques
from spelgen.fitting.fitted import Fit
from spelgen.fitting.torque.fit import fit_torque
from spelgen.identification.identification import Identification, LeastSquares
from spelgen.identification.identify import least_squares
from spelgen.logs.dynamics_samples import DynamicsSamples, dynamics_samples
from spelgen.logs.preprocessing import Preprocessing
from spelgen.logs.read import read_logs
from spelgen.logs.trajectory import Trajectory
from spelgen.logs.windows import Windows, cut_windows, joined

Torque = Callable[[DynamicsSamples], np.ndarray]

TRAINING = ("20_02_10_30sec_12harm", "20_02_12_50sec_12harm", "20_02_05_20sec_8harm")
TESTS = (
    "19_12_23_free", "20_01_31_unload", "20_02_05_20sec_12harm", "20_02_06_20sec_10harm", "20_02_06_20sec_5harm",
    "20_02_10_20sec_7harm", "20_02_12_40sec_12harm", "20_02_19_14harm50sec", "20_02_19_15harm50sec",
)  # fmt: skip
OUTSIDE = "20_01_17_ptp_10_points"
LOADED = ("20_01_13_load_2600", "20_01_31_load", "20_02_19_14harm50secLoad")
AHEAD = {"0.1 s": 10, "0.5 s": 47}  # prediction horizons, in samples at 94 Hz
WINDOWS = 60  # predicted windows per trajectory
SUBSTEPS = 4


def main() -> None:
    torch.set_num_threads(1)
    logs = folder_of(sys.argv[1] if len(sys.argv) > 1 else None)
    with tempfile.TemporaryDirectory() as scratch:
        ur10e(logs / "ur10e")
        panda(logs / "panda", panda_urdf(logs))
        characters(logs / "delan_characters", Path(scratch))


def ur10e(folder: Path) -> None:
    urdf = folder / "ur10e.urdf"
    arm = load_arm(urdf).chain
    logs = {name: read(folder / f"{name}.parquet", arm) for name in (*TRAINING, *TESTS, OUTSIDE, *LOADED)}
    since = time.perf_counter()
    fit = trained(urdf, [logs[name] for name in TRAINING])
    print(
        f"UR10e: the closed-form model is fitted to 100 s of three logs in {time.perf_counter() - since:.0f} s\n"
    )
    training = samples_of(fit, [logs[name] for name in TRAINING])
    tests = [samples_of(fit, [logs[x] for x in (*TESTS, OUTSIDE)], pauses=pauses) for pauses in (True, False)]
    baseline = least_squares(arm, training, LeastSquares("range"))
    features = FrictionModel(stribeck=True, polynomial=True)
    predictors = {
        "least squares": torque_of(baseline.dynamics),
        "with features": least_squares_torque(arm, training, features),
        "with memory": least_squares_torque(arm, training, FrictionModel(memory=True)),
        "closed-form": torque_of(fit.model),
    }
    for samples, said in zip(tests, ("pauses included", "moving samples alone"), strict=True):
        table(f"Torque nMSE, {said}", predictors, samples, len(TESTS))
    rollouts(fit.model, baseline, [logs[name] for name in TESTS])
    payload(fit, logs)
    other_days(fit, logs)


def table(
    title: str, predictors: dict[str, Torque], samples: Sequence[DynamicsSamples], counted: int
) -> None:
    print(title + "\n\n" + " " * 26 + "".join(f"{name:>15}" for name in predictors))
    errors = np.array([[nmse(torque, sample) for torque in predictors.values()] for sample in samples])
    rows = [*zip((x.name for x in samples), errors, strict=True)]
    rows.insert(counted, (f"mean of the {counted}", errors[:counted].mean(axis=0)))
    for name, row in rows:
        print(f"{name:26}" + "".join(f"{x:15.5f}" for x in row))
    print()


def payload(fit: Fit, logs: dict[str, Trajectory]) -> None:
    print("A load at the tip: the last body alone is fitted to the first 10 s, judged on the rest\n")
    print(f"{'':26}{'as trained':>15}{'adapted':>15}{'adapted, 3 s':>15}")
    for name in LOADED:
        row = [missed_after(fit, logs[name], 10.0)]
        for seconds in (10.0, 3.0):
            try:
                row.append(
                    missed_after(adapted(fit, first(logs[name], seconds), "load"), logs[name], seconds)
                )
            except LogError:  # nothing moves within the first `seconds` seconds
                row.append(np.nan)
        print(f"{name:26}" + "".join(f"{x:15.5f}" for x in row))
    print()


def other_days(fit: Fit, logs: dict[str, Trajectory]) -> None:
    """Print torque errors of the trained model, and of models adapted to each test recording, made on other days.

    The first 10 s of a recording are used to refit friction and torque offsets (column "friction"), or all parameters,
    as for another robot of the same type (column "another unit"). All errors are nMSE on the remainder of the
    recording. logs: {name: recording}.
    """
    print(
        "Friction and torque offsets fitted to the first 10 s of each, judged on the rest, pauses included\n"
    )
    print(f"{'':26}{'as trained':>15}{'friction':>15}{'another unit':>15}")
    rows = []
    for name in TESTS:
        row = [missed_after(fit, logs[name], 10.0)]
        for adapt in ("friction", "unit"):
            row.append(missed_after(adapted(fit, first(logs[name], 10.0), adapt), logs[name], 10.0))
        rows.append(row)
        print(f"{name:26}" + "".join(f"{x:15.5f}" for x in row))
    print(f"{'mean':26}" + "".join(f"{x:15.5f}" for x in np.mean(rows, axis=0)) + "\n")


def adapted(fit: Fit, log: Trajectory, adapt: Any) -> Fit:
    """Return a fit whose model is a copy of `fit.model`, adapted to a log, as by `spelgen train --from`.

    adapt: parameters to refit: "load" (the last body), "friction" (friction and torque offsets) or "unit" (all).
    """
    return spelgen.fit(copy.deepcopy(fit.model), log, spelgen.TorqueFit(adapt=adapt), arm=fit.urdf)


def missed_after(fit: Fit, log: Trajectory, seconds: float) -> float:
    return mean(torque_of(fit.model), samples_of(fit, [after(log, seconds)], pauses=True))


def rollouts(model: Any, found: Identification, logs: Sequence[Trajectory]) -> None:
    print(
        "Predicted states on the nine, error relative to the motion (mean of joints, position and velocity)\n"
    )
    print(f"{'':26}{'least squares':>15}{'closed-form':>15}")
    for name, steps in AHEAD.items():
        windows = tested(logs, steps)
        with torch.no_grad():
            row = [relative_error(x, windows) for x in (found.dynamics, model)]
        print(f"{name:26}" + "".join(f"{x:15.4f}" for x in row))
    print()


def tested(logs: Sequence[Trajectory], steps: int) -> Windows:
    """Return about `WINDOWS` evenly spread windows per log, of filtered samples, for predictions of `steps` samples."""
    filtered = Preprocessing(cutoff=8.0)
    pieces = [piece for x in logs for piece in filtered.pieces([x], shortest=steps + 1)]
    cut = []
    for x in pieces:
        reach = reach_of(["revolute"] * x.q.shape[1])
        stride = max(1, (len(x) - steps) // WINDOWS)
        cut.append(cut_windows([x], steps + 1, stride, measured=True, reach=reach))
    return joined(cut)


def relative_error(dynamics: Any, windows: Windows) -> float:
    predicted = Solver(dynamics, SUBSTEPS)(windows)
    found = end_errors(predicted, windows, ("revolute",) * windows.q.shape[-1], None)
    return found.mean_relative_rms or np.nan


def panda(folder: Path, urdf: Path) -> None:
    arm = load_arm(urdf).chain
    whole = read(folder / "exciting_traj1.parquet", arm)
    fit = trained(urdf, [first(whole, 12.0)])
    training, test = samples_of(fit, [first(whole, 12.0)]), samples_of(fit, [after(whole, 12.0)])
    frictions = {f"tanh {width:g}": FrictionModel(width) for width in (0.02, 0.05)}
    frictions["with memory"] = FrictionModel(memory=True)
    predictors = {name: least_squares_torque(arm, training, friction) for name, friction in frictions.items()}
    table(
        "Panda: first 12 s train, last 9 s test", predictors | {"closed-form": torque_of(fit.model)}, test, 1
    )


def characters(folder: Path, scratch: Path) -> None:
    urdf = write_arm(scratch)
    model, hybrid = build(urdf, "closed-form"), build(urdf, "hybrid")
    samples, forces = read_characters(folder)
    training = [x for x in samples if x.name not in CHARACTERS]
    fit_torque(model, training)
    fit_torque(hybrid, training)
    tests = [i for i, x in enumerate(samples) if x.name in CHARACTERS]
    q, qd, qdd = (
        torch.from_numpy(np.concatenate([getattr(samples[i], k) for i in tests])) for k in ("q", "qd", "qdd")
    )
    tau, coriolis = (np.concatenate(x) for x in ([samples[i].tau for i in tests], [forces[i] for i in tests]))
    print("Characters (DeLaN's data): nMSE, total error by total variance\n")
    print(f"{'':26}{'closed-form':>15}{'hybrid':>15}")
    found = [_torques(each, q, qd, qdd) for each in (model, hybrid)]
    for name, true, columns in (
        ("torque", tau, [each[0] for each in found]),
        ("Coriolis torque", coriolis, [each[1] for each in found]),
    ):
        variance = np.square(true - true.mean(axis=0)).sum()
        print(f"{name:26}" + "".join(f"{np.square(x - true).sum() / variance:15.1e}" for x in columns))


def _torques(
    model: Any, q: torch.Tensor, qd: torch.Tensor, qdd: torch.Tensor
) -> tuple[np.ndarray, np.ndarray]:
    """Return the model's torque along a motion (T, n), and its Coriolis and centrifugal part, both (T, n) [Nm]."""
    with torch.no_grad():
        steady, still = (model.inverse_dynamics(q, x, torch.zeros_like(q)) for x in (qd, torch.zeros_like(q)))
        friction = model.friction_torque(q, qd)
        return model.inverse_dynamics(q, qd, qdd).numpy(), (steady - still - friction).numpy()


def trained(urdf: Path, logs: Sequence[Trajectory], preset: str = "closed-form") -> Fit:
    """Return the fit of a preset to the logs, as by `spelgen train`."""
    return spelgen.fit(build(urdf, preset), logs, arm=urdf)


def samples_of(fit: Fit, logs: Sequence[Trajectory], *, pauses: bool = False) -> list[DynamicsSamples]:
    """Return the filtered torque samples of logs, as `spelgen train` and `evaluate` use them.

    pauses: if True, samples at standstill between motions are included.
    """
    reach = bristle_reach(fit.model)
    return dynamics_samples(logs, pauses=pauses, preprocessing=fit.preprocessing, reach=reach)


def read(path: Path, arm: Chain) -> Trajectory:
    (trajectory,) = read_logs([path], [coordinate.name for coordinate in arm.coordinates])
    return trajectory


def first(trajectory: Trajectory, seconds: float) -> Trajectory:
    return trajectory[: int(np.searchsorted(trajectory.t, trajectory.t[0] + seconds))]


def after(trajectory: Trajectory, seconds: float) -> Trajectory:
    return trajectory[int(np.searchsorted(trajectory.t, trajectory.t[0] + seconds)) :]


def torque_of(dynamics: Any) -> Torque:
    return partial(predicted_torques, dynamics)


def least_squares_torque(arm: Chain, training: Sequence[DynamicsSamples], friction: FrictionModel) -> Torque:
    return torque_of(least_squares(arm, training, LeastSquares("range", friction=friction)).dynamics)


def nmse(torque: Torque, sample: DynamicsSamples) -> float:
    found = mean_nmse(torque(sample) - sample.tau, sample.tau)
    return np.inf if found is None else found


def mean(torque: Torque, samples: Sequence[DynamicsSamples]) -> float:
    return float(np.mean([nmse(torque, sample) for sample in samples]))


if __name__ == "__main__":
    main()
