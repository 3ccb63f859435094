"""Learning curves of all recordings: torque nMSE of each method on equal samples, from 3 s of training to all.

    python benchmarks/leaderboard.py [FOLDER] [--only NAME ...] [--seconds 3 5 all] [--methods NAME ...] [--list]
                                     [--out runs/leaderboard.jsonl] [--before FILE]
                                     [--page docs/leaderboard.md] [--rivals PYTHON]

FOLDER is made by `python benchmarks/recordings.py FOLDER`, by default runs/recordings. The folds are the documented
splits (`split`), splits of one recording with the training part at its end (`reversed`), and each motion of an arm as
the training of a fold that is tested on every other motion (`motion`). A fold is fitted to the first 3, 5, 10 and 20 s
of its training recordings and to all of them. The torque delay is found once per fit, and all methods have the same
samples. A cell is one fold, duration and group of test recordings; its error is the mean over recordings of the nMSE
(mean squared torque error divided by the variance of the torque, mean over joints) of moving samples.

Results are appended to a file of JSON lines, one per fold, duration and method; a run continues where it stopped. The
tables show the error per cell, and the default preset, `hybrid`, divided by the best of the other methods in
`REFERENCES`. `--before` compares with another file of results, cell by cell. `--rivals` adds the methods of
`rivals.py`, run by the Python of an environment in which they are installed.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import time
import warnings
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np
import torch

sys.path.insert(0, str(Path(__file__).parent))

from leaderboard_tables import (
    DEFAULT,
    REFERENCES,
    Row,
    cells_of,
    changes,
    errors_table,
    method_lines,
    summary,
    text,
    write_page,
)
from real_logs import OUTSIDE, TESTS, TRAINING, Torque, after, first, torque_of
from recordings import folder_of, panda_urdf
from rivals import RIVALS, Method, Prediction

import spelgen
from spelgen.arm.arm import Chain
from spelgen.arm.configured_arm import Arm, load_arm
from spelgen.dynamics.bristles import bristle_reach
from spelgen.dynamics.friction import FrictionModel
from spelgen.dynamics.pinocchio_dynamics import drives_known, urdf_dynamics
from spelgen.dynamics.regressor_dynamics import regressor
from spelgen.errors import LogError, SpelgenError
from spelgen.evaluation.torque import mean_nmse
from spelgen.fitting.torque.objective import torque_delay
from spelgen.identification.identification import LeastSquares
from spelgen.identification.identify import least_squares
from spelgen.logs.dynamics_samples import DynamicsSamples, dynamics_samples, is_moving
from spelgen.logs.preprocessing import Preprocessing
from spelgen.logs.trajectory import Trajectory

SECONDS: tuple[float, ...] = (3.0, 5.0, 10.0, 20.0, np.inf)
RIDGES = tuple(10.0**k for k in range(-9, 3))
RIDGE_FOLDS = 5
# [s] duration of the training part, of arms with a single recording
TRAINED_FIRST = {
    "panda": 12.0, "xmate3": 12.0, "ar5": 36.0, "tx40": 5.4, "unisa_ur10": 16.5, "unisa_panda": 14.5,
}  # fmt: skip
AIRBOT_TRAINING = ("ps_N7T25QR-5", "ps_N7T25QR-6_again")


@dataclass(frozen=True)
class Fold:
    """Training recordings of an arm, and test recordings by the name of their group; each group has its own errors."""

    name: str
    urdf: Path
    training: tuple[Trajectory, ...]
    tests: Mapping[str, tuple[Trajectory, ...]]

    def first(self, seconds: float) -> list[Trajectory]:
        """Return the training recordings, in order, cut after `seconds` seconds in total."""
        parts: list[Trajectory] = []
        for log in self.training:
            if seconds > 0:
                parts.append(first(log, seconds) if log.duration > seconds else log)
                seconds -= log.duration
        return parts

    @property
    def durations(self) -> tuple[float, ...]:
        """Return the training durations [s]: `SECONDS` below 95 % of the total, and infinity for all recordings."""
        total = sum(log.duration for log in self.training)
        return tuple(x for x in SECONDS if x < 0.95 * total or np.isinf(x))


class Problem:
    """Training and test samples of a fold, filtered with one torque delay, so that all methods have the same samples.

    The training samples are from the first `seconds` seconds of the fold's training recordings, in total. Raises
    LogError if no joint moves in them.
    """

    def __init__(self, fold: Fold, seconds: float) -> None:
        self.fold, self.logs = fold, fold.first(seconds)
        self.arm: Arm = load_arm(fold.urdf)
        model = spelgen.build(fold.urdf, DEFAULT)
        self.reach = bristle_reach(model)
        delay = torque_delay(model, self.logs, Preprocessing())
        self.preprocessing = Preprocessing(torque_delay=delay.delay)
        self.samples = [x for x in self.samples_of(self.logs) if len(x.q)]
        if not self.samples:
            raise LogError("no moving samples", expected="motion faster than 0.02 rad/s")

    def samples_of(self, logs: Sequence[Trajectory], *, pauses: bool = False) -> list[DynamicsSamples]:
        """Return the filtered torque samples of logs, as `train` and `evaluate` use them.

        pauses: if True, samples at standstill between motions are included.
        """
        return dynamics_samples(logs, pauses=pauses, preprocessing=self.preprocessing, reach=self.reach)

    @cached_property
    def tests(self) -> dict[str, list[DynamicsSamples]]:
        """Test samples of the fold, with pauses, by the name of the group of recordings."""
        return {group: self.samples_of(logs, pauses=True) for group, logs in self.fold.tests.items()}

    def figures(self, prediction: Prediction) -> Row:
        """Return the errors of a prediction per group of test recordings, as fields of a row of results.

        nmse: mean over recordings, of moving samples only and with pauses. coverage: share of the torques of moving
        samples within their 95 % intervals, if the method has intervals.
        """
        nmse, coverage = {}, {}
        for group, samples in self.tests.items():
            errors, inside = [], []
            for x in samples:
                residual, moving = prediction.torque(x) - x.tau, is_moving(x.qd)
                both = mean_nmse(residual[moving], x.tau[moving]), mean_nmse(residual, x.tau)
                errors.append([np.inf if error is None else error for error in both])
                if prediction.std is not None:
                    inside.append(np.abs(residual[moving]) <= 1.96 * prediction.std(x)[moving])
            nmse[group] = [float(x) for x in np.mean(errors, axis=0)]
            if inside:
                coverage[group] = round(float(np.concatenate(inside).mean()), 4)
        return {"nmse": nmse} | ({"coverage": coverage} if coverage else {})


def urdf_values(problem: Problem) -> Prediction:
    """Return the torque of the URDF's bodies, unfitted, with the drives of the arm's settings if they state any."""
    urdf, names = problem.fold.urdf, problem.arm.chain.joint_names
    return Prediction(torque_of(urdf_dynamics(urdf, names, drives=drives_known(urdf, names))))


def cross_validated_ridge(chain: Chain, samples: Sequence[DynamicsSamples]) -> Torque:
    """Return the torque function of ridge regression, whose penalty is chosen by cross-validation over blocks of time.

    The regressor has columns of rigid bodies, viscous and Coulomb friction, armature and offset. The rows of a joint
    are divided by the standard deviation of its torque. The penalty is relative to the squared length of each column.
    """
    friction = FrictionModel()

    def columns(x: DynamicsSamples) -> np.ndarray:
        """Return the regressor of rigid bodies and friction at the samples, (T, n, K) for K parameters."""
        return np.concatenate([regressor(chain, x.q, x.qd, x.qdd), friction.columns(x.qd, x.qdd)], axis=2)

    tau = np.concatenate([x.tau for x in samples])
    scale = np.maximum(tau.std(axis=0), 1e-3 * tau.std(axis=0).max())[:, None]
    # regressor (T, n, K), each joint divided by the standard deviation of its torque
    rows = np.concatenate([*map(columns, samples)]) / scale
    length = np.sqrt(np.square(rows).sum(axis=(0, 1)))
    length[length == 0] = 1.0
    rows = np.concatenate([rows / length, tau[:, :, None] / scale], axis=2)
    blocks = [x.reshape(-1, rows.shape[2]) for x in np.array_split(rows, RIDGE_FOLDS)]
    grams = np.stack([x.T @ x for x in blocks])

    def solution(gram: np.ndarray, penalty: float) -> np.ndarray:
        """Return the ridge solution (K,) for the Gram matrix (K + 1, K + 1) of K regressor columns and the torque."""
        return np.linalg.solve(gram[:-1, :-1] + penalty * np.eye(len(length)), gram[:-1, -1])

    def held_out_error(penalty: float) -> float:
        # The penalty is relative to the Gram matrix of all samples; training blocks have only this share of samples.
        share = (RIDGE_FOLDS - 1) / RIDGE_FOLDS
        error = 0.0
        for block, gram in zip(blocks, grams, strict=True):
            parameters = solution(grams.sum(axis=0) - gram, share * penalty)
            error += np.square(block @ np.append(parameters, -1.0)).sum()
        return float(error)

    best = solution(grams.sum(axis=0), min(RIDGES, key=held_out_error)) / length
    return lambda x: columns(x) @ best


def by_least_squares(*, memory: bool) -> Method:
    """Return the method that fits rigid bodies and friction by the least squares of `spelgen identify`.

    Each joint has the weight 1 / standard deviation of its torque. memory: if True, friction has bristle states;
    otherwise it is Coulomb friction.
    """
    method = LeastSquares("range", friction=FrictionModel(memory=memory))

    def fitted(problem: Problem) -> Prediction:
        return Prediction(torque_of(least_squares(problem.arm.chain, problem.samples, method).dynamics))

    return fitted


def by_preset(preset: str) -> Method:
    """Return the method that fits a preset as `spelgen train` does without options."""

    def fitted(problem: Problem) -> Prediction:
        model = spelgen.build(problem.fold.urdf, preset)
        fit = spelgen.fit(model, problem.logs, preprocessing=problem.preprocessing, arm=problem.fold.urdf)
        if preset != DEFAULT:
            return Prediction(torque_of(fit.model))
        posterior = fit.posterior

        def std(x: DynamicsSamples) -> np.ndarray:
            """Return posterior standard deviations of the torque at the samples, (T, n) [Nm]."""
            past = [state for state in (x.z, x.direction) if state is not None]
            return posterior.torque(x.q, x.qd, x.qdd, *past).std

        return Prediction(torque_of(fit.model), std)

    return fitted


METHODS: dict[str, Method] = {
    "URDF": urdf_values,
    "ridge": lambda problem: Prediction(cross_validated_ridge(problem.arm.chain, problem.samples)),
    "least squares": by_least_squares(memory=False),
    "with memory": by_least_squares(memory=True),
    "closed-form": by_preset("closed-form"),
    DEFAULT: by_preset(DEFAULT),
    **RIVALS,
}


def folds(folder: Path) -> Iterator[Fold]:
    """Yield all folds (training and test recordings) of the arms in a folder of recordings; absent arms are skipped.

    The documented splits (docs/real_logs.md) are first, each split of a single recording with its reversal. Folds that
    are trained on one motion are last.
    """
    motions: list[Fold] = []
    present = {path.name for path in folder.iterdir()}
    for name in ("ur10e", "airbot", "shanghai"):
        if name not in present:
            continue
        urdf = folder / name / f"{name}.urdf"
        logs = recordings_of(folder / name, urdf)
        unloaded = {k: x for k, x in logs.items() if "load" not in k.lower() or "unload" in k}
        yield from splits(name, urdf, unloaded)
        motions += motion_folds(name, urdf, unloaded)
    for name, seconds in TRAINED_FIRST.items():
        if name not in present:
            continue
        urdf = panda_urdf(folder) if name == "panda" else folder / name / f"{name}.urdf"
        (log,) = recordings_of(folder / name, urdf).values()
        yield Fold(f"{name}/split", urdf, (first(log, seconds),), {"remainder": (after(log, seconds),)})
        seconds = log.duration - seconds
        yield Fold(f"{name}/reversed", urdf, (after(log, seconds),), {"remainder": (first(log, seconds),)})
    yield from motions


def recordings_of(folder: Path, urdf: Path) -> dict[str, Trajectory]:
    """Return {file name without suffix: recording} of all Parquet files in a folder of recordings of one arm.

    urdf: URDF of the arm, whose joints determine the columns of the recordings.
    """
    arm = load_arm(urdf)
    return {path.stem: spelgen.read_logs([path], arm)[0] for path in sorted(folder.glob("*.parquet"))}


def splits(name: str, urdf: Path, logs: Mapping[str, Trajectory]) -> Iterator[Fold]:
    """Yield the documented splits of an arm's recordings into training and test recordings.

    `ur10e` and `airbot` have one split. `shanghai` has a split per recording: it is the test, all others are training.
    """

    def chosen(names: Iterable[str]) -> tuple[Trajectory, ...]:
        return tuple(logs[x] for x in names)

    if name == "ur10e":
        groups = {"nine": chosen(TESTS), "ptp": chosen([OUTSIDE])}
        yield Fold("ur10e/split", urdf, chosen(TRAINING), groups)
    elif name == "airbot":
        motions = {motion_of(x) for x in AIRBOT_TRAINING}
        tests = chosen(x for x in logs if motion_of(x) not in motions)
        yield Fold("airbot/split", urdf, chosen(AIRBOT_TRAINING), {f"{len(tests)} others": tests})
    else:
        for number, test in enumerate(logs, start=1):
            training = chosen(x for x in logs if x != test)
            yield Fold(f"{name}/split {number}", urdf, training, {test: chosen([test])})


def motion_folds(name: str, urdf: Path, logs: Mapping[str, Trajectory]) -> Iterator[Fold]:
    """Yield a fold per recording: trained on this recording, tested on every recording of another motion."""
    for trained, log in logs.items():
        tests = {x: (test,) for x, test in logs.items() if motion_of(x) != motion_of(trained)}
        yield Fold(f"{name}/motion {trained}", urdf, (log,), tests)


def motion_of(recording: str) -> str:
    """Return the name of a recording's motion: the recording's name without the suffix `_again` of a repetition."""
    return recording.removesuffix("_again")


def measured(fold: Fold, seconds: float, methods: Iterable[str]) -> Iterator[Row]:
    """Fit methods to the first `seconds` seconds of a fold's training; yield a row of results per method.

    The row of a failed fit has the text of the error. A method whose package is not installed has no row.
    """
    common: Row = {"fold": fold.name, "seconds": duration_name(seconds)}
    try:
        problem = Problem(fold, seconds)
    except SpelgenError as error:
        yield from (common | {"method": name, "error": str(error)} for name in methods)
        return
    common["samples"] = sum(len(x.q) for x in problem.samples)
    for name in methods:
        since = time.process_time()
        try:
            prediction = METHODS[name](problem)
            row: Row = {"fit_s": round(time.process_time() - since, 2)} | problem.figures(prediction)
        except ImportError as error:  # the method needs a package that is not installed
            print(f"{name} skipped: {error}", file=sys.stderr)
            continue
        except (SpelgenError, np.linalg.LinAlgError) as error:
            row = {"error": str(error)}
        yield common | {"method": name} | row


def duration_name(seconds: float) -> str:
    return "all" if np.isinf(seconds) else f"{seconds:g}"


def rows_of(path: Path) -> list[Row]:
    """Return the rows of results in a file of JSON lines; [] if the file does not exist."""
    return [json.loads(line) for line in path.read_text().splitlines()] if path.exists() else []


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("folder", nargs="?", type=Path)
    parser.add_argument("--only", nargs="+", default=[""], help="folds whose names contain one of these")
    parser.add_argument("--seconds", nargs="+", choices=list(map(duration_name, SECONDS)))
    parser.add_argument("--methods", nargs="+", choices=METHODS, default=[DEFAULT, *REFERENCES])
    parser.add_argument("--rivals", type=Path, metavar="PYTHON", help="of the environment of `rivals.py`")
    parser.add_argument("--out", type=Path, default=Path("runs/leaderboard.jsonl"))
    parser.add_argument("--before", type=Path, help="results to compare with")
    parser.add_argument("--page", type=Path, help="Markdown page whose tables are replaced")
    parser.add_argument("--list", action="store_true", help="show the results of --out, and fit nothing")
    options = parser.parse_args()
    torch.set_num_threads(1)
    warnings.simplefilter("ignore")
    rows = rows_of(options.out)
    if not options.list:
        options.out.parent.mkdir(parents=True, exist_ok=True)
        with options.out.open("a") as file:
            for row in missing(options, rows):
                rows.append(row)
                file.write(json.dumps(row) + "\n")
                file.flush()
        if options.rivals:
            rows = by_rivals(options)
    cells = {
        cell: errors
        for cell, errors in cells_of(rows).items()
        if any(x in cell[0] for x in options.only) and cell[1] in (options.seconds or cell[1])
    }
    print(text(errors_table(cells, [x for x in METHODS if x in options.methods])) + "\n")
    print("\n".join(summary(cells)) + "\n\n" + text(method_lines(rows, list(METHODS))))
    if options.page:
        write_page(options.page, rows, cells, list(METHODS))
    if options.before:
        print("\n".join(changes(cells_of(rows_of(options.before)), cells, METHODS)))
    for row in rows:
        if "error" in row:
            print(f"{row['fold']}, {row['seconds']} s, {row['method']}: {row['error']}")


def by_rivals(options: argparse.Namespace) -> list[Row]:
    """Run this script for the methods of `rivals.py` with the Python `options.rivals`; return all results.

    The Python belongs to an environment in which these methods are installed. Its process appends its results to the
    file `options.out`. The methods are added to `options.methods`.
    """
    command = [
        options.rivals,
        __file__,
        folder_of(options.folder),
        "--out",
        options.out,
        "--only",
        *options.only,
    ]
    seconds = ["--seconds", *options.seconds] if options.seconds else []
    subprocess.run(
        [*map(str, command), *seconds, "--methods", *RIVALS], check=True, stdout=subprocess.DEVNULL
    )
    options.methods = [*options.methods, *RIVALS]
    return rows_of(options.out)


def missing(options: argparse.Namespace, rows: Sequence[Row]) -> Iterator[Row]:
    """Fit the requested folds, durations and methods that `rows` do not contain; yield the results, fold by fold."""
    done = {(row["fold"], row["seconds"], row["method"]) for row in rows}
    for fold in folds(folder_of(options.folder)):
        if not any(x in fold.name for x in options.only):
            continue
        for seconds in fold.durations:
            name = duration_name(seconds)
            if options.seconds and name not in options.seconds:
                continue
            methods = [x for x in options.methods if (fold.name, name, x) not in done]
            if methods:
                yield from measured(fold, seconds, methods)


if __name__ == "__main__":
    main()
