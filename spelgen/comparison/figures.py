"""Figures of a model trained on the paper's simulated protocol: losses, sizes, invariants, and the error of M.

Source: Wang, Chen and Ding, Sci Rep 15:33179 (2025).
"""

from __future__ import annotations

import statistics
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import torch

from spelgen.arm.configured_arm import load_arm
from spelgen.baselines.predictor import Predictor, of_dynamics
from spelgen.dynamics.parameters import parameter_count
from spelgen.evaluation.drawn_motions import PredictedMotion, predicted_motion
from spelgen.evaluation.plain import Curve, finite
from spelgen.evaluation.rollout import energy_rise, mass_error, smallest_eigenvalue, true_mass
from spelgen.fitting.rollout import loss_scales, position_difference, roll_out, rollout_loss
from spelgen.logs.trajectory import Trajectory
from spelgen.logs.windows import Windows, cut_windows
from spelgen.settings.fits import DEFAULTS, Rollout

if TYPE_CHECKING:
    from spelgen.emission.assemble import ArmModel
    from spelgen.fitting.fitted import Fit


@dataclass(frozen=True)
class ComparisonTuning:
    """Constants of `spelgen compare`."""

    # Largest number of windows from which a loss is computed; a larger set is subsampled evenly.
    windows: int = 512
    # Number of timed training steps. Their median is used, because other programs run at the same time.
    timed_steps: int = 5
    # Time over which motions are predicted [s], as in Wang et al., Sci Rep 15:33179 (2025).
    horizon: float = 1.0
    # Time of the measurements after the training of a run [s]. This constant and the next two only serve to estimate
    # the time of a comparison; they were measured with robots/two_link.urdf.
    measuring: float = 10.0
    # Time of a training step with the momentum objective, divided by the time of a step with the rollout objective.
    # The ratio is below 1 because the momentum objective integrates no differential equation.
    momentum_cost: float = 0.5
    # Assumed time of a run on logs [s], used until a run of the same arm and preset is finished.
    run_on_logs: float = 60.0


TUNING = ComparisonTuning()


Figures = dict[str, int | float | None]
"""Row of a table -> figure; None for a figure that is not finite."""

NETWORKS = {"mass": "M", "friction": "D", "input_network": "G", "potential": "V"}
"""Part of the name of a network -> the matrix or the potential energy that the network computes."""


@dataclass(frozen=True)
class SimulatedFigures:
    """Figures of a model of a simulated arm.

    losses: squared errors of predictions, and the relative error of M (see `mass_error`). sizes: sizes of the networks,
    time of a training step, and invariants. example: a test motion and its prediction; None if no test motion lasts
    1 s. mass: (T, n, n) learned M at the measured positions of the example.
    """

    losses: Figures
    sizes: Figures
    mass: Curve | None
    example: PredictedMotion | None


def simulated_figures(
    fit: Fit, training: Sequence[Trajectory], testing: Sequence[Trajectory], truth: Path
) -> SimulatedFigures:
    """Measure a fit on the simulated logs of the arm whose true parameters are in the URDF `truth` and its settings."""
    model, substeps = fit.model, int(fit.substeps)
    decimation = fit.preprocessing.decimation or 1
    config = fit.config if isinstance(fit.config, Rollout) else Rollout()
    steps = round(TUNING.horizon / (decimation * float(testing[0].t[1] - testing[0].t[0])))
    far = spread_windows(testing, steps + 1, decimation)
    # Positive definiteness of M is tested within the joint limits, the error of M is measured at logged positions.
    joints = fit.record.joints
    ranges = [x.working_range for x in load_arm(truth, joints).chain.coordinates]
    low, high = torch.tensor(ranges, dtype=torch.float64).T
    visited = far.q[:, 0]
    example = predict_example(of_dynamics("", model, far), testing, steps, decimation)
    mass = None if example is None else model.mass_matrix(torch.from_numpy(example.q)).numpy()
    loss, position, velocity = prediction_loss(model, far, substeps)
    losses: Figures = {"prediction loss, 1 s": loss, "velocity, 1 s": velocity, "position, 1 s": position}
    losses["M, relative error"] = mass_error(model.mass_matrix(visited), true_mass(truth, visited, joints))
    # These two losses are of windows as long as in training.
    for label, logs in (("training loss", training), ("test loss", testing)):
        windows = spread_windows(logs, config.window, decimation)
        losses[label] = prediction_loss(model, windows, substeps)[0]
    rows = sizes(model)
    rows["training step [ms]"] = 1e3 * step_seconds(model, training, config, decimation)
    with torch.no_grad():
        rows["smallest eigenvalue of M / mean"] = smallest_eigenvalue(model, low, high)
        rows["rise of energy, no input"] = energy_rise(model, far)
    return SimulatedFigures(losses, rows, mass, example)


def step_seconds(model: ArmModel, logs: Sequence[Trajectory], config: Rollout, decimation: int) -> float:
    """Return the median time to compute the loss of a batch and its gradient [s]; the optimizer is not included."""
    windows = spread_windows(logs, config.window, decimation)[: config.batch or DEFAULTS.batch]
    scales = loss_scales(windows, model.joint_types)
    # Parameters of loaded models are frozen, but a training step needs gradients.
    model.requires_grad_(True)
    durations = []
    for _ in range(TUNING.timed_steps):
        start = time.perf_counter()
        torch.autograd.backward(rollout_loss(model, windows, scales, 1))
        durations.append(time.perf_counter() - start)
    model.zero_grad()
    return statistics.median(durations)


def spread_windows(logs: Sequence[Trajectory], samples: int, decimation: int) -> Windows:
    """Return at most about `TUNING.windows` windows, evenly spread over the logs."""
    # Windows start at multiples of the decimation: the simulated controller changes its torque at such samples only.
    starts = sum(max(0, len(log) - (samples - 1) * decimation) for log in logs)
    stride = -(-max(1, -(-starts // TUNING.windows)) // decimation) * decimation
    return cut_windows(logs, samples, stride, decimation, measured=False)


def prediction_loss(model: ArmModel, windows: Windows, substeps: int) -> tuple[float | None, ...]:
    """Return three squared errors of predictions from the first sample of the windows.

    They are sums over joints and means over windows and samples, in units of rad, m and s: the sum of both other errors
    (eq. 8 of the paper), the position error (for revolute joints the geodesic distance), and the velocity error. None:
    the error is not finite. substeps: integrator steps per sample.
    """
    with torch.no_grad():
        q, qd = roll_out(model, windows, substeps)
        difference = position_difference(q, windows.q[:, 1:], model.joint_types)
        position = difference.square().sum(dim=-1).mean()
        velocity = (qd - windows.qd[:, 1:]).square().sum(dim=-1).mean()
    return finite(torch.stack([position + velocity, position, velocity]))


def sizes(model: ArmModel) -> Figures:
    """Return the numbers of outputs of the networks of M, D, G and V, residual networks included.

    Also return the number of inputs of the network of M, and the number of trained parameters of the model.
    """
    figures: Figures = {f"outputs of {matrix}": 0 for matrix in NETWORKS.values()}
    # Friction without a network counts as one output per joint.
    figures |= {"outputs of D": model.n, "inputs of M": 0}
    for name, module in model.named_modules():
        masks = [x for key, x in module.named_buffers(recurse=False) if key.startswith("mask")]
        for quantity in NETWORKS.keys() & name.split("."):
            if masks:
                # Outputs without inputs are not counted: V of an arm without gravity has one such output.
                outputs = int(masks[-1].flatten(1).any(dim=1).sum())
                figures[f"outputs of {NETWORKS[quantity]}"] = outputs
            if masks and quantity == "mass":
                figures["inputs of M"] = int(masks[0].flatten(1).any(dim=0).sum())
    return figures | {"parameters": parameter_count(model)}


def predict_example(
    predictor: Predictor, logs: Sequence[Trajectory], steps: int, decimation: int
) -> PredictedMotion | None:
    """Predict the middle of the first log that has `steps` steps of `decimation` samples; None without such a log."""
    span = steps * decimation
    for log in logs:
        if len(log) > span:
            # The start is a multiple of the decimation, because the controller holds its torque for that many samples.
            start = (len(log) - 1 - span) // (2 * decimation) * decimation
            piece = log[start : start + span + 1]
            window = cut_windows([piece], steps + 1, decimation=decimation, measured=False)
            return predicted_motion(log.name, window, predictor.solver(window))
    return None
