"""Predict windows with a model: an ODE solve from the first sample, the input held over each step."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

import torch

from spelgen.dynamics.equations import mass_as_learned, runge_kutta
from spelgen.dynamics.protocol import known_past, memory_after, memory_along, sliding_memory
from spelgen.errors import LogError
from spelgen.fitting.tuning import AdaptiveTuning, IntegrationTuning
from spelgen.logs.windows import Windows
from spelgen.runtime.port_hamiltonian import PortHamiltonian
from spelgen.settings.fits import Solver

if TYPE_CHECKING:
    from spelgen.emission.assemble import ArmModel

TUNING, ADAPTIVE = IntegrationTuning(), AdaptiveTuning()
SOLVER: dict[str, Any] = {"method": "dopri5", "rtol": ADAPTIVE.relative, "atol": ADAPTIVE.absolute}
AT_REST = 1e-6  # [rad, m] finer than encoders


def roll_out(
    model: PortHamiltonian, windows: Windows, substeps: int = 1, solver: Solver = "rk4"
) -> tuple[torch.Tensor, torch.Tensor]:
    """Return positions and velocities (W, K-1, n) predicted for samples 1..K-1 of each window from its sample 0.

    The state is (q, p), p = M(q) qd, so that no derivative of M in time is needed. Windows make one batch, each with
    its own sample times, and every interval between samples is solved by itself: the input jumps at its ends.
    solver: "rk4" takes `substeps` steps of the classical Runge-Kutta method in each, "dopri5" as many as its tolerance
    asks for. The weights stay the same over the whole window, and are prepared once.
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

        def rhs(
            q: torch.Tensor, p: torch.Tensor, z: torch.Tensor, tau: torch.Tensor = tau
        ) -> tuple[torch.Tensor, torch.Tensor]:
            return model.port_hamiltonian_rhs(q, p, tau, prepared, *known_past(model, z))

        for substep in range(substeps):
            q, p, z, qd = advance(model, rhs, q, p, z, dt.unsqueeze(-1) / substeps)
            if substep == 0:
                velocities.append(qd)  # of the sample that the interval starts at
        positions.append(q)
    velocities = [*velocities[1:], model.velocity(model.at(q, prepared=prepared), p)]
    return torch.stack(positions, dim=1), torch.stack(velocities, dim=1)  # each (W, K-1, n)


def _adaptive_step(
    dynamics: object,
    rhs: Callable[[torch.Tensor, torch.Tensor, torch.Tensor], tuple[torch.Tensor, torch.Tensor]],
    q: torch.Tensor,
    p: torch.Tensor,
    z: torch.Tensor,
    step: torch.Tensor | float,
) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor, torch.Tensor]:
    """As `runge_kutta`, in as many steps as the tolerance asks for; gradients go through the solver.

    Dormand and Prince, J. Comput. Appl. Math. 6 (1980). Windows are solved together, in units of their own steps.
    """
    from torchdiffeq import odeint  # half a second, for those who ask for dopri5 alone

    def slope(t: torch.Tensor, state: torch.Tensor) -> torch.Tensor:
        q_now, p_now = state.chunk(2, dim=-1)
        return step * torch.cat(rhs(q_now, p_now, memory_after(dynamics, z, q_now - q)), dim=-1)

    unit = torch.tensor([0.0, 1.0], dtype=q.dtype, device=q.device)
    q_end, p_end = odeint(slope, torch.cat([q, p], dim=-1), unit, **SOLVER)[-1].chunk(2, dim=-1)
    return q_end, p_end, memory_after(dynamics, z, q_end - q), rhs(q, p, z)[0]


def position_difference(
    predicted: torch.Tensor, measured: torch.Tensor, joint_types: Sequence[str]
) -> torch.Tensor:
    """Return the signed distance (..., n): prismatic the difference, revolute the geodesic distance on SO(3).

    For rotations about one common axis, R = exp(q e), the geodesic distance |log(R^T R')| / sqrt(2) is the
    wrapped angle |q' - q - 2 pi round((q' - q) / 2 pi)|, so the log map of SPEL eq. 8 needs no matrices
    here.
    """
    revolute = torch.tensor([kind == "revolute" for kind in joint_types], device=predicted.device)
    difference = predicted - measured
    turns = torch.round(difference.detach() / (2 * math.pi))
    return difference - 2 * math.pi * torch.where(revolute, turns, 0.0)


class LossScales(NamedTuple):
    """Hold one unit of error of q, qd and tau.

    q, qd: for each sample but the first and joint (K-1, n), the root mean square change since the window's first
    sample. tau: for each joint (n,) the standard deviation.
    """

    q: torch.Tensor
    qd: torch.Tensor
    tau: torch.Tensor

    def to(self, device: str | torch.device) -> LossScales:
        """The same scales on another device."""
        return LossScales(*(x.to(device) for x in self))


def loss_scales(windows: Windows, joint_types: Sequence[str]) -> LossScales:
    """Return the scales of these windows; for a joint that hardly moves, a hundredth of the largest one.

    Raises LogError where none moves at all: any model predicts rest.
    """
    moved = position_difference(windows.q[:, 1:], windows.q[:, :1], joint_types)
    if moved.abs().max() < AT_REST:
        raise LogError(
            f"windows in which no joint moves by {AT_REST:g} rad or m", expected="motion", do="record some"
        )
    changed = windows.qd[:, 1:] - windows.qd[:, :1]
    varied = windows.tau - windows.tau.mean(dim=(0, 1))
    return LossScales(
        _scale(moved.square().mean(dim=0)),
        _scale(changed.square().mean(dim=0)),
        _scale(varied.square().mean(dim=(0, 1))),
    )


def _scale(mean_square: torch.Tensor) -> torch.Tensor:
    root = mean_square.sqrt()
    smallest = (1e-2 * root.amax(dim=-1, keepdim=True)).clamp(min=1e-9)
    return torch.maximum(root, smallest)


def rollout_errors(
    model: ArmModel, windows: Windows, scales: LossScales, substeps: int, solver: Solver = "rk4"
) -> torch.Tensor:
    """Return scaled errors (W, K-1, 2n) of the rollout: of the positions, then of the velocities."""
    q, qd = roll_out(model, windows, substeps, solver)
    position = position_difference(q, windows.q[:, 1:], model.joint_types) / scales.q
    return torch.cat([position, (qd - windows.qd[:, 1:]) / scales.qd], dim=-1)


def rollout_loss(
    model: ArmModel, windows: Windows, scales: LossScales, substeps: int, solver: Solver = "rk4"
) -> torch.Tensor:
    """SPEL eq. 8: squared geodesic distance plus squared velocity error, here scaled per joint and averaged.

    The paper sums over joints and samples in rad and rad/s; scaled, a wrist counts as much as a shoulder and
    the next sample as much as the last, and 1 is the loss of predicting that nothing changes.
    """
    return rollout_errors(model, windows, scales, substeps, solver).square().mean()


def momentum_loss(model: ArmModel, windows: Windows, scales: LossScales) -> torch.Tensor:
    """Return the error of the weak form: p(t) - p(0) against the impulse of all forces along the measured samples.

    Forces between samples are the mean of their values at both ends (trapezium rule): no ODE is solved and no
    acceleration needed. What is missing is told as mean torque, in units of its standard deviation at the
    joint. (Told as a velocity, M(q)^-1 times it, it would reward an M that is too large: errors of the measured
    torque would count less.)
    """
    q, qd, tau = windows.q, windows.qd, windows.tau  # (W, K, n), (W, K, n), (W, K-1, n)
    dynamics, dt = model, windows.dt.unsqueeze(-1)
    # velocities are measured, so M need not be positive definite on the way; kept so, descent stops where it is not
    with mass_as_learned(model):
        at = dynamics.configuration(q, model.prepare())
    p = (at.mass @ qd.unsqueeze(-1)).squeeze(-1)
    force = dynamics.lagrangian_gradient(at, qd)
    past = known_past(model, memory_along(model, q, qd, windows.z))
    force = force - dynamics.friction_torque(at, qd, *past)
    driven = [
        dynamics.input_force(at, qd, torch.cat(held, dim=1))
        for held in ((tau, tau[:, -1:]), (tau[:, :1], tau))  # over the interval after each sample, and before
    ]
    mean = (force[:, :-1] + driven[0][:, :-1] + force[:, 1:] + driven[1][:, 1:]) / 2
    missing = (p[:, 1:] - p[:, :1] - (dt * mean).cumsum(dim=1)) / dt.cumsum(dim=1)
    with torch.no_grad():
        inputs = dynamics.input_matrix(q).abs()
    unit = (inputs @ scales.tau).mean(dim=(0, 1))  # gears may stand between motor and joint
    result: torch.Tensor = (missing / torch.maximum(unit, 1e-2 * unit.amax())).square().mean()
    return result


def probed(model: ArmModel, windows: Windows, scales: LossScales, substeps: int) -> torch.Tensor:
    """Return `rollout_errors` without gradients, NaN where numbers blow up."""
    try:
        with torch.no_grad():
            return rollout_errors(model, windows, scales, substeps)
    except torch.linalg.LinAlgError:
        return torch.tensor(math.nan)


def integration_error(coarse: torch.Tensor, fine: torch.Tensor) -> float:
    """Return the difference of scaled errors of a rollout and of one with twice as many steps, relative to the latter.

    Both are root mean squares in units of `scales`; of the model's error, at least `least_error` is taken.
    """
    model_error = max(fine.square().mean().sqrt().item(), TUNING.least_error)
    error = (coarse - fine).square().mean().sqrt().item() / model_error
    return error if math.isfinite(error) else math.inf


def choose_substeps(model: ArmModel, windows: Windows, scales: LossScales, start: int = 1) -> int:
    """Return the fewest rk4 steps per sample interval, from `start` on, with a small error of integration."""
    substeps, coarse = start, probed(model, windows, scales, start)
    while substeps < TUNING.most_substeps:
        fine = probed(model, windows, scales, 2 * substeps)
        if integration_error(coarse, fine) < TUNING.fraction:
            break
        substeps, coarse = 2 * substeps, fine
    return substeps
