"""Charts of the report on a run: training losses, curves of the evaluation, and ranges of motion of the logs."""

import re
from collections.abc import Sequence

import numpy as np

from spelgen.evaluation.plain import array
from spelgen.evaluation.traces import FrictionTrace, Growth, MassTrace, PredictedMotion, TorqueTrace, Traces
from spelgen.evaluation.verdict import Limits
from spelgen.fitting.run_record import Content
from spelgen.labels import LEAST_SQUARES, MODEL, UNITS, NamedJoint, entry_name, named_joints, thousandths
from spelgen.listing import number
from spelgen.render.charts import TUNING, Band, Chart, Dots, JointRow, Line, Mark, Panel, line_chart, stacks
from spelgen.spec import ModelSpec


def style(predictor: str) -> str:
    """Return the CSS class of the lines of a predictor: its name in lower case, with hyphens."""
    return re.sub(r"\W+", "-", predictor.lower())


def evaluation_charts(traces: Traces, spec: ModelSpec) -> dict[str, object]:
    """Return {section of the report: charts}; None or empty for a section without curves in the evaluation.

    traces: curves of the evaluation. spec: specification of the model, with names and types of the joints.
    """
    joints = named_joints(spec.joint_names, spec.joint_types)
    # Every section has a value, None by default, because an undefined name is an error in the template.
    drawn = dict.fromkeys(("growth", "mass", "friction"))
    growth, mass = traces.growth, traces.mass
    if growth is not None:
        drawn["growth"] = growth_chart(growth)
    if mass is not None and mass.by:
        drawn["mass"] = mass_panels(mass, spec.joint_types)
    if traces.friction is not None:
        drawn["friction"] = friction_panels(traces.friction, traces.torques, joints)
    torques, trajectories = {}, {}
    for trace in traces.torques:
        torques[f"{trace.which.capitalize()} trajectory: {trace.trajectory}"] = torque_panels(trace, joints)
    for example in traces.trajectories:
        panels = trajectory_panels(example, joints, f"prediction {example.which}")
        trajectories[_motion_title(example, spec)] = panels
    return drawn | {"torques": torques, "trajectories": trajectories}


def _motion_title(example: PredictedMotion, spec: ModelSpec) -> str:
    """Return the title of the charts of ``example``, a predicted motion or a replayed log.

    It states the relative error of a prediction, or the RMS position error of a replayed log [mrad, mm]. spec:
    specification of the model, with the types of the joints.
    """
    which = example.which.capitalize()
    if example.start is None:
        distance = None if example.error is None else 1000 * example.error
        off = f"{number(distance)} {thousandths(spec.joint_types)} off"
        return f"{which} log replayed: {example.trajectory}, {off}"
    start = f"{example.trajectory}, from t = {example.start:g} s"
    return f"{which} prediction: {start}, relative error {number(example.error)}"


def growth_chart(growth: Growth) -> Chart:
    """Return the chart of the relative error over the prediction horizon; growth: errors of all predictors."""
    marks: list[Mark] = []
    for name, error in growth.relative.items():
        marks.append(Line(name, growth.seconds, error.median, style(name)))
        # Only the model and least squares have bands of quantiles, since bands of all predictors would overlap.
        if name in (MODEL, LEAST_SQUARES):
            label = f"{name}, 10 to 90 %"
            marks.append(Band(label, growth.seconds, error.low, error.high, style(name)))
    return line_chart(
        marks, "Relative error: error by horizon", "horizon [s]", "error / motion", log=True, log_x=True,
        limits=_error_limits(growth), width=520, height=260,
    )  # fmt: skip


def _error_limits(growth: Growth) -> tuple[float, float] | None:
    """Return the limits of the axis of prediction errors, so that errors of diverged baselines do not extend it.

    The limits include the 10 % and 90 % quantiles of the error of the model, and the median errors of all predictors.
    Medians above `TUNING.outlier` times the largest quantile of the model are excluded. None is returned if no error is
    positive.
    """
    of_model = growth.relative[MODEL]
    model_errors = np.concatenate([of_model.low, of_model.high])
    values = np.concatenate([model_errors, *(error.median for error in growth.relative.values())])
    # Zeros are excluded from the logarithmic axis. Diverged baselines are excluded, as they would compress all lines.
    values = values[(values > 0) & (values <= TUNING.outlier * np.nanmax(model_errors))]
    if not values.size:
        return None
    return float(values.min()) / 1.3, 1.3 * float(values.max())


def trajectory_panels(example: PredictedMotion, joints: Sequence[NamedJoint], motion: str) -> list[Panel]:
    """Return the charts of each joint: position and position error and, if logged, velocity and velocity error.

    Args:
        example: A measured motion and its prediction.
        joints: Names and units of the joints.
        motion: Name of the animation of this motion on the page; a script marks its current time in the charts.
    """
    rows = []
    position = ("position", example.q, example.predicted_q)
    velocity = ("velocity", example.qd, example.predicted_qd)
    for quantity, measured, predicted in (position, velocity):
        # A replayed log of position servos has no velocities, so its charts of velocity are omitted.
        if measured is None or predicted is None:
            continue
        lines = [("measured", measured, "truth"), ("predicted", predicted, "predicted")]
        # The command is the first curve, so that the measured curve is drawn above it.
        if example.u is not None:
            lines.insert(0, ("commanded", example.u, "hold"))
        rows.append(JointRow(quantity, quantity, quantity, lines))
        # The error has its own chart: on the scale of the motion it would be a flat line.
        error = [("predicted", predicted - measured, "predicted")]
        rows.append(JointRow(f"Error of the {quantity}", "error", quantity, error, 100))
    return stacks(example.t, rows, joints, motion)


def mass_panels(trace: MassTrace, joint_types: Sequence[str]) -> list[Panel]:
    """Return one chart over time for each entry of M that is not always zero.

    Args:
        trace: Entries of M along a trajectory, of one predictor at least.
        joint_types: Types of the joints, for the units of the entries.
    """
    panels = []
    # An entry of M whose magnitude never exceeds `zero` is zero except for rounding errors, and gets no chart.
    zero = TUNING.zero * max(np.nanmax(np.abs(entries)) for entries in trace.by.values())
    for index, (i, j) in enumerate(np.argwhere(np.tri(len(joint_types))).tolist()):
        lines = [Line(name, trace.t, entries[index], style(name)) for name, entries in trace.by.items()]
        if np.nanmax(np.abs([line.heights for line in lines])) > zero:
            name = entry_name(i, j)
            # An entry between a revolute and a prismatic joint has the unit of a first moment.
            unit = UNITS[joint_types[i]].inertia if joint_types[i] == joint_types[j] else "kg m"
            chart = line_chart(lines, name, "t [s]", f"{name} [{unit}]", width=330)
            panels.append(Panel(name, (chart,)))
    return panels


def loss_chart(metrics: Sequence[Content], best_epoch: int) -> Chart:
    """Return the chart of training and validation loss over the epochs, with a line at the epoch of the best model.

    metrics: epoch, training loss and validation loss of each epoch. best_epoch: epoch of the best model.
    """
    columns = [(record["epoch"], record["loss"], record["validation"]) for record in metrics]
    epochs, *losses = array(columns).T
    # The vertical line at the best epoch extends from the smallest to the largest loss: on a logarithmic axis it cannot
    # start at zero.
    ends = (np.nanmin(losses), np.nanmax(losses))
    lines = [
        Line("training loss", epochs, losses[0], "train"),
        Line("validation loss", epochs, losses[1], "model"),
        Line("epoch of the best model", (best_epoch, best_epoch), ends, "hold"),
    ]
    return line_chart(lines, "Loss by epoch", "epoch", "loss", log=True, width=560, height=240)


def torque_panels(trace: TorqueTrace, joints: Sequence[NamedJoint]) -> list[Panel]:
    """Return the charts of each joint along a trajectory: torque, residual, and terms of the model's torque.

    The chart of the torque shows the measured and the predicted torque. trace: torques along the trajectory. joints:
    names and units of the joints.
    """
    measured, predicted = trace.measured, trace.predicted[MODEL]
    curves = [("measured", measured, "truth"), ("predicted", predicted, "predicted")]
    components = [(name, torque, name.lower()) for name, torque in trace.parts.items()]
    rows = [
        JointRow("Torque", "torque", "torque", curves, 160),
        # The residual has its own scale, since it is small for a good model.
        JointRow("Residual", "residual", "torque", [("residual", measured - predicted, "model")], 100),
        JointRow("Components of the torque", "components", "torque", components, 162),
    ]
    return stacks(trace.t, rows, joints, f"torque {trace.which}")


def friction_panels(
    friction: FrictionTrace, torques: Sequence[TorqueTrace], joints: Sequence[NamedJoint]
) -> list[Panel]:
    """Return one chart per joint: friction torque over velocity.

    A chart shows the friction of each model at constant velocity, and the measured and modelled friction along the
    trajectories. The measured friction is the measured torque minus the rigid-body torque of the model. Along a
    trajectory the curve forms loops if friction has hysteresis or depends on the load.

    Args:
        friction: friction of the model and of the baselines at constant velocity.
        torques: measured and modelled torques along trajectories.
        joints: Names and units of the joints.
    """
    panels = []
    for k, joint in enumerate(joints):
        marks: list[Mark] = []
        curve = friction.by[MODEL][k]
        values = [curve]
        for trace in torques:
            qd, modelled = trace.qd[:, k], trace.parts["friction"][:, k]
            # Measured friction = measured torque - (model torque - model friction).
            measured = modelled + trace.measured[:, k] - trace.predicted[MODEL][:, k]
            values.append(measured)
            marks.append(Dots("measured", qd, measured, "truth"))
            # Loops are drawn for the first trajectory only, since loops of several trajectories would overlap.
            if trace is torques[0]:
                marks.append(Line("measured, over time", qd, measured, "loop"))
                marks.append(Line("model, over time", qd, modelled, "loop model"))
        for name, curves in friction.by.items():
            marks.append(Line(name, friction.qd[k], curves[k], style(name)))
        limits, axis = _friction_limits(np.concatenate(values), curve), joint.axis("torque", "friction")
        title = f"Friction of {joint.name}"
        chart = line_chart(marks, title, joint.axis("velocity"), axis, limits=limits, height=220)
        panels.append(Panel(joint.name, (chart,)))
    return panels


def _friction_limits(values: np.ndarray, curve: np.ndarray) -> tuple[float, float] | None:
    """Return limits of the friction axis that contain the model's curve, and all measured values except outliers.

    values: measured friction [Nm, N]. curve: friction of the model [Nm, N]. None if no value is finite.
    """
    values = values[np.isfinite(values)]
    if not values.size:
        return None
    # Outliers occur at reversals of motion, if a filter or a delay shifts the measured friction.
    low, high = np.quantile(values, [1 - TUNING.bulk, TUNING.bulk])
    room = 0.15 * (high - low) or 1.0
    return float(np.fmin(low, np.nanmin(curve)) - room), float(np.fmax(high, np.nanmax(curve)) + room)


def coverage_panels(
    traces: Traces, identified: Content | None, joints: Sequence[NamedJoint], limits: Limits
) -> list[Panel]:
    """Return charts per joint: histograms of position and velocity in training and test logs, and position limits.

    Args:
        traces: curves of the evaluation, with the histograms of the test logs.
        identified: content of least_squares.json, with the histograms of the training logs; None if absent.
        joints: Names and units of the joints.
        limits: position limits of the joints.
    """
    logs = {"training": (identified or {}).get("coverage")}
    logs["test"] = traces.coverage
    panels = []
    for k, joint in enumerate(joints):
        charts = []
        for key, quantity in (("q", "position"), ("qd", "velocity")):
            bands = [_histogram(name, covered[key][k]) for name, covered in logs.items() if covered]
            # `bands` has the histogram of the training logs if the run has results of least squares, and the histogram
            # of the test logs if the model was evaluated. Without both there is nothing to show.
            if not bands:
                return []
            marks: list[Mark] = list(bands)
            top = max(float(np.max(band.high)) for band in bands)
            if key == "q":
                for bound in limits[k] or ():
                    marks.append(Line("joint limits", (bound, bound), (0.0, top), "hold"))
            title, labels = f"{quantity} of {joint.name}", (joint.axis(quantity), "fraction of samples")
            charts.append(line_chart(marks, title, *labels, width=300, height=130))
        panels.append(Panel(joint.name, tuple(charts)))
    return panels


def _histogram(name: str, histogram: Content) -> Band:
    """Return the outline of a histogram of logged values, scaled so that the heights of its bars sum to one.

    name: "training" or "test". histogram: counts of the bars, and lowest and highest value.
    """
    counts = array(histogram["counts"])
    # Each bar has two points, which form the steps of the outline.
    edges = np.linspace(histogram["low"], histogram["high"], len(counts) + 1)
    heights = np.repeat(counts / max(counts.sum(), 1.0), 2)
    style = "train" if name == "training" else "model"
    return Band(f"{name} logs", np.repeat(edges, 2)[1:-1], np.zeros_like(heights), heights, style)
