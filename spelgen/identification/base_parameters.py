"""Base parameters: which inertial parameters the torque shows, alone or only in fixed combinations.

Found by elimination on the regressor at random states (Gautier and Khalil, IEEE T-RA 6:368, 1990): the columns are
taken root first, and one that the columns before it already span is regrouped into them.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from spelgen.arm.arm import Arm
from spelgen.dynamics.regressor import PARAMETERS, regressor
from spelgen.identification.friction import FrictionModel

_STATES_PER_PARAMETER = 2
_DEPENDENT = 1e-9  # of its own length: what is left of a column that others span
_ABSENT = 1e-8  # of the largest coefficient: what is smaller is rounding


@dataclass(frozen=True, eq=False)
class BaseParameters:
    """r base parameters of K parameters: ten a body, then those of friction and drives.

    columns: (r,) of the regressor, the parameter each is named after. combination: (r, K), base parameters are
    this times the parameters, with a one in column ``columns[k]`` of row k. names: of all K.
    """

    columns: np.ndarray
    combination: np.ndarray
    names: tuple[str, ...]

    def __len__(self) -> int:
        return len(self.columns)

    def formulas(self) -> tuple[str, ...]:
        """What each base parameter is made of, e.g. ``Izz1 + m2 + 0.1 mx2``."""
        return tuple(
            _sum(row, column, self.names) for row, column in zip(self.combination, self.columns, strict=True)
        )

    def told(self) -> dict[str, str]:
        """By parameter, in words, whether motion can show it."""
        alone = (np.abs(self.combination) > 0).sum(axis=1) == 1
        seen = np.abs(self.combination).max(axis=0) > 0
        single = {int(column) for column, one in zip(self.columns, alone, strict=True) if one}
        return {
            name: "alone" if k in single else "in combination" if seen[k] else "never"
            for k, name in enumerate(self.names)
        }


def base_parameters(arm: Arm, friction: FrictionModel, seed: int = 0) -> BaseParameters:
    """The base parameters of ``arm`` and of this friction."""
    rng = np.random.default_rng(seed)
    n = len(arm.coordinates)
    names = [f"{name}{body + 1}" for body in range(len(arm.bodies)) for name in PARAMETERS]
    names += [f"{effect}{joint + 1}" for effect in friction.effects for joint in range(n)]
    shape = (_STATES_PER_PARAMETER * len(names) // n + 1, n)
    q, qd, qdd = rng.uniform(-3.0, 3.0, (3, *shape))
    rows = np.concatenate([regressor(arm, q, qd, qdd), friction.columns(qd, qdd)], axis=2)
    columns = rows.reshape(-1, len(names))
    length = np.linalg.norm(columns, axis=0)
    chosen: list[int] = []
    basis = np.zeros((len(columns), 0))  # orthonormal, of the chosen columns
    for k in range(len(names)):
        left = columns[:, k]
        for _ in range(2):  # once more takes away what rounding left
            left = left - basis @ (basis.T @ left)
        if np.linalg.norm(left) > _DEPENDENT * max(float(length[k]), 1.0):
            chosen.append(k)
            basis = np.column_stack([basis, left / np.linalg.norm(left)])
    combination = np.linalg.lstsq(columns[:, chosen], columns, rcond=None)[0]
    combination[np.abs(combination) < _ABSENT * np.abs(combination).max(initial=1.0)] = 0.0
    return BaseParameters(np.array(chosen), combination, tuple(names))


def _sum(row: np.ndarray, first: int, names: tuple[str, ...]) -> str:
    text = names[first]
    for k in np.flatnonzero(row):
        if k != first:
            size = "" if f"{abs(row[k]):.4g}" == "1" else f"{abs(row[k]):.4g} "
            text += f" {'-' if row[k] < 0 else '+'} {size}{names[k]}"
    return text
