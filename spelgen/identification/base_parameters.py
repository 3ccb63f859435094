"""Base parameters: the combinations of inertial, friction and drive parameters that determine the torque.

The combinations of inertial parameters are computed exactly by `structure.base_parameters`, so that their names and
order are the same in every command. The combinations with friction and drives are computed numerically from the
regressor at random states: a column in the span of the preceding columns is regrouped into the preceding columns
(Gautier and Khalil, IEEE T-RA 6:368, 1990).
"""

from dataclasses import dataclass

import numpy as np

from spelgen.arm.arm import Chain
from spelgen.dynamics.friction import BRISTLES, FrictionModel
from spelgen.dynamics.regressor_dynamics import regressor
from spelgen.labels import base_name, parameter_name
from spelgen.structure.base_parameters import base_parameters as body_base_parameters


@dataclass(frozen=True, eq=False)
class BaseParameters:
    """The r base parameters of a model with K parameters: ten per body, then friction and drives.

    Attributes:
        names: names of the r base parameters.
        columns: (r,) index of the regressor's column that belongs to each base parameter; these columns are
            independent.
        combination: (r, K) matrix with base parameters = combination @ parameters; row k is 1 in column `columns[k]`.
        parameters: names of the K parameters.
        bodies: number of base parameters of bodies; they precede the base parameters of friction and drives.
    """

    names: tuple[str, ...]
    columns: np.ndarray
    combination: np.ndarray
    parameters: tuple[str, ...]
    bodies: int

    def __len__(self) -> int:
        return len(self.columns)

    def formulas(self) -> tuple[str, ...]:
        """Return the formula of each base parameter as a sum of parameters, e.g. ``Izz1 + m2 + 0.1 hx2``."""
        rows = zip(self.combination, self.columns, strict=True)
        return tuple(_sum(row, column, self.parameters) for row, column in rows)

    def identifiability(self) -> dict[str, str]:
        """Return {parameter: its identifiability}, for all K parameters.

        ``alone``: the parameter is a base parameter; ``in combination``: it is a term of base parameters; ``never``: it
        does not affect the torque.
        """
        used = self.combination != 0
        alone = set(self.columns[used.sum(axis=1) == 1].tolist())
        result = dict.fromkeys(self.parameters, "never")
        for k in np.flatnonzero(used.any(axis=0)).tolist():
            result[self.parameters[k]] = "alone" if k in alone else "in combination"
        return result


def base_parameters(arm: Chain, friction: FrictionModel, motors: np.ndarray | None = None) -> BaseParameters:
    """Return the base parameters of an arm with friction.

    Args:
        arm: arm with n joints.
        friction: friction model of the drives.
        motors: (n, n) matrix from joint speeds to drive speeds; None: identity.
    """
    n, inertial = len(arm.coordinates), 10 * len(arm.bodies)
    exact = body_base_parameters(arm)
    names = list(map(parameter_name, range(inertial)))
    for effect in friction.effects:
        names += [f"{effect}{joint + 1}" for joint in range(n)]
    columns = _columns(arm, friction, motors, len(names))
    candidates = np.array([parameter.index for parameter in exact] + list(range(inertial, len(names))))
    # `remainder`: norm of each column's residual after projection onto all preceding columns; near zero for a dependent
    # column
    remainder = np.abs(np.diag(np.linalg.qr(columns[:, candidates], mode="r")))
    length = np.maximum(np.linalg.norm(columns[:, candidates], axis=0), 1.0)
    chosen = candidates[remainder > 1e-9 * length]
    combination = np.zeros((len(chosen), len(names)))
    for row, parameter in enumerate(exact):
        for k, weight in parameter.weights:
            combination[row, k] = float(weight)
    drives = np.linalg.lstsq(columns[:, chosen], columns[:, inertial:], rcond=None)[0]
    # coefficients below this bound are rounding errors
    drives[np.abs(drives) < 1e-8 * np.abs(drives).max(initial=1.0)] = 0.0
    combination[:, inertial:] = drives
    terms = np.count_nonzero(combination, axis=1)
    base_names = [base_name(names[k], x) for k, x in zip(chosen.tolist(), terms.tolist(), strict=True)]
    return BaseParameters(tuple(base_names), chosen, combination, tuple(names), len(exact))


def _columns(arm: Chain, friction: FrictionModel, motors: np.ndarray | None, count: int) -> np.ndarray:
    """Return the regressor (E, count) of all parameters at random states of the arm: E equations of torques.

    There are more than twice as many equations as parameters. friction: the friction model, whose columns are last.
    motors: (n, n) matrix from joint speeds to drive speeds; None: identity. count: number of parameters.
    """
    n = len(arm.coordinates)
    # `shape`: random states for at least twice as many equations as parameters
    shape = (2 * count // n + 1, n)
    q, qd, qdd = np.random.default_rng(0).uniform(-3.0, 3.0, (3, *shape))
    deflection = np.random.default_rng(1).uniform(-1.0, 1.0, (*shape, len(BRISTLES)))
    rows = np.concatenate([regressor(arm, q, qd, qdd), friction.columns(qd, qdd, deflection, motors)], axis=2)
    return rows.reshape(-1, count)


def _sum(row: np.ndarray, first: int, names: tuple[str, ...]) -> str:
    """Return the formula of a base parameter, such as ``Izz1 + m2 + 0.1 hx2``.

    row: (K,) coefficients of the parameters. first: index of the first term, whose coefficient is 1. names: (K,) names
    of the parameters.
    """
    text = names[first]
    for k in np.flatnonzero(row):
        if k != first:
            factor = "" if f"{abs(row[k]):.4g}" == "1" else f"{abs(row[k]):.4g} "
            text += f" {'-' if row[k] < 0 else '+'} {factor}{names[k]}"
    return text
