"""Base parameters of a model: the combinations of inertial parameters and armatures that determine its torques.

Equal to `identification.base_parameters`, but from the kinematics of the model only and without exact arithmetic.
"""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from spelgen.dynamics.body_regressor import regressor_of
from spelgen.labels import BASE_ORDER, INERTIAL_PARAMETERS, parameter_name
from spelgen.runtime.body_chain import BodyChain

# Norm of the part of a regressor column that is orthogonal to all columns before it, relative to the norm of the
# column, below which the column is linearly dependent.
DEPENDENT = 1e-8
# Smallest coefficient of a combination.
ROUNDING = 1e-9


def constants_regressor(chain: BodyChain, motors: Tensor, q: Tensor, qd: Tensor, qdd: Tensor) -> Tensor:
    """Return the derivative of joint torques with respect to the inertial parameters and armatures.

    Args:
        chain: kinematics of B bodies.
        motors: C, (n, n), the drives rotate at C qd.
        q, qd, qdd: motion of the joints, (T, n) [rad, m], per s, per s^2.

    Returns:
        (T, n, 10 B + n).
    """
    rotors = (qdd @ motors.mT).unsqueeze(-2) * motors.mT
    return torch.cat([regressor_of(chain, q, qd, qdd), rotors], dim=-1)


def base_combinations(chain: BodyChain, motors: Tensor) -> tuple[tuple[str, ...], Tensor]:
    """Return names and coefficients (r, 10 B + n) of the base parameters; see `constants_regressor`.

    A column of the regressor at random states in the span of the columns before it is regrouped into these (Gautier and
    Khalil, IEEE T-RA 6:368, 1990).
    """
    n, inertial = len(motors), 10 * len(chain.parents)
    order = [
        10 * body + INERTIAL_PARAMETERS.index(name) for body in range(inertial // 10) for name in BASE_ORDER
    ]
    order += range(inertial, inertial + n)
    shape = (3, 2 * len(order) // n + 1, n)  # twice as many equations as parameters
    motion = torch.from_numpy(np.random.default_rng(0).uniform(-3.0, 3.0, shape))
    columns = constants_regressor(chain, motors, *motion).flatten(0, 1)
    # norm of each column after projection onto the complement of all columns before it
    remainder = torch.linalg.qr(columns[:, order]).R.diagonal().abs()
    is_base = remainder > DEPENDENT * columns[:, order].norm(dim=0).clamp(min=1.0)
    base = torch.tensor(order)[is_base]
    combination = torch.linalg.lstsq(columns[:, base], columns).solution
    combination[combination.abs() < ROUNDING] = 0.0
    names = []
    for index, row in zip(base.tolist(), combination, strict=True):
        if index < inertial:
            regrouped = int(row[:inertial].count_nonzero()) > 1
            names.append(parameter_name(index) + "R" * regrouped)
        else:
            names.append(f"armature{index - inertial + 1}")
    return tuple(names), combination
