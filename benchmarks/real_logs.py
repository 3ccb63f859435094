"""Real logs beside published baselines: every figure of docs/real_logs.md in one command.

    python benchmarks/real_logs.py [LOGS]

LOGS is ../shared/logs beside the checkout by default. Torque errors are nMSE (mean squared error by the torque's
variance, mean of the joints), once over the samples that move and once with the pauses between motions; the second is
how the baselines' published figures were made. Nothing is chosen here: the settings are the defaults of spelgen.
"""

from __future__ import annotations

import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))

from characters import TESTS as CHARACTERS
from characters import read_characters, write_arm

from spelgen.arm.arm import Arm
from spelgen.baselines.solver import Solver
from spelgen.building import build
from spelgen.dynamics.bristles import BristleReach, reach_of
from spelgen.dynamics.regressor import regressor
from spelgen.evaluation.state_errors import end_errors
from spelgen.fitting.torque.fit import fit_torque
from spelgen.identification.friction import FrictionModel
from spelgen.identification.identification import Identification
from spelgen.identification.identify import least_squares
from spelgen.identification.method import LeastSquares
from spelgen.loaded_arm import load_arm
from spelgen.logs.dynamics_samples import DynamicsSamples, dynamics_samples
from spelgen.logs.preprocessing import Preprocessing
from spelgen.logs.read import read_logs
from spelgen.logs.trajectory import Trajectory
from spelgen.logs.windows import Windows, cut_windows, joined

Torque = Callable[..., np.ndarray]

TRAINING = ("20_02_10_30sec_12harm", "20_02_12_50sec_12harm", "20_02_05_20sec_8harm")
TESTS = (
    "19_12_23_free", "20_01_31_unload", "20_02_05_20sec_12harm", "20_02_06_20sec_10harm", "20_02_06_20sec_5harm",
    "20_02_10_20sec_7harm", "20_02_12_40sec_12harm", "20_02_19_14harm50sec", "20_02_19_15harm50sec",
)  # fmt: skip
OUTSIDE = "20_01_17_ptp_10_points"
LOADED = ("20_01_13_load_2600", "20_01_31_load", "20_02_19_14harm50secLoad")
SECONDS = (2, 3, 5, 10, 20)
RIDGES = (1e-6, 1e-5, 1e-4, 1e-3, 1e-2, 1e-1)
AHEAD = {"0.1 s": 10, "0.5 s": 47}  # samples at 94 Hz
WINDOWS = 60  # of each trajectory
SUBSTEPS = 4


def main() -> None:
    torch.set_num_threads(1)
    logs = Path(sys.argv[1]) if len(sys.argv) > 1 else Path(__file__).parents[2] / "shared" / "logs"
    with tempfile.TemporaryDirectory() as scratch:
        ur10e(logs / "ur10e")
        panda(logs / "panda", logs.parent / "arms" / "panda_erd.urdf")
        characters(logs / "delan_characters", Path(scratch))


def ur10e(folder: Path) -> None:
    urdf = folder / "ur10e.urdf"
    arm, model = load_arm(urdf).arm, build(urdf, "closed-form")
    logs = {name: read(folder / f"{name}.parquet", arm) for name in (*TRAINING, *TESTS, OUTSIDE, *LOADED)}
    training = samples_of([logs[name] for name in TRAINING])
    tests = [samples_of([logs[x] for x in (*TESTS, OUTSIDE)], pauses=pauses) for pauses in (True, False)]
    baseline = least_squares(arm, training, LeastSquares("range"))
    features = FrictionModel(stribeck=True, polynomial=True)
    more = least_squares(arm, training, LeastSquares("range", friction=features))
    remembering = least_squares(arm, training, LeastSquares("range", friction=FrictionModel(memory=True)))
    since = time.perf_counter()
    fit_torque(model, training)
    print(
        f"UR10e: the closed-form model is fitted to 100 s of three logs in {time.perf_counter() - since:.0f} s\n"
    )
    predictors = {
        "least squares": baseline.torque,
        "with features": more.torque,
        "with memory": remembering.torque,
        "closed-form": torque_of(model),
    }
    for samples, said in zip(tests, ("pauses included", "moving samples alone"), strict=True):
        table(f"Torque nMSE, {said}", predictors, samples, len(TESTS))
    rollouts(model, baseline, [logs[name] for name in TESTS])
    payload(model, logs)
    other_days(model, logs)
    few(urdf, arm, logs[TRAINING[0]], [each[: len(TESTS)] for each in tests])


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


def few(urdf: Path, arm: Arm, long: Trajectory, tests: Sequence[Sequence[DynamicsSamples]]) -> None:
    print(f"Trained on the first seconds of {long.name}: mean nMSE of the nine, pauses included\n")
    head = ("best ridge", "closed-form", "(moving)")
    print(f"{'seconds':26}" + "".join(f"{x:>15}" for x in head))
    for seconds in SECONDS:
        samples = samples_of([first(long, seconds)])
        ridges = [ridge(arm, samples, x) for x in RIDGES]
        model = build(urdf, "closed-form")
        fit_torque(model, samples)
        ours = torque_of(model)
        best = min(mean(x, tests[0]) for x in ridges)  # by the tests themselves: in its favour
        row = (best, mean(ours, tests[0]), mean(ours, tests[1]))
        print(f"{seconds:<26}" + "".join(f"{x:15.5f}" for x in row))
    print()


def ridge(arm: Arm, samples: Sequence[DynamicsSamples], size: float) -> Torque:
    """Return the torque of least squares with a penalty: so many times the squared length of each column."""
    friction = FrictionModel()

    def rows(q: np.ndarray, qd: np.ndarray, qdd: np.ndarray) -> np.ndarray:
        return np.concatenate([regressor(arm, q, qd, qdd), friction.columns(qd, qdd)], axis=2)

    tau = np.concatenate([x.tau for x in samples])
    blocks = [rows(x.q, x.qd, x.qdd) for x in samples]
    columns = (np.concatenate(blocks) / tau.std(axis=0)[:, None]).reshape(tau.size, -1)
    length = np.linalg.norm(columns, axis=0)
    length[length == 0] = 1.0
    penalised = np.vstack([columns / length, np.sqrt(size) * np.eye(len(length))])
    target = np.append((tau / tau.std(axis=0)).ravel(), np.zeros(len(length)))
    parameters = np.linalg.lstsq(penalised, target, rcond=None)[0] / length
    return lambda q, qd, qdd, z=None: rows(q, qd, qdd) @ parameters


def payload(model: Any, logs: dict[str, Trajectory]) -> None:
    print("A load at the tip: the last body alone is fitted to the first 10 s, judged on the rest\n")
    print(f"{'':26}{'as trained':>15}{'adapted':>15}{'adapted, 3 s':>15}")
    trained = {name: value.clone() for name, value in model.state_dict().items()}
    for name in LOADED:
        row = []
        for seconds in (0.0, 10.0, 3.0):
            model.load_state_dict(trained)
            seen = samples_of([first(logs[name], seconds)]) if seconds else []
            if sum(len(x.q) for x in seen):
                fit_torque(model, seen, adapt="load")
            rest = samples_of([after(logs[name], seconds or 10.0)], pauses=True)
            row.append(mean(torque_of(model), rest))
        print(f"{name:26}" + "".join(f"{x:15.5f}" for x in row))
    model.load_state_dict(trained)
    print()


def other_days(model: Any, logs: dict[str, Trajectory]) -> None:
    """The nine are of other days than the training: what friction and torque offsets of the day are worth."""
    print(
        "Friction and torque offsets fitted to the first 10 s of each, judged on the rest, pauses included\n"
    )
    print(f"{'':26}{'as trained':>15}{'friction':>15}{'another unit':>15}")
    trained = {name: value.clone() for name, value in model.state_dict().items()}
    rows = []
    for name in TESTS:
        seen, rest = samples_of([first(logs[name], 10.0)]), samples_of([after(logs[name], 10.0)], pauses=True)
        row = []
        for adapt in (None, "friction", "unit"):
            model.load_state_dict(trained)
            if adapt is not None:
                fit_torque(model, seen, adapt=adapt)
            row.append(mean(torque_of(model), rest))
        rows.append(row)
        print(f"{name:26}" + "".join(f"{x:15.5f}" for x in row))
    print(f"{'mean':26}" + "".join(f"{x:15.5f}" for x in np.mean(rows, axis=0)) + "\n")
    model.load_state_dict(trained)


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
    """Evenly spread windows of each trajectory."""
    filtered = Preprocessing(cutoff=8.0)
    pieces = [piece for x in logs for piece in filtered.pieces([x], shortest=steps + 1)]
    cut = [
        cut_windows([x], steps + 1, max(1, (len(x) - steps) // WINDOWS), measured=True, reach=reach(x))
        for x in pieces
    ]
    return joined(cut)


def relative_error(dynamics: Any, windows: Windows) -> float:
    predicted = Solver(dynamics, SUBSTEPS)(windows)
    found = end_errors(predicted, windows, ("revolute",) * windows.q.shape[-1], None)
    return found.mean_relative_rms or np.nan


def panda(folder: Path, urdf: Path) -> None:
    arm, model = load_arm(urdf).arm, build(urdf, "closed-form")
    whole = read(folder / "exciting_traj1.parquet", arm)
    training, test = samples_of([first(whole, 12.0)]), samples_of([after(whole, 12.0)])
    fit_torque(model, training)
    predictors = {
        f"tanh {width:g}": least_squares(
            arm, training, LeastSquares("range", friction=FrictionModel(width))
        ).torque
        for width in (0.02, 0.05)
    }
    remembering = LeastSquares("range", friction=FrictionModel(memory=True))
    predictors["with memory"] = least_squares(arm, training, remembering).torque
    table("Panda: first 12 s train, last 9 s test", predictors | {"closed-form": torque_of(model)}, test, 1)


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
    """The torque, and what of it is Coriolis and centrifugal."""
    with torch.no_grad():
        steady, still = (model.inverse_dynamics(q, x, torch.zeros_like(q)) for x in (qd, torch.zeros_like(q)))
        friction = model.friction_torque(q, qd)
        return model.inverse_dynamics(q, qd, qdd).numpy(), (steady - still - friction).numpy()


def samples_of(logs: Sequence[Trajectory], *, pauses: bool = False) -> list[DynamicsSamples]:
    return dynamics_samples(logs, pauses=pauses, reach=reach(logs[0]))


def reach(log: Trajectory) -> BristleReach:
    return reach_of(["revolute"] * log.q.shape[1])


def read(path: Path, arm: Arm) -> Trajectory:
    (trajectory,) = read_logs([path], [coordinate.name for coordinate in arm.coordinates])
    return trajectory


def first(trajectory: Trajectory, seconds: float) -> Trajectory:
    return trajectory[: int(np.searchsorted(trajectory.t, trajectory.t[0] + seconds))]


def after(trajectory: Trajectory, seconds: float) -> Trajectory:
    return trajectory[int(np.searchsorted(trajectory.t, trajectory.t[0] + seconds)) :]


def torque_of(model: Any) -> Torque:
    def torque(*state: np.ndarray) -> np.ndarray:
        with torch.no_grad():
            found: np.ndarray = model.inverse_dynamics(*map(torch.from_numpy, state)).numpy()
        return found

    return torque


def nmse(torque: Torque, sample: DynamicsSamples) -> float:
    error = torque(sample.q, sample.qd, sample.qdd, sample.z) - sample.tau
    return float((np.square(error).mean(axis=0) / sample.tau.var(axis=0)).mean())


def mean(torque: Torque, samples: Sequence[DynamicsSamples]) -> float:
    return float(np.mean([nmse(torque, sample) for sample in samples]))


if __name__ == "__main__":
    main()
