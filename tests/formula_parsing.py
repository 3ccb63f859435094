"""Parser of closed forms of M and V in text, and comparison of the closed forms with Pinocchio."""

from __future__ import annotations

import re

import numpy as np
import pinocchio as pin

from spelgen.arm.arm import Chain
from spelgen.dynamics.pinocchio_arm import arm_dynamics
from spelgen.settings.settings import Settings
from spelgen.structure.base_parameters import base_parameters

CLOSE = 1e-10


def assert_equal_to_pinocchio(arm: Chain, rows: dict[str, str], tolerance: float = CLOSE) -> None:
    """Check that closed forms of the entries of M, and of V(q) - V(0), equal Pinocchio's values at random positions.

    Args:
        arm: gives the values of the base parameters in the expressions.
        rows: Python expressions by name (M11, ..., V).
        tolerance: largest error, relative to the diagonal of M, or to V.
    """
    engine = arm_dynamics(arm, Settings())
    n = len(arm.coordinates)
    names = {"cos": np.cos, "sin": np.sin}
    names |= {each.name: float(each.value) for each in base_parameters(arm)}
    origin = dict.fromkeys((f"q{k + 1}" for k in range(n)), 0.0)
    points = np.random.default_rng(3).uniform(-2, 2, (3, n))
    for q in points:
        at = names | {f"q{k + 1}": value for k, value in enumerate(q)}
        mass = engine.mass_matrix(q)
        size = np.sqrt(np.outer(mass.diagonal(), mass.diagonal()))
        for name, expression in rows.items():
            value = eval(expression, {}, at)
            if name == "V":
                value -= eval(expression, {}, names | origin)
                true = potential_energy(engine, q) - potential_energy(engine, np.zeros(n))
                assert abs(value - true) < tolerance * max(1.0, abs(true)), name
            else:
                row, column = (int(digit) - 1 for digit in name[1:])
                assert abs(value - mass[row, column]) < tolerance * size[row, column], name


def potential_energy(engine, q):
    return pin.computePotentialEnergy(engine.model, engine.data, engine.jacobian @ q + engine.offset)


def assert_close(found, true) -> None:
    assert np.abs(np.subtract(found, true)).max() < CLOSE * max(1.0, np.abs(true).max())


def read_back(told: str) -> dict[str, str]:
    """Return the closed forms in a text as {name: expression}: M11, M21, ... of the mass matrix, and the potential V.

    The text has a line "name = expression" for each; an indented line continues an expression.
    """
    found: dict[str, str] = {}
    for line in told.partition("\nBase parameters")[0].splitlines():
        name, is_row, expression = line.partition(" = ")
        if is_row and re.fullmatch(r"M\d+|V", name):
            found[name] = expression
        elif line.startswith("    "):
            found[list(found)[-1]] += line
    return found
