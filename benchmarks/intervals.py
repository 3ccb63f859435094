"""95 % intervals of a fitted arm, compared with the truth of a simulated arm."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from torch.autograd.functional import jacobian

from spelgen.dynamics.protocol import is_stateful, sliding_memory
from spelgen.emission.assemble import ArmModel
from spelgen.fitting.functional_model import evaluate_with
from spelgen.fitting.torque.parameters import ParameterVector

QUANTITIES = ("base", "friction", "mass", "gravity")
QUANTILE = 1.96


@dataclass(frozen=True, eq=False)
class SteadySliding:
    """Conditions under which friction constants are compared: magnitudes of Coulomb and viscous friction at two speeds.

    q: (T, n) positions over which friction is averaged. speeds: (speeds, n) [rad/s, m/s]. The friction of a speed is
    half the difference of both directions, long after a reversal.
    """

    q: np.ndarray
    speeds: np.ndarray


@dataclass(frozen=True, eq=False)
class TrueValues:
    """True values. combination: (r, K), base parameters from bodies and armatures. base: (r,). friction: (speeds, n).

    mass: M (T, n, n) and gravity: g (T, n), at some positions.
    """

    combination: np.ndarray
    base: np.ndarray
    friction: np.ndarray
    mass: np.ndarray
    gravity: np.ndarray


def interval_ratios(
    model: ArmModel, covariance: torch.Tensor, true: TrueValues, sliding: SteadySliding, q: np.ndarray
) -> dict[str, list[float]]:
    """Return the errors divided by the half width of the 95 % interval, per quantity of `QUANTITIES`.

    Values whose truth is zero with an error of zero (joints that gravity does not load) are omitted.

    Args:
        model: fitted model.
        covariance: (K, K) of its rigid parameters, propagated to first order.
        true: values, with g and M at the positions q.
        sliding: conditions of the friction constants.
        q: (T, n) positions.
    """
    parameters = ParameterVector(model).initial
    positions, combination = torch.from_numpy(q), torch.from_numpy(true.combination)
    sizes: list[int] = []

    def quantities(*tensors: torch.Tensor) -> torch.Tensor:
        named = dict(zip(parameters, tensors, strict=True))
        return evaluate_with(model, named, all_of)

    def all_of(other: ArmModel) -> torch.Tensor:
        base = combination @ torch.cat([other.inertial_parameters.flatten(), other.armature])
        mass = other.mass_matrix(positions).diagonal(dim1=-2, dim2=-1)
        values = [base, _sliding_friction(other, sliding), mass.flatten(), other.gravity(positions).flatten()]
        sizes[:] = [len(x) for x in values]
        return torch.cat(values)

    value = quantities(*parameters.values()).detach().numpy()
    blocks = jacobian(quantities, tuple(parameters.values()))
    slopes = torch.cat([block.flatten(1) for block in blocks], dim=1)
    variance = torch.einsum("jk,kl,jl->j", slopes, covariance, slopes)
    half = QUANTILE * variance.clamp(min=0).sqrt().numpy()
    diagonal = np.diagonal(true.mass, axis1=1, axis2=2)
    truth = np.concatenate([x.ravel() for x in (true.base, true.friction, diagonal, true.gravity)])
    error = np.abs(value - truth)
    informative = (error > 1e-9 * np.abs(truth).max()) | (half > 1e-9 * np.abs(truth).max())
    ratio = np.where(informative, error / np.maximum(half, 1e-12), np.nan)
    parts = np.split(ratio, np.cumsum(sizes)[:-1])
    return {
        name: [round(float(x), 3) for x in part[~np.isnan(part)]]
        for name, part in zip(QUANTITIES, parts, strict=True)
    }


def _sliding_friction(model: ArmModel, sliding: SteadySliding) -> torch.Tensor:
    q, rows = torch.from_numpy(sliding.q), []
    for speed in torch.from_numpy(sliding.speeds):
        both = []
        for qd in (speed.expand_as(q), -speed.expand_as(q)):
            past = (sliding_memory(model, qd),) if is_stateful(model) else ()
            both.append(model.friction_torque(q, qd, *past))
        rows.append((both[0] - both[1]).mean(dim=0) / 2)
    return torch.cat(rows)
