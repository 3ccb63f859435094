"""What the report draws: the loss by epoch, and predicted trajectories against measured ones."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from markupsafe import Markup

from spelgen.render.charts import Line, line_chart

UNITS = {"revolute": ("rad", "rad/s"), "prismatic": ("m", "m/s")}
QUANTITIES = {"q": "position", "qd": "velocity"}


@dataclass(frozen=True)
class JointCharts:
    """One joint of a predicted trajectory: its position and its velocity over time."""

    name: str
    charts: tuple[Markup, ...]


def loss_chart(metrics: Sequence[Mapping[str, Any]], best_epoch: int) -> Markup:
    """Training and validation loss by epoch, with the epoch of the model that was kept."""
    epochs = [record["epoch"] for record in metrics]
    lines = [
        Line("training loss", epochs, [record["loss"] for record in metrics], "train"),
        Line("validation loss", epochs, [record["validation"] for record in metrics], "model"),
    ]
    return line_chart(
        lines, "Loss by epoch", "epoch", "loss", log=True, marks=[(best_epoch, "best")], width=860
    )


def joint_charts(example: Mapping[str, Any], joint_types: Mapping[str, str]) -> list[JointCharts]:
    """The charts of one of evaluation.json's `examples`, by joint; `joint_types` goes by the joint's name."""
    return [
        JointCharts(
            joint["name"],
            tuple(
                _against_time(joint, what, unit, example["t"])
                for what, unit in zip(QUANTITIES, UNITS[joint_types[joint["name"]]], strict=True)
            ),
        )
        for joint in example["joints"]
    ]


def _against_time(joint: Mapping[str, Any], what: str, unit: str, t: Sequence[float]) -> Markup:
    lines = [
        Line("measured", t, joint[f"{what}_true"], "truth"),
        Line("predicted", t, joint[f"{what}_pred"], "predicted"),
    ]
    name = QUANTITIES[what]
    return line_chart(lines, f"{name} of {joint['name']}", "t [s]", f"{name} [{unit}]", width=330, height=190)
