"""Prediction of windows by a model: integration from a window's first sample, with zero-order hold of the input."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from spelgen.dynamics.equations import mass_as_learned, runge_kutta
from spelgen.dynamics.protocol import known_past, memory_after, memory_along, sliding_memory
from spelgen.emission.assemble import ArmModel
from spelgen.errors import LogError
from spelgen.fitting.tuning import TUNING
from spelgen.logs.windows import Windows
from spelgen.runtime.port_hamiltonian import PortHamiltonian
from spelgen.settings.fits import Solver

SOLVER: dict[str, object] = {"method": "dopri5", "rtol": TUNING.adaptive_rtol, "atol": TUNING.adaptive_atol}
AT_REST = 1e-6  # [rad, m] largest displacement of joints at rest; below the resolution of encoders


def roll_out(
    model: PortHamiltonian, windows: Windows, substeps: int = 1, solver: Solver = "rk4"
) -> tuple[Tensor, Tensor]:
    """Return positions and velocities (W, K-1, n) predicted for samples 1..K-1 of each window from its sample 0.

    The state is (q, p) with p = M(q) qd, so that no time derivative of M is needed. The windows form one batch, each
    with its own sample times. Each interval between samples is solved separately: the input jumps at its ends.

    Args:
        model: model to integrate; its parameter cache is computed once.
        windows: measured motion (W, K, n) and inputs (W, K-1, n).
        substeps: number of rk4 steps per interval.
        solver: "rk4", the classical Runge-Kutta method, or "dopri5" with adaptive steps.
    """
    prepared = model.prepare()
    q = windows.q[:, 0]
    p = model.momentum(model.at(q, prepared=prepared), windows.qd[:, 0])
    z = sliding_memory(model, windows.qd[:, 0]) if windows.z is None else windows.z
    advance = runge_kutta
    if solver == "dopri5":
        advance, substeps = _adaptive_step, 1
    positions, velocities = [], []
    for dt, tau in zip(windows.dt.unbind(1), windows.tau.unbind(1), strict=True):

        def rhs(q: Tensor, p: Tensor, z: Tensor, tau: Tensor = tau) -> tuple[Tensor, Tensor]:
            """Return dq/dt and dp/dt, (W, n) each."""
            return model.port_hamiltonian_rhs(q, p, tau, prepared, *known_past(model, z))

        for substep in range(substeps):
            q, p, z, qd = advance(model, rhs, q, p, z, dt.unsqueeze(-1) / substeps)
            if substep == 0:
                velocities.append(qd)  # velocity at the start of the interval
        positions.append(q)
    # The integrators return the velocity at the start of each interval: only the velocity at the end is computed here.
    velocities = [*velocities[1:], model.velocity(model.at(q, prepared=prepared), p)]
    return torch.stack(positions, dim=1), torch.stack(velocities, dim=1)  # each (W, K-1, n)


def _adaptive_step(
    dynamics: object,
    rhs: Callable[[Tensor, Tensor, Tensor], tuple[Tensor, Tensor]],
    q: Tensor,
    p: Tensor,
    z: Tensor,
    step: Tensor | float,
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Return q, p and z at the end of one interval, integrated with adaptive steps, and q' at its start.

    Dormand and Prince, J. Comput. Appl. Math. 6 (1980), differentiated through the solver. All W windows are solved
    together, with time in units of each window's interval. rhs: function of (q, p, z) that returns q' and p'. q, p:
    positions and momenta, (W, n). z: friction state, (W, n, K). step: duration of the interval [s].
    """
    from torchdiffeq import odeint  # imported only if needed, since the import takes half a second

    def rate(t: Tensor, state: Tensor) -> Tensor:
        """Return the derivative of the state (q, p), (W, 2 n), with respect to time in units of the interval."""
        q_now, p_now = state.chunk(2, dim=-1)
        return step * torch.cat(rhs(q_now, p_now, memory_after(dynamics, z, q_now - q)), dim=-1)

    unit = torch.tensor([0.0, 1.0], dtype=q.dtype, device=q.device)
    q_end, p_end = odeint(rate, torch.cat([q, p], dim=-1), unit, **SOLVER)[-1].chunk(2, dim=-1)
    return q_end, p_end, memory_after(dynamics, z, q_end - q), rhs(q, p, z)[0]


def position_difference(predicted: Tensor, measured: Tensor, joint_types: Sequence[str]) -> Tensor:
    """Return predicted minus measured positions, (..., n) [rad, m]; for revolute joints wrapped to +-pi.

    Let R = exp(q e) and R' = exp(q' e) be rotations by q and q' about one axis, where e is the skew-symmetric matrix of
    the unit axis. Their geodesic distance |log(R^T R')| / sqrt(2) on SO(3) is the wrapped angle |q' - q - 2 pi
    round((q' - q) / 2 pi)|. This is the position error in the loss (eq. 8) of the paper whose model is the preset
    `spel`, computed without matrices.
    """
    revolute = torch.tensor([kind == "revolute" for kind in joint_types], device=predicted.device)
    difference = predicted - measured
    # The number of turns is detached, since the derivative of the wrapped angle with respect to q' is one.
    turns = torch.round(difference.detach() / (2 * math.pi))
    return difference - 2 * math.pi * torch.where(revolute, turns, 0.0)


class LossScales(NamedTuple):
    """Units in which losses measure errors of q, qd and tau.

    q, qd: (K-1, n) [rad, m, per second], RMS change since the first sample of a window of K samples, for each further
    sample and each joint. tau: (n,) [Nm, N], standard deviation.
    """

    q: Tensor
    qd: Tensor
    tau: Tensor

    def to(self, device: str | torch.device) -> LossScales:
        """Return the scales on another device."""
        return LossScales(*(x.to(device) for x in self))


def loss_scales(windows: Windows, joint_types: Sequence[str]) -> LossScales:
    """Return the scales of windows; for joints that hardly move, 1 % of the largest scale.

    Raises LogError if no joint moves: windows at rest do not determine a model.
    """
    moved = position_difference(windows.q[:, 1:], windows.q[:, :1], joint_types)
    if moved.abs().max() < AT_REST:
        raise LogError(
            f"windows in which no joint moves by {AT_REST:g} rad or m", expected="motion", do="record some"
        )
    changed = windows.qd[:, 1:] - windows.qd[:, :1]
    # The mean torque, mostly due to gravity, is subtracted: it is no measure of the torque that moves the arm.
    varied = windows.tau - windows.tau.mean(dim=(0, 1))
    return LossScales(
        _scale(moved.square().mean(dim=0)),
        _scale(changed.square().mean(dim=0)),
        _scale(varied.square().mean(dim=(0, 1))),
    )


def _scale(mean_square: Tensor) -> Tensor:
    """Return the square roots of mean squares (..., n), each at least 1 % of the largest root of the n joints."""
    root = mean_square.sqrt()
    # The bound 1e-9 keeps the scale positive even if nothing varies, since errors are divided by the scale.
    smallest = (1e-2 * root.amax(dim=-1, keepdim=True)).clamp(min=1e-9)
    return torch.maximum(root, smallest)


def rollout_errors(
    model: ArmModel, windows: Windows, scales: LossScales, substeps: int, solver: Solver = "rk4"
) -> Tensor:
    """Return the errors of the rollout in units of ``scales``, (W, K-1, 2n): n positions, then n velocities.

    There are W windows of K samples; the first sample of a window is the initial state and has no error.
    """
    q, qd = roll_out(model, windows, substeps, solver)
    position = position_difference(q, windows.q[:, 1:], model.joint_types) / scales.q
    return torch.cat([position, (qd - windows.qd[:, 1:]) / scales.qd], dim=-1)


def rollout_loss(
    model: ArmModel, windows: Windows, scales: LossScales, substeps: int, solver: Solver = "rk4"
) -> Tensor:
    """Return the mean square of `rollout_errors`, () [1].

    This is the loss (eq. 8) of the paper whose model is the preset `spel`, with other units. The paper sums squared
    geodesic distances [rad^2] and velocity errors [rad^2/s^2] over joints and samples. With scaled errors, all joints
    and samples have the same weight, and a prediction that the initial state does not change has loss 1.
    """
    return rollout_errors(model, windows, scales, substeps, solver).square().mean()


def momentum_loss(model: ArmModel, windows: Windows, scales: LossScales) -> Tensor:
    """Return the mean squared residual of the weak form, (): p(t) - p(0) minus the impulse of all forces until t.

    The impulse is integrated along the measured samples by the trapezium rule: no ODE solution and no accelerations are
    needed. The residual is divided by the time t, which gives a mean torque, and by the standard deviation of the
    joint's torque. An alternative, the velocity error M(q)^-1 times the residual, would favour an M that is too large.

    Args:
        model: model with the momentum M(q) qd.
        windows: measured motion (W, K, n) and inputs (W, K-1, n).
        scales: the scale of the torque, (n,) [Nm, N], is used.
    """
    q, qd, tau, dt = windows.q, windows.qd, windows.tau, windows.dt.unsqueeze(-1)
    # M is not constrained to be positive definite here. The velocities are measured, so that M need not be inverted;
    # and a gradient descent with the constraint would stop at the boundary of the indefinite matrices.
    with mass_as_learned(model):
        configuration = model.configuration(q, model.prepare())
    p = (configuration.mass @ qd.unsqueeze(-1)).squeeze(-1)
    past = known_past(model, memory_along(model, q, qd, windows.z))
    force = model.lagrangian_gradient(configuration, qd) - model.friction_torque(configuration, qd, *past)
    # The input is constant in each interval and jumps at the samples: each sample has two input forces, one with the
    # input of the interval after the sample, the other with the input of the interval before it.
    input_after = model.input_force(configuration, qd, torch.cat((tau, tau[:, -1:]), dim=1))
    input_before = model.input_force(configuration, qd, torch.cat((tau[:, :1], tau), dim=1))
    mean = (force[:, :-1] + input_after[:, :-1] + force[:, 1:] + input_before[:, 1:]) / 2
    residual = (p[:, 1:] - p[:, :1] - (dt * mean).cumsum(dim=1)) / dt.cumsum(dim=1)
    with torch.no_grad():
        inputs = model.input_matrix(q).abs()
    # The scales of motor torques are converted to joint torques: there may be gears between motors and joints.
    unit = (inputs @ scales.tau).mean(dim=(0, 1))
    result: Tensor = (residual / torch.maximum(unit, 1e-2 * unit.amax())).square().mean()
    return result


def probed(model: ArmModel, windows: Windows, scales: LossScales, substeps: int) -> Tensor:
    """Return `rollout_errors`, (W, K-1, 2n), without gradients; NaN if the rollout diverges."""
    try:
        with torch.no_grad():
            return rollout_errors(model, windows, scales, substeps)
    except torch.linalg.LinAlgError:
        return torch.tensor(math.nan)


def integration_error(coarse: Tensor, fine: Tensor) -> float:
    """Return the integration error of a rollout divided by the error of the model [1].

    Args:
        coarse: (W, K-1, 2n) scaled errors of the rollout.
        fine: (W, K-1, 2n) scaled errors with twice as many steps.
    """
    model_error = max(fine.square().mean().sqrt().item(), TUNING.min_model_error)
    error = (coarse - fine).square().mean().sqrt().item() / model_error
    return error if math.isfinite(error) else math.inf


def choose_substeps(model: ArmModel, windows: Windows, scales: LossScales, start: int = 1) -> int:
    """Return the minimum number of rk4 steps per sample interval, at least `start`, that is accurate enough.

    The integration error of the rollouts is then below `TUNING.integration_fraction` of the error of the model.
    """
    substeps, coarse = start, probed(model, windows, scales, start)
    while substeps < TUNING.max_substeps:
        # Half the step size divides the error of rk4 by 16, so the difference between both rollouts is about the error
        # of the coarse rollout.
        fine = probed(model, windows, scales, 2 * substeps)
        if integration_error(coarse, fine) < TUNING.integration_fraction:
            break
        substeps, coarse = 2 * substeps, fine
    return substeps
