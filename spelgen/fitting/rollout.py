"""Prediction of windows by a model, and the losses of predictions.

The equations of motion are integrated from a window's first sample, with the input constant between samples.
"""

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
from spelgen.runtime.parts import applied
from spelgen.runtime.port_hamiltonian import PortHamiltonian
from spelgen.settings.fits import Solver

SOLVER: dict[str, object] = {"method": "dopri5", "rtol": TUNING.adaptive_rtol, "atol": TUNING.adaptive_atol}
AT_REST = 1e-6  # [rad, m] largest displacement of joints at rest; below the resolution of encoders


def roll_out(
    model: PortHamiltonian, windows: Windows, substeps: int = 1, solver: Solver = "rk4"
) -> tuple[Tensor, Tensor]:
    """Return the predicted positions and velocities, (W, K-1, n) each, of W windows with K samples.

    Sample 0 of a window is the initial state; samples 1 to K-1 are predicted. The state is (q, p) with p = M(q) qd, so
    that no time derivative of M is needed. Each interval between samples is integrated separately, since the input
    jumps at its ends. All windows are integrated together; each has its own sample times.

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
            """Return dq/dt and dp/dt, (W, n), at q, momenta p = M qd and friction state z under inputs tau."""
            return model.port_hamiltonian_rhs(q, p, tau, prepared, *known_past(model, z))

        for substep in range(substeps):
            q, p, z, qd = advance(model, rhs, q, p, z, dt.unsqueeze(-1) / substeps)
            if substep == 0:
                velocities.append(qd)  # velocity at the start of the interval
        positions.append(q)
    # The integrator returns the velocity at the start of each interval. The first velocity is measured and not
    # returned; the last one is computed here.
    velocities = [*velocities[1:], model.velocity(model.at(q, prepared=prepared), p)]
    # positions and velocities, (W, K-1, n) each
    return torch.stack(positions, dim=1), torch.stack(velocities, dim=1)


def _adaptive_step(
    dynamics: object,
    rhs: Callable[[Tensor, Tensor, Tensor], tuple[Tensor, Tensor]],
    q: Tensor,
    p: Tensor,
    z: Tensor,
    step: Tensor | float,
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Return q, p, z at the end of an interval, integrated with adaptive steps, and dq/dt at the start of the interval.

    The solver is dopri5 (Dormand and Prince, J. Comput. Appl. Math. 6, 1980); gradients are propagated through its
    steps. All W windows are integrated together, although their intervals differ in duration: time is divided by the
    duration.

    Args:
        dynamics: dynamics whose `memory_after` computes z from the displacement of the joints.
        rhs: function of (q, p, z) that returns dq/dt and dp/dt.
        q, p: positions and momenta, (W, n).
        z: friction state of K bristles per joint, (W, n, K).
        step: duration of the interval of each window, (W, 1) [s].
    """
    # torchdiffeq is imported only if needed, since its import takes half a second.
    from torchdiffeq import odeint

    def rate(t: Tensor, state: Tensor) -> Tensor:
        """Return the derivative of the state (q, p), (W, 2 n), with respect to t = time / duration of the interval.

        It is the derivative with respect to time, multiplied by the duration `step`. state: (W, 2 n) for W windows.
        """
        q_now, p_now = state.chunk(2, dim=-1)
        return step * torch.cat(rhs(q_now, p_now, memory_after(dynamics, z, q_now - q)), dim=-1)

    unit = torch.tensor([0.0, 1.0], dtype=q.dtype, device=q.device)
    q_end, p_end = odeint(rate, torch.cat([q, p], dim=-1), unit, **SOLVER)[-1].chunk(2, dim=-1)
    return q_end, p_end, memory_after(dynamics, z, q_end - q), rhs(q, p, z)[0]


def position_difference(predicted: Tensor, measured: Tensor, joint_types: Sequence[str]) -> Tensor:
    """Return predicted minus measured positions, (..., n) [rad, m]; for revolute joints wrapped to +-pi.

    For a revolute joint, the magnitude of the wrapped difference is the geodesic distance of the two rotations on
    SO(3), which Wang et al. (Sci Rep 15:33179, 2025, eq. 8) use in their loss.
    """
    revolute = torch.tensor([kind == "revolute" for kind in joint_types], device=predicted.device)
    difference = predicted - measured
    # `turns`, the number of turns between both positions, is constant for the gradient, so the derivative of the
    # wrapped difference with respect to the predicted position is one.
    turns = torch.round(difference.detach() / (2 * math.pi))
    return difference - 2 * math.pi * torch.where(revolute, turns, 0.0)


class LossScales(NamedTuple):
    """Divisors of the errors of q, qd and tau in the losses of windows of K samples.

    Attributes:
        q: (K-1, n) [rad, m], RMS over all windows of the position change from sample 0 to each of the samples 1 to K-1.
        qd: (K-1, n) [rad/s, m/s], the same for the velocity.
        tau: (n,) [Nm, N], standard deviation of the torque.
    """

    q: Tensor
    qd: Tensor
    tau: Tensor

    def to(self, device: str | torch.device) -> LossScales:
        """Return the loss scales on another device."""
        return LossScales(*(x.to(device) for x in self))


def loss_scales(windows: Windows, joint_types: Sequence[str]) -> LossScales:
    """Return the `LossScales`, by which the errors in the loss are divided.

    The scales of q and qd are their RMS changes from the start of a window, the scale of tau its standard deviation. A
    scale is at least 1 % of the largest one of all joints, also for a joint that moves little. Raises LogError if
    no joint moves, since windows at rest do not determine a model. joint_types: see `position_difference`.
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
    """Return the loss scales of n joints, (..., n): roots of `mean_square`, at least 1 % of the largest root."""
    root = mean_square.sqrt()
    # The bound 1e-9 keeps the scale positive even if nothing varies, since errors are divided by the scale.
    smallest = (1e-2 * root.amax(dim=-1, keepdim=True)).clamp(min=1e-9)
    return torch.maximum(root, smallest)


def rollout_errors(
    model: ArmModel, windows: Windows, scales: LossScales, substeps: int, solver: Solver = "rk4"
) -> Tensor:
    """Return predicted minus measured states, divided by ``scales``, (W, K-1, 2n): n positions, then n velocities.

    There are W windows of K samples. The prediction of a window begins at its first sample, which has no error.
    substeps, solver: see `roll_out`.
    """
    q, qd = roll_out(model, windows, substeps, solver)
    position = position_difference(q, windows.q[:, 1:], model.joint_types) / scales.q
    return torch.cat([position, (qd - windows.qd[:, 1:]) / scales.qd], dim=-1)


def rollout_loss(
    model: ArmModel, windows: Windows, scales: LossScales, substeps: int, solver: Solver = "rk4"
) -> Tensor:
    """Return the mean square of `rollout_errors`, a dimensionless scalar.

    If the predicted state remains the initial state, the loss is 1. All joints and samples have the same weight, since
    the errors are divided by ``scales``. Wang et al. (Sci Rep 15:33179, 2025, eq. 8) sum the same errors without
    scales, in rad^2 and rad^2/s^2.
    """
    return rollout_errors(model, windows, scales, substeps, solver).square().mean()


def momentum_loss(model: ArmModel, windows: Windows, scales: LossScales) -> Tensor:
    """Return the mean squared residual of the weak form of the equations of motion, a dimensionless scalar.

    The residual is p(t) - p(0), with the momentum p = M(q) qd, minus the impulse of all forces from 0 to t. The
    residual is divided by t, which gives a mean torque, and by the standard deviation of the joint's torque. The
    impulse is the trapezium sum along the measured samples: neither an ODE solver nor accelerations are needed. The
    velocity error M(q)^-1 times the residual is not used, since it would favour an M that is too large.

    Args:
        model: model with the momentum M(q) qd.
        windows: measured motion (W, K, n) and inputs (W, K-1, n) of W windows of K samples.
        scales: only the scale of the torque, (n,) [Nm, N], is used.
    """
    q, qd, tau, dt = windows.q, windows.qd, windows.tau, windows.dt.unsqueeze(-1)
    # M is not constrained to be positive definite here: it is not inverted, since the velocities are measured. With the
    # constraint, gradient descent would stop at the boundary of the positive definite matrices.
    with mass_as_learned(model):
        configuration = model.configuration(q, model.prepare())
    p = applied(configuration.mass, qd)
    past = known_past(model, memory_along(model, q, qd, windows.z))
    force = model.lagrangian_gradient(configuration, qd) - model.friction_torque(configuration, qd, *past)
    # The input is constant in each interval and jumps at the samples. Each sample therefore has two input forces: one
    # from the interval before the sample, one from the interval after it.
    input_after = model.input_force(configuration, qd, torch.cat((tau, tau[:, -1:]), dim=1))
    input_before = model.input_force(configuration, qd, torch.cat((tau[:, :1], tau), dim=1))
    mean = (force[:, :-1] + input_after[:, :-1] + force[:, 1:] + input_before[:, 1:]) / 2
    residual = (p[:, 1:] - p[:, :1] - (dt * mean).cumsum(dim=1)) / dt.cumsum(dim=1)
    with torch.no_grad():
        inputs = model.input_matrix(q).abs()
    # The scales of motor torques are converted to joint torques, since there may be gears between motors and joints.
    unit = (inputs @ scales.tau).mean(dim=(0, 1))
    return (residual / torch.maximum(unit, 1e-2 * unit.amax())).square().mean()


def probed(model: ArmModel, windows: Windows, scales: LossScales, substeps: int) -> Tensor:
    """Return `rollout_errors`, (W, K-1, 2n), without gradients; a single NaN, (), if a window diverges.

    scales, substeps: as in `rollout_errors`.
    """
    try:
        with torch.no_grad():
            return rollout_errors(model, windows, scales, substeps)
    except torch.linalg.LinAlgError:
        return torch.tensor(math.nan)


def integration_error(coarse: Tensor, fine: Tensor) -> float:
    """Return the RMS integration error of a rollout, divided by the RMS prediction error of the model.

    The integration error is the difference of `coarse` and `fine`, the prediction error is `fine`. A diverged rollout
    gives infinity.

    Args:
        coarse: `rollout_errors` of the rollout, (W, K-1, 2n).
        fine: `rollout_errors` of the rollout with half the step size, (W, K-1, 2n).
    """
    model_error = max(fine.square().mean().sqrt().item(), TUNING.min_model_error)
    error = (coarse - fine).square().mean().sqrt().item() / model_error
    return error if math.isfinite(error) else math.inf


def choose_substeps(model: ArmModel, windows: Windows, scales: LossScales, start: int = 1) -> int:
    """Return a number of rk4 steps per sample interval that makes the integration error small.

    The number is the first of start, 2 start, 4 start, ... with an `integration_error` below
    `TUNING.integration_fraction`. The search ends at `TUNING.max_substeps` even if the error is larger. windows,
    scales: training windows on which the error is measured, and divisors of the errors of q and qd.
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
