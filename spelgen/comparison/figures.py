"""Results of a model on the simulated protocol of Wang, Chen and Ding, Sci Rep 15:33179 (2025).

The results are losses, the number of parameters, the number of outputs (learned functions of M), and the error of M.
"""

import statistics
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import cast

import torch

from spelgen.dynamics.parameters import parameter_count
from spelgen.emission.assemble import ArmModel
from spelgen.evaluation.plain import finite
from spelgen.evaluation.rollout import mass_error, true_mass
from spelgen.fitting.fitted import Fit
from spelgen.fitting.rollout import loss_scales, position_difference, roll_out, rollout_loss
from spelgen.logs.trajectory import Trajectory
from spelgen.logs.windows import Windows, cut_windows
from spelgen.settings.fits import DEFAULTS, Rollout


@dataclass(frozen=True)
class ComparisonTuning:
    """Constants of `spelgen compare`."""

    # [1] Approximate largest number of windows from which a loss is computed: windows start at larger distances in
    # longer logs.
    windows: int = 512
    # [1] Number of training steps whose time is measured. The median of their times is used, because other programs on
    # the machine delay some of them.
    timed_steps: int = 5
    # [s] Time over which motions are predicted, as in Wang et al., Sci Rep 15:33179 (2025).
    horizon: float = 1.0
    # [s] Duration of the evaluation of a run after its training, for the estimated duration of a comparison. Measured
    # with robots/two_link.urdf, like `momentum_cost` and `run_on_logs`.
    measuring: float = 1.0
    # [1] Duration of a training step with the momentum objective, divided by the duration of a step with the rollout
    # objective. A momentum step is shorter, because it needs no numerical integration.
    momentum_cost: float = 0.5
    # [s] Estimated duration of a run on logs of the user, until a run of the same arm and preset is finished.
    run_on_logs: float = 60.0


TUNING = ComparisonTuning()


Figures = dict[str, int | float | None]
"""{row of a table: figure}; the figure is None if it is not finite."""

NETWORKS = {"mass": "M", "friction": "D", "input_network": "G", "potential": "V"}
"""{part of the name of a network: the matrix or the potential energy that the network computes}."""


def simulated_figures(
    fit: Fit, training: Sequence[Trajectory], testing: Sequence[Trajectory], truth: Path
) -> tuple[Figures, Figures]:
    """Return the losses and the sizes of a model of a simulated arm, for the comparison with other models.

    Losses are squared prediction errors (see `prediction_loss`), and the relative error of M (`mass_error`). Sizes are
    the numbers of network outputs, inputs and parameters, and the duration of a training step [ms].

    truth: URDF with the true parameters of the arm. training: logs for the training loss and the duration of a step.
    testing: logs for all other results.
    """
    model, substeps = fit.model, int(fit.checkpoint.substeps)
    decimation = fit.preprocessing.decimation or 1
    config = cast("Rollout", fit.config)  # All fits to simulated logs have the rollout objective.
    steps = round(TUNING.horizon / (decimation * float(testing[0].t[1] - testing[0].t[0])))
    far = spread_windows(testing, steps + 1, decimation)
    visited = far.q[:, 0]
    loss, position, velocity = prediction_loss(model, far, substeps)
    losses = {"prediction loss, 1 s": loss, "velocity, 1 s": velocity, "position, 1 s": position}
    losses["M, relative error"] = mass_error(
        model.mass_matrix(visited), true_mass(truth, visited, fit.record.joints)
    )
    # The training loss is the loss that the fit minimises. The windows of training loss and test loss are therefore as
    # long as the windows of the fit. The windows of the prediction loss above are 1 s long.
    for label, logs in (("training loss", training), ("test loss", testing)):
        windows = spread_windows(logs, config.window, decimation)
        losses[label] = prediction_loss(model, windows, substeps)[0]
    step = {"training step [ms]": 1e3 * step_seconds(model, training, config, decimation)}
    return losses, sizes(model) | step


def step_seconds(model: ArmModel, logs: Sequence[Trajectory], config: Rollout, decimation: int) -> float:
    """Return the median time to compute the loss of a batch and its gradient [s]; the optimizer is not included.

    config: length of the windows and size of the batch. decimation: log samples per sample of a window.
    """
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
    """Return windows that are evenly spread over the logs, at most `TUNING.windows` plus one per log.

    A window contains `samples` samples: every `decimation`-th sample of a log.
    """
    # The simulated controller changes its torque only at samples that are multiples of the decimation, so a window
    # starts at such a sample.
    starts = sum(max(0, len(log) - (samples - 1) * decimation) for log in logs)
    stride = -(-max(1, -(-starts // TUNING.windows)) // decimation) * decimation
    return cut_windows(logs, samples, stride, decimation, measured=False)


def prediction_loss(model: ArmModel, windows: Windows, substeps: int) -> tuple[float | None, ...]:
    """Return the total, the position and the velocity error of predictions from the first sample of each window.

    The position error is the squared error of q [rad^2, m^2], summed over joints and averaged over windows and samples;
    the error of a revolute position is the geodesic distance. The velocity error is computed from qd [rad/s, m/s] in
    the same way. The total is the sum of the numbers of the position and the velocity error, eq. 8 of Wang et al.
    (2025). An error that is not finite is None. substeps: integrator steps per sample.
    """
    with torch.no_grad():
        q, qd = roll_out(model, windows, substeps)
        difference = position_difference(q, windows.q[:, 1:], model.joint_types)
        position = difference.square().sum(dim=-1).mean()
        velocity = (qd - windows.qd[:, 1:]).square().sum(dim=-1).mean()
    return finite(torch.stack([position + velocity, position, velocity]))


def sizes(model: ArmModel) -> Figures:
    """Return {row of a table: size of the model}.

    The rows are the number of outputs of each network (of M, damping D, input matrix G and potential energy V, residual
    networks included), the number of inputs of the network of M, and the number of trained parameters.
    """
    figures: Figures = {f"outputs of {matrix}": 0 for matrix in NETWORKS.values()}
    # If no network computes the damping D, each joint has a friction model, which is counted as one output.
    figures |= {"outputs of D": model.n, "inputs of M": 0}
    for name, module in model.named_modules():
        masks = [x for key, x in module.named_buffers(recurse=False) if key.startswith("mask")]
        for quantity in NETWORKS.keys() & name.split("."):
            if masks:
                # An output that depends on no input is not counted. The network of V has such an output if the arm has
                # no gravity torque.
                outputs = int(masks[-1].flatten(1).any(dim=1).sum())
                figures[f"outputs of {NETWORKS[quantity]}"] = outputs
            if masks and quantity == "mass":
                figures["inputs of M"] = int(masks[0].flatten(1).any(dim=0).sum())
    return figures | {"parameters": parameter_count(model)}
