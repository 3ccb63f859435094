"""Creep of joints under constant servo commands: measured, and predicted by a fitted model from the same commands.

    python benchmarks/servo_creep.py ARM.urdf --train LOGS... --test LOGS... [--preset hybrid]

A hold is an interval in which the command of one joint is constant; other joints may move. It begins two seconds after
the last change of the command, and lasts a minute at most. Creep is the largest displacement of the joint from its
position at the beginning of the hold; motions of other joints cause a little of it. Holds with a measured displacement
of more than one encoder step are omitted, since the joint has not stopped. The columns `measured` and `model` have the
largest measured and predicted creep. `measured at rest` has the largest predicted creep over the holds in which the
measured position is constant, and in brackets the number of these holds. `beyond measured` has the largest difference
of predicted minus measured creep. The model is fitted to the training logs and predicts each log, training and test,
from its first state.
"""

from __future__ import annotations

import argparse
import math
from collections.abc import Iterator
from pathlib import Path

import numpy as np

import spelgen
from spelgen.evaluation.replay import ServoModel
from spelgen.logs.trajectory import split_at_gaps

# A hold is an interval with a constant command of a joint. AT_REST: [s] time from the last change of the command to the
# beginning of the hold. MINUTE: [s] longest duration of a hold.
AT_REST, MINUTE = 2.0, 60.0
SHORTEST = 5.0  # [s] shortest duration of a hold


def holds(t: np.ndarray, command: np.ndarray) -> Iterator[slice]:
    """Yield the rows of each hold of a joint, during which the joint's command is constant.

    A hold begins `AT_REST` seconds after the last change of the command, and lasts a minute at most.

    t: (T,) [s]. command: (T,) [rad].
    """
    changes = np.flatnonzero(np.diff(command)) + 1
    for start, stop in zip([0, *changes], [*changes, len(t)], strict=True):
        first, last = np.searchsorted(t, (t[start] + AT_REST, t[start] + AT_REST + MINUTE))
        rows = slice(first, min(last, stop))
        if rows.start < rows.stop and t[rows][-1] - t[rows][0] >= SHORTEST:
            yield rows


def creep(log: spelgen.Trajectory, q: np.ndarray, step: float) -> list[tuple[int, float, float]]:
    """Return (joint, measured creep, predicted creep) [rad] for each hold in which a joint of a log is at rest.

    A hold is an interval with a constant command (see `holds`). Creep is the largest displacement from the position at
    the beginning of the hold. A joint is at rest if its measured creep is at most one encoder step: more predicted
    creep is then an error of the model.

    q: (T, n) predicted positions [rad]. step: resolution of the encoder [rad].
    """
    assert log.u is not None
    found = []
    for joint, command in enumerate(log.u.T):
        for rows in holds(log.t, command):
            measured, predicted = (np.abs(x[rows, joint] - x[rows.start, joint]).max() for x in (log.q, q))
            if measured <= step:
                found.append((joint, float(measured), float(predicted)))
    return found


def main() -> None:
    """Fit the model, predict every log from its commands, and print the creep per joint."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("urdf", type=Path)
    parser.add_argument("--train", type=Path, nargs="+", required=True)
    parser.add_argument("--test", type=Path, nargs="+", required=True)
    parser.add_argument("--preset", default="hybrid")
    parser.add_argument("--encoder-step", type=float, default=360 / 4096, help="degrees")
    options = parser.parse_args()
    arm = spelgen.load_arm(options.urdf)
    training = spelgen.read_logs(sorted(options.train), arm)
    tests = spelgen.read_logs(sorted(options.test), arm)
    model = spelgen.fit(spelgen.build(arm, options.preset), training).model
    pieces = [piece for log in [*training, *tests] for piece in split_at_gaps(log, shortest=3)]
    starts = np.stack([piece.q[0] for piece in pieces])
    parts = [(piece, slice(0, len(piece))) for piece in pieces]
    replayed = ServoModel(model).positions(parts, starts, np.zeros_like(starts))
    found, missed = [], []
    for piece, after in zip(pieces, replayed, strict=True):
        q = np.concatenate([piece.q[:1], after])
        found += creep(piece, q, math.radians(options.encoder_step))
        if any(piece.name == test.name for test in tests):
            missed.append(np.sqrt(np.square(q - piece.q).mean()))
    columns = f"{'measured':>10}{'model':>8}{'measured at rest':>20}{'beyond measured':>17}"
    print(f"{'creep [mrad]':16}{'holds':>6}{columns}")
    for joint, name in enumerate(model.joint_names):
        own = np.array([row[1:] for row in found if row[0] == joint]).reshape(-1, 2)
        measured, predicted = 1000 * own.T
        at_rest = measured == 0
        resting = f"{predicted[at_rest].max(initial=0.0):.2f} ({at_rest.sum()})"
        farthest = f"{measured.max(initial=0.0):10.2f}{predicted.max(initial=0.0):8.2f}"
        beyond = (predicted - measured).max(initial=0.0)
        print(f"{name:16}{len(own):6}{farthest}{resting:>20}{beyond:17.2f}")
    print(f"root mean square over the tests, whole logs: {1000 * np.mean(missed):.2f} mrad")


if __name__ == "__main__":
    main()
