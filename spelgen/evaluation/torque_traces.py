"""Torques along test trajectories: measured, predicted, what they are made of, and where the energy goes."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import torch

from spelgen.dynamics.bristles import BristleReach, bristles_along
from spelgen.dynamics.protocol import known_past
from spelgen.identification.samples import DENSE, FREQUENCY, dynamics_samples
from spelgen.logs.preprocessing import Preprocessing
from spelgen.logs.trajectory import Trajectory

SECONDS = 10.0  # of a trace
SHOWN = 240  # samples of it
State = tuple[torch.Tensor, ...]  # t, q, qd, qdd, tau, and z: friction's memory of the way there


def torque_trace(
    model: Any,
    dynamics: Mapping[str, Any],
    pieces: Sequence[Trajectory],
    used: Preprocessing,
    reach: BristleReach,
) -> list[dict[str, Any]]:
    """Of the trajectory with the middle and the one with the largest torque error, by the model."""
    states = {x.name: state for x in pieces if (state := _states(x, used, reach)) is not None}
    errors = {}
    for name, (_, q, qd, qdd, tau, z) in states.items():
        with torch.no_grad():
            off = (model.inverse_dynamics(q, qd, qdd, *known_past(model, z)) - tau).square().mean(dim=0)
        errors[name] = (off / tau.var(dim=0).clamp(min=1e-12)).mean().nan_to_num(nan=math.inf).item()
    order = sorted(errors, key=lambda name: (errors[name], name))
    chosen = {"typical": order[(len(order) - 1) // 2], "worst": order[-1]} if order else {}
    if len(order) == 1:
        del chosen["worst"]
    return [_trace(which, name, model, dynamics, states[name]) for which, name in chosen.items()]


def _states(piece: Trajectory, used: Preprocessing, reach: BristleReach) -> State | None:
    """t, q, qd, qdd, tau, z of up to ten seconds from the middle of what moves; the torque that acted at these times.

    Of a log too sparse for accelerations the differences from sample to sample, at the middle of each step.
    """
    if piece.sample_rate >= DENSE:
        done = Preprocessing(cutoff=0, gap=used.gap) if used.filtered else used  # pieces are filtered already
        samples = dynamics_samples([piece], pauses=True, preprocessing=done, reach=reach)
        if not samples or len(samples[0].q) < 2:
            return None
        found = samples[0]
        z = np.zeros((*found.q.shape, 0)) if found.z is None else found.z
        columns = (np.arange(len(found.q)) / FREQUENCY, found.q, found.qd, found.qdd, found.tau, z)
    else:
        steps = np.diff(piece.t)[:, None]
        z = bristles_along(piece.q, reach) if reach.elements else np.zeros((*piece.q.shape, 0))
        q, qd, z = ((x[1:] + x[:-1]) / 2 for x in (piece.q, piece.qd, z))
        tau = (piece.tau[1:] + piece.tau[:-1]) / 2 if used.filtered else piece.tau[:-1]
        columns = ((piece.t[1:] + piece.t[:-1]) / 2, q, qd, np.diff(piece.qd, axis=0) / steps, tau, z)
    t = columns[0] - columns[0][0]
    kept = min(len(t), int(np.searchsorted(t, SECONDS)) + 1)
    start = (len(t) - kept) // 2
    kept_columns = (x[start : start + kept] for x in (t - t[start], *columns[1:]))
    return tuple(torch.from_numpy(np.ascontiguousarray(x)) for x in kept_columns)


def _trace(which: str, name: str, model: Any, dynamics: Mapping[str, Any], state: State) -> dict[str, Any]:
    t, q, qd, qdd, tau, z = state
    with torch.no_grad():
        inputs = model.input_matrix(q) if hasattr(model, "input_matrix") else torch.eye(q.shape[-1]).double()

        def at_joints(torque: torch.Tensor) -> torch.Tensor:
            """Gears may stand between a motor and a joint."""
            return (inputs @ torch.as_tensor(torque).unsqueeze(-1)).squeeze(-1)

        gravity = torch.as_tensor(model.gravity(q))
        parts = {
            "inertia": (torch.as_tensor(model.mass_matrix(q)) @ qdd.unsqueeze(-1)).squeeze(-1),
            "Coriolis": torch.as_tensor(model.nonlinear_effects(q, qd)) - gravity,
            "gravity": gravity,
            "friction": torch.as_tensor(model.friction_torque(q, qd, *known_past(model, z))),
        }
        predicted = {
            label: at_joints(each.inverse_dynamics(q, qd, qdd, *known_past(each, z)))
            for label, each in dynamics.items()
        }
        own, tau = at_joints(model.inverse_dynamics(q, qd, qdd, *known_past(model, z))), at_joints(tau)
    told = {"t": t, "q": q, "qd": qd, "measured": tau, "without_friction": own - parts["friction"]}
    stride = -(-len(t) // SHOWN)
    return {
        "which": which,
        "trajectory": name,
        **{key: plain(x[::stride]) for key, x in told.items()},
        "predicted": {label: plain(x[::stride]) for label, x in predicted.items()},
        "parts": {label: plain(x[::stride]) for label, x in parts.items()},
        "energy": {key: plain(x[::stride]) for key, x in _energy(t, qd, tau, own, parts).items()},
    }


def _energy(
    t: torch.Tensor, qd: torch.Tensor, tau: torch.Tensor, own: torch.Tensor, parts: Mapping[str, torch.Tensor]
) -> dict[str, torch.Tensor]:
    """Where the drives' work went since the start, (T,) [J]: stored, lost to friction, not explained.

    Powers by the model's torques on the measured motion; an offset of the torque is with the friction.
    """
    stored = parts["inertia"] + parts["Coriolis"] + parts["gravity"]
    powers = {
        "work of the drives": tau,
        "stored": stored,
        "friction": own - stored,
        "not explained": tau - own,
    }
    steps = t.diff()

    def work(torque: torch.Tensor) -> torch.Tensor:
        power = (torque * qd).sum(dim=-1)
        return torch.cat([power.new_zeros(1), ((power[1:] + power[:-1]) / 2 * steps).cumsum(dim=0)])

    return {name: work(torque) for name, torque in powers.items()}


def plain(values: Any) -> Any:
    """Numbers, arrays and tensors as lists for JSON: five digits, None where not finite."""
    if hasattr(values, "tolist"):
        values = values.tolist()
    if isinstance(values, list):
        return [plain(x) for x in values]
    return float(f"{values:.5g}") if math.isfinite(values) else None
