"""evaluation.json as one long CSV table: a row for each number that is shown as a figure or drawn by horizon."""

from __future__ import annotations

import csv
import io
from collections.abc import Iterator, Mapping
from typing import Any

HEAD = ("quantity", "unit", "horizon_s", "joint", "trajectory", "predictor", "value")
UNITS = {
    "revolute": {"q": "rad", "qd": "rad/s", "tau": "Nm"},
    "prismatic": {"q": "m", "qd": "m/s", "tau": "N"},
}
Row = tuple[str, str, float | str, str, str, str, float | None]


def csv_text(evaluation: Mapping[str, Any]) -> str:
    """The table, with its head; nothing stands where a number is not known."""
    file = io.StringIO()
    writer = csv.writer(file, lineterminator="\n")
    writer.writerow(HEAD)
    for *row, value in (
        *_replays(evaluation),
        *_states(evaluation),
        *_torques(evaluation),
        *_growth(evaluation),
    ):
        writer.writerow([*row, "" if value is None else value])
    return file.getvalue()


def _replays(evaluation: Mapping[str, Any]) -> Iterator[Row]:
    joints = list(zip(evaluation["joints"], evaluation["joint_types"], strict=True))
    for replay in evaluation.get("replays", ()):
        quantity = f"q RMS of commands replayed, {replay['name']}"
        for name, errors in replay["errors"].items():
            for trajectory, value in errors["trajectories"].items():
                yield quantity, "rad; m", "", "", trajectory, name, value
            for (joint, kind), value in zip(joints, errors["joints"], strict=True):
                yield quantity, UNITS[kind]["q"], "", joint, "", name, value


def _states(evaluation: Mapping[str, Any]) -> Iterator[Row]:
    joints = list(zip(evaluation["joints"], evaluation["joint_types"], strict=True))
    for horizon in evaluation["horizons"]:
        seconds = horizon["seconds"]
        for name, errors in horizon["errors"].items():
            yield "relative RMS", "1", seconds, "", "", name, errors["mean_relative_rms"]
            yield "tip RMS", "mm", seconds, "", "", name, errors["tip_mm"]
            for what in ("q", "qd"):
                columns = zip(joints, errors[what], errors[f"{what}_relative_rms"], strict=True)
                for (joint, kind), absolute, relative in columns:
                    yield f"{what} RMS", UNITS[kind][what], seconds, joint, "", name, absolute
                    yield f"{what} relative RMS", "1", seconds, joint, "", name, relative


def _torques(evaluation: Mapping[str, Any]) -> Iterator[Row]:
    for name, errors in evaluation["torque"].items():
        yield "torque nMSE", "1", "", "", "", name, errors["mean_nmse"]
        for trajectory, value in errors["nmse"].items():
            yield "torque nMSE", "1", "", "", trajectory, name, value
        columns = zip(evaluation["joints"], evaluation["joint_types"], errors["rmse"], strict=True)
        for joint, kind, value in columns:
            yield "torque RMSE", UNITS[kind]["tau"], "", joint, "", name, value


def _growth(evaluation: Mapping[str, Any]) -> Iterator[Row]:
    growth = evaluation["traces"].get("growth")
    if not growth:
        return
    for key, quantity, unit in (("relative", "relative error", "1"), ("tip_mm", "tip error", "mm")):
        for name, curves in growth[key].items():
            for level, part in (("low", "10 %"), ("median", "50 %"), ("high", "90 %")):
                for seconds, value in zip(growth["seconds"], curves[level], strict=True):
                    yield f"{quantity}, {part} of the starts", unit, seconds, "", "", name, value
