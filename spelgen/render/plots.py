"""What pages draw of a run: curves of evaluation.json's `traces`, and the loss by epoch."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from markupsafe import Markup

from spelgen.baselines.names import (
    CONSTANT_VELOCITY,
    LEAST_SQUARES,
    LEAST_SQUARES_WITH_MEMORY,
    MODEL,
    URDF,
    URDF_WITH_DRIVES,
    observed,
)
from spelgen.labels import entry_name
from spelgen.render.charts import Band, Dots, Line, line_chart

UNITS = {"revolute": ("rad", "rad/s"), "prismatic": ("m", "m/s")}
FORCE = {"revolute": "Nm", "prismatic": "N"}
INERTIA_UNITS = {"revolute revolute": "kg m²", "prismatic prismatic": "kg"}
QUANTITIES = {"q": "position", "qd": "velocity"}
STYLES = {
    MODEL: "model",
    URDF: "urdf",
    URDF_WITH_DRIVES: "drives",
    LEAST_SQUARES: "squares",
    LEAST_SQUARES_WITH_MEMORY: "remembering",
    CONSTANT_VELOCITY: "hold",
    observed(MODEL): "going-on",
}
PARTS = {"inertia": "inertia", "Coriolis": "coriolis", "gravity": "gravity", "friction": "friction"}
BARE = 84  # height of a chart that stands above another with the same times
FAR = 3.0  # a baseline farther away than this many ranges of the others is cut off: else they would be flat


@dataclass(frozen=True)
class Panel:
    """Charts that belong together: a joint's, or that of an entry of M."""

    name: str
    charts: tuple[Markup, ...]


def style(predictor: str) -> str:
    """The CSS class of a predictor's lines."""
    return STYLES.get(predictor, "c6")


def inertia_unit(a: str, b: str) -> str:
    """Of the entry of M between joints of these types."""
    return INERTIA_UNITS.get(f"{a} {b}", "kg m")


def loss_chart(metrics: Sequence[Mapping[str, Any]], best_epoch: int) -> Markup:
    """Training and validation loss by epoch, with the epoch of the model that was kept."""
    epochs = [record["epoch"] for record in metrics]
    lines = [
        Line("training loss", epochs, [record["loss"] for record in metrics], "train"),
        Line("validation loss", epochs, [record["validation"] for record in metrics], "model"),
    ]
    best = [(best_epoch, "best")]
    return line_chart(lines, "Loss by epoch", "epoch", "loss", log=True, marks=best, width=560, height=240)


def growth_charts(growth: Mapping[str, Any]) -> list[Panel]:
    """Error against the horizon: the middle half of the windows as lines, 10 to 90 % as bands."""
    seconds = growth["seconds"]
    panels = []
    for what, label in (("relative", "error / motion"), ("tip_mm", "error of the tip [mm]")):
        shown: list[Line | Band] = []
        for name, x in growth[what].items():
            shown.append(Line(f"{name}, median", seconds, numbers(x["median"]), style(name)))
            if name in (MODEL, LEAST_SQUARES):
                shown.append(
                    Band(f"{name}, 10 to 90 %", seconds, numbers(x["low"]), numbers(x["high"]), style(name))
                )
        if shown:
            title = "Relative to the motion" if what == "relative" else "Of the tip"
            limits = _limits([growth[what]], positive=True)
            chart = line_chart(
                shown, f"{title}: error by horizon", "horizon [s]", label, log=True, log_x=True, limits=limits,
                width=520, height=260,
            )  # fmt: skip
            panels.append(Panel(title, (chart,)))
    return panels


def torque_panels(trace: Mapping[str, Any], joints: Sequence[str], joint_types: Sequence[str]) -> list[Panel]:
    """By joint: measured and predicted torque, what is left, and what the prediction is made of."""
    t, measured = trace["t"], numbers(trace["measured"])
    predicted = numbers(trace["predicted"][MODEL])
    panels = []
    for k, (name, kind) in enumerate(zip(joints, joint_types, strict=True)):
        unit, motion = FORCE[kind], f"torque {trace['which']}"
        both = [
            Line("measured", t, measured[:, k], "truth"),
            Line("predicted", t, predicted[:, k], "predicted"),
        ]
        left = [Line("measured less predicted", t, measured[:, k] - predicted[:, k], "model")]
        parts = [Line(part, t, numbers(trace["parts"][part])[:, k], style) for part, style in PARTS.items()]
        panels.append(
            Panel(
                name,
                (
                    line_chart(both, f"Torque of {name}", "", f"torque [{unit}]", motion=motion, height=150),
                    line_chart(left, f"Residual of {name}", "", f"residual [{unit}]", motion=motion, height=BARE),
                    line_chart(parts, f"Parts of the torque of {name}", "t [s]", f"parts [{unit}]", motion=motion),
                ),
            )
        )  # fmt: skip
    return panels


def trajectory_panels(
    example: Mapping[str, Any], joints: Sequence[str], joint_types: Sequence[str]
) -> list[Panel]:
    """By joint: position and, where it is known, velocity, measured, predicted and, of servos, commanded, each above
    what lies between the first two.
    """
    t, motion = example["t"], f"prediction {example['which']}"
    shown = [x for x in QUANTITIES if x in example]
    panels = []
    for k, (name, kind) in enumerate(zip(joints, joint_types, strict=True)):
        charts = []
        for key, unit in zip(shown, UNITS[kind], strict=False):
            what, last = QUANTITIES[key], key == shown[-1]
            true, found = numbers(example[key])[:, k], numbers(example[f"predicted_{key}"])[:, k]
            lines = [Line("measured", t, true, "truth"), Line("predicted", t, found, "predicted")]
            if "u" in example:
                lines.insert(0, Line("commanded", t, numbers(example["u"])[:, k], "hold"))
            off = [Line("predicted less measured", t, found - true, "model")]
            charts += [
                line_chart(lines, f"{what} of {name}", "", f"{what} [{unit}]", motion=motion, height=120),
                line_chart(
                    off, f"Error of the {what} of {name}", "t [s]" if last else "", f"error [{unit}]", motion=motion,
                    height=BARE + 28 * last,
                ),
            ]  # fmt: skip
        panels.append(Panel(name, tuple(charts)))
    return panels


def mass_panels(
    mass: Mapping[str, Any], joint_types: Sequence[str], picture: Sequence[Sequence[Any]]
) -> list[Panel]:
    """The entries of M that are not always zero, by the model and its baselines, along a trajectory."""
    panels = []
    places = [(i, j) for i in range(len(joint_types)) for j in range(i + 1)]
    for place, (i, j) in enumerate(places):
        if picture[i][j].kind == "zero":
            continue
        lines = [
            Line(name, mass["t"], numbers(x["entries"][place]), style(name)) for name, x in mass["by"].items()
        ]
        unit, name = inertia_unit(joint_types[i], joint_types[j]), entry_name(i, j)
        chart = line_chart(lines, f"{name} along the trajectory", "t [s]", f"{name} [{unit}]", width=330)
        panels.append(Panel(name, (chart,)))
    return panels


def eigenvalue_chart(mass: Mapping[str, Any]) -> Markup:
    """The least and the largest eigenvalue of M along a trajectory; what is not positive is not drawn."""
    lines = [
        Line(f"{name}, {which}", mass["t"], numbers(x["eigenvalues"][row]), style(name))
        for name, x in mass["by"].items()
        for row, which in ((0, "least"), (-1, "largest"))
    ]
    return line_chart(lines, "Eigenvalues of M", "t [s]", "eigenvalue of M", log=True, width=520, height=230)


def friction_panels(
    friction: Mapping[str, Any],
    torques: Sequence[Mapping[str, Any]],
    joints: Sequence[str],
    joint_types: Sequence[str],
) -> list[Panel]:
    """By joint: friction by velocity, and the loops that measured motion makes of it, measured and by the model.

    What is measured is the torque less that of the model's rigid bodies. A model without memory of friction makes no
    loop but for load.
    """
    panels = []
    for k, (name, kind) in enumerate(zip(joints, joint_types, strict=True)):
        curves = {label: numbers(x[k]) for label, x in friction["by"].items()}
        loops: list[Line | Dots] = []
        for trace in torques[:1]:
            qd = numbers(trace["qd"])[:, k]
            left = numbers(trace["measured"])[:, k] - numbers(trace["without_friction"])[:, k]
            loops.append(Line("measured, in the order of time", qd, left, "loop"))
            loops.append(Line("model along it", qd, numbers(trace["parts"]["friction"])[:, k], "loop model"))
        left = friction["measured"][k]
        dots = Dots("measured", numbers(left["qd"]), numbers(left["torque"]), "truth")
        limits = _robust_limits(dots.y, curves.get(MODEL, np.zeros(1)))
        lines = (Line(label, friction["qd"][k], y, style(label)) for label, y in curves.items())
        chart = line_chart(
            [dots, *loops, *lines], f"Friction of {name}", f"velocity [{UNITS[kind][1]}]",
            f"friction [{FORCE[kind]}]", limits=limits, height=220,
        )  # fmt: skip
        panels.append(Panel(name, (chart,)))
    return panels


def coverage_panels(
    by_logs: Mapping[str, Mapping[str, Any]],
    joints: Sequence[str],
    joint_types: Sequence[str],
    limits: Sequence[tuple[float, float] | None],
) -> list[Panel]:
    """By joint: how often positions and velocities occur, of the logs named; marks: the joint's limits."""
    panels = []
    for k, (name, kind) in enumerate(zip(joints, joint_types, strict=True)):
        charts = []
        for what, unit in zip(QUANTITIES, UNITS[kind], strict=True):
            bands = [_histogram(label, logs[what][k]) for label, logs in by_logs.items()]
            bound = limits[k] if what == "q" else None
            marks = [(bound[0], "limit"), (bound[1], "limit")] if bound else []
            edge = [Line("limits", bound, (0, 0), "edge")] if bound else []
            label = f"{QUANTITIES[what]} [{unit}]"
            charts.append(
                line_chart(
                    [*bands, *edge],
                    f"{QUANTITIES[what]} of {name}",
                    label,
                    "share",
                    marks=marks,
                    width=300,
                    height=130,
                )
            )
        panels.append(Panel(name, tuple(charts)))
    return panels


def energy_chart(trace: Mapping[str, Any]) -> Markup:
    """Where the drives' work went."""
    styles = ("truth", "urdf", "friction", "model")
    lines = [
        Line(name, trace["t"], numbers(x), style)
        for (name, x), style in zip(trace["energy"].items(), styles, strict=True)
    ]
    return line_chart(
        lines, "Energy", "t [s]", "energy [J]", motion=f"torque {trace['which']}", width=560, height=250
    )


def _histogram(label: str, found: Mapping[str, Any]) -> Band:
    counts = np.array(found["counts"], dtype=float)
    edges = np.linspace(found["low"], found["high"], len(counts) + 1)
    heights = np.repeat(counts / max(counts.sum(), 1.0), 2)
    return Band(
        label,
        np.repeat(edges, 2)[1:-1],
        np.zeros_like(heights),
        heights,
        "train" if label == "training" else "model",
    )


def _limits(groups: Sequence[Mapping[str, Any]], *, positive: bool) -> tuple[float, float] | None:
    """Of the medians and the model's band, baselines that are hopeless cut off."""
    own = [x for group in groups for key in ("low", "high") for x in group.get(MODEL, {}).get(key, ())]
    all_ = [x for group in groups for each in group.values() for x in each["median"]]
    good = [x for x in own if x is not None and x > 0]
    rest = [x for x in all_ if x is not None and x > 0]
    if not good or not rest:
        return None
    high = max([*good, *(x for x in rest if x < 100 * max(good))])
    return min([*good, *rest]) / 1.3, high * 1.3


def _robust_limits(dots: Any, curve: np.ndarray) -> tuple[float, float] | None:
    values = np.concatenate([np.asarray(dots, dtype=float), np.asarray(curve, dtype=float)])
    values = values[np.isfinite(values)]
    if not values.size:
        return None
    low, high = np.quantile(values, [0.005, 0.995])
    room = 0.15 * (high - low) or 1.0
    return float(min(low, np.nanmin(curve)) - room), float(max(high, np.nanmax(curve)) + room)


def numbers(values: Any) -> np.ndarray:
    """Nested lists, None where not finite, as an array."""
    return np.array(values, dtype=float)
