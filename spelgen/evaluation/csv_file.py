"""An evaluation as one long CSV table: a row for each number that is shown as a figure or drawn by horizon."""

from __future__ import annotations

import csv
import io
from collections.abc import Iterator
from typing import Any

from spelgen.evaluation.figures import Figures
from spelgen.evaluation.tables import POSITION, TORQUE, UNITS, VELOCITY

HEAD = ("quantity", "unit", "horizon_s", "joint", "trajectory", "predictor", "value")


def csv_text(results: Figures) -> str:
    """Return the table, with its head; nothing stands where a number is not known."""
    file = io.StringIO()
    # what a row has no use for stays empty
    writer = csv.DictWriter(file, HEAD, restval="", lineterminator="\n")
    writer.writeheader()
    for rows in (_replays, _states, _torques, _growth):
        writer.writerows(rows(results))
    return file.getvalue()


Row = dict[str, Any]  # numbers and text by column


def _by_joint(results: Figures, row: Row, unit: int, values: tuple[float | None, ...]) -> Iterator[Row]:
    for joint, kind, value in zip(results.joints, results.joint_types, values, strict=True):
        yield row | {"unit": UNITS[kind][unit], "joint": joint, "value": value}


def _replays(results: Figures) -> Iterator[Row]:
    for replay in results.replays:
        for name, errors in replay.errors.items():
            row: Row = {"quantity": f"q RMS of commands replayed, {replay.name}", "predictor": name}
            for trajectory, value in errors.trajectories.items():
                yield row | {"unit": "rad; m", "trajectory": trajectory, "value": value}
            yield from _by_joint(results, row, POSITION, errors.joints)


def _states(results: Figures) -> Iterator[Row]:
    for horizon in results.horizons:
        for name, errors in horizon.errors.items():
            row: Row = {"horizon_s": horizon.seconds, "predictor": name}
            yield row | {"quantity": "relative RMS", "unit": "1", "value": errors.mean_relative_rms}
            yield row | {"quantity": "tip RMS", "unit": "mm", "value": errors.tip_mm}
            yield from _by_joint(results, row | {"quantity": "q RMS"}, POSITION, errors.q)
            yield from _by_joint(results, row | {"quantity": "qd RMS"}, VELOCITY, errors.qd)
            relative = {"q": errors.q_relative_rms, "qd": errors.qd_relative_rms}
            for what, values in relative.items():
                for joint, value in zip(results.joints, values, strict=True):
                    quantity = {"quantity": f"{what} relative RMS", "unit": "1"}
                    yield row | quantity | {"joint": joint, "value": value}


def _torques(results: Figures) -> Iterator[Row]:
    for name, errors in results.torque.items():
        row: Row = {"quantity": "torque nMSE", "unit": "1", "predictor": name}
        yield row | {"value": errors.mean_nmse}
        yield row | {"quantity": "torque nMSE with pauses", "value": errors.nmse_with_pauses}
        for joint, value in zip(results.joints, errors.joint_nmse, strict=False):
            yield row | {"joint": joint, "value": value}
        for trajectory, value in errors.nmse.items():
            yield row | {"trajectory": trajectory, "value": value}
        yield from _by_joint(results, row | {"quantity": "torque RMSE"}, TORQUE, errors.rmse)


def _growth(results: Figures) -> Iterator[Row]:
    growth = results.traces.growth
    if growth is None:
        return
    for quantity, unit, curves in (
        ("relative error", "1", growth.relative),
        ("tip error", "mm", growth.tip_mm),
    ):
        for name, curve in curves.items():
            for quantile, values in (("10 %", curve.low), ("50 %", curve.median), ("90 %", curve.high)):
                row: Row = {
                    "quantity": f"{quantity}, {quantile} of the starts",
                    "unit": unit,
                    "predictor": name,
                }
                for seconds, value in zip(growth.seconds, values, strict=True):
                    yield row | {"horizon_s": seconds, "value": value}
