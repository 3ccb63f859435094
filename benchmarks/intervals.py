"""95 % intervals of a fitted arm, compared with the true values of the simulated arm that made its logs."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch

from spelgen.dynamics.protocol import is_stateful, sliding_memory
from spelgen.emission.assemble import ArmModel
from spelgen.fitting.posterior import Posterior

QUANTITIES = ("base", "friction", "mass", "gravity")
QUANTILE = 1.96
# [1] Relative to the largest true value of a quantity. A value whose error and half interval are both smaller is
# omitted, such as g of a joint that gravity does not load: rounding errors would determine error / half interval.
NEGLIGIBLE = 1e-6


@dataclass(frozen=True, eq=False)
class SteadySliding:
    """Positions and speeds at which the friction of a fitted arm is compared with the true friction.

    Friction at a speed is half the difference of the torques in both directions, long after a reversal.

    q: (T, n) positions over which friction is averaged. speeds: (speeds, n) [rad/s, m/s].
    """

    q: np.ndarray
    speeds: np.ndarray


@dataclass(frozen=True, eq=False)
class TrueValues:
    """True values of a simulated arm, with which the intervals of its fit are compared.

    combination: (r, K) matrix from inertial parameters and armatures to base parameters. base: (r,) base parameters.
    friction: (speeds, n) [Nm, N], friction of steady sliding (see `SteadySliding`). mass: (T, n, n), M at T positions.
    gravity: (T, n) [Nm, N], gravity torque g at these positions.
    """

    combination: np.ndarray
    base: np.ndarray
    friction: np.ndarray
    mass: np.ndarray
    gravity: np.ndarray


def interval_ratios(
    posterior: Posterior, true: TrueValues, sliding: SteadySliding, q: np.ndarray
) -> dict[str, list[float]]:
    """Return |fitted value - true value| / half width of the 95 % interval, for all values of each of `QUANTITIES`.

    Omitted: values that are zero in truth and in the fit, such as g of joints that gravity does not load.

    Args:
        posterior: posterior of the fitted model.
        true: values of the simulated arm, with g and M at the positions q.
        sliding: positions and speeds at which friction is compared.
        q: (T, n) positions at which g and the diagonal of M are compared.
    """
    positions, combination = torch.from_numpy(q), torch.from_numpy(true.combination)
    diagonal = np.diagonal(true.mass, axis1=1, axis2=2)
    truths = [x.ravel() for x in (true.base, true.friction, diagonal, true.gravity)]

    def quantities(model: ArmModel) -> torch.Tensor:
        """Return base parameters, sliding friction, and diagonals of M and g at the positions q, of a model, (K,)."""
        base = combination @ torch.cat([model.inertial_parameters.flatten(), model.armature])
        mass = model.mass_matrix(positions).diagonal(dim1=-2, dim2=-1)
        friction, gravity = _sliding_friction(model, sliding), model.gravity(positions)
        return torch.cat([base, friction, mass.flatten(), gravity.flatten()])

    value, std = posterior.uncertain(quantities)
    parts = np.cumsum([len(x) for x in truths])[:-1]
    ratios = {}
    for name, truth, found, width in zip(
        QUANTITIES, truths, np.split(value, parts), np.split(QUANTILE * std, parts), strict=True
    ):
        error, negligible = np.abs(found - truth), NEGLIGIBLE * np.abs(truth).max()
        informative = np.maximum(error, width) > negligible
        ratio = error[informative] / np.maximum(width[informative], negligible)
        ratios[name] = [round(float(x), 3) for x in ratio]
    return ratios


def _sliding_friction(model: ArmModel, sliding: SteadySliding) -> torch.Tensor:
    q, rows = torch.from_numpy(sliding.q), []
    for speed in torch.from_numpy(sliding.speeds):
        both = []
        for qd in (speed.expand_as(q), -speed.expand_as(q)):
            past = (sliding_memory(model, qd),) if is_stateful(model) else ()
            both.append(model.friction_torque(q, qd, *past))
        rows.append((both[0] - both[1]).mean(dim=0) / 2)
    return torch.cat(rows)
