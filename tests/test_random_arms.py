"""Structures derived from random URDFs agree with Pinocchio's reading of the same text."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import product
from math import pi
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, assume, event, given, settings
from random_arms import DrawnArm, arms

from spelgen.arm.arm import Chain, make_arm
from spelgen.arm.rational import exact_rotation, rotation_from_rpy
from spelgen.structure.sampling import float_energies
from spelgen.structure.structure import Structure, derive
from spelgen.urdf.read import read_urdf

pin = pytest.importorskip(
    "pinocchio", reason="Pinocchio (pip install spelgen[simulate]) reads the other side"
)

# relative to the largest value: above SOMETHING a value is not zero, below NOTHING it is zero
SOMETHING, NOTHING = 1e-8, 1e-11


class Reading:
    """Pinocchio's model of a random arm, with mimic joints tied to their leaders and joints off the chain at zero."""

    def __init__(self, arm: DrawnArm) -> None:
        self.model = pin.buildModelFromXML(arm.text)
        self.data = self.model.createData()
        columns = {name: self._column(name) for name in arm.joints}
        self.ties = np.zeros((self.model.nv, len(arm.joints)))
        self.rest = np.zeros(self.model.nv)
        for k, column in enumerate(columns.values()):
            self.ties[column, k] = 1.0
        for follower in arm.followers:
            column = self._column(follower.name)
            self.ties[column] = follower.multiplier * self.ties[columns[follower.leader]]
            self.rest[column] = follower.offset
        self.neutral = pin.neutral(self.model)

    def _column(self, name: str) -> int:
        return self.model.joints[self.model.getJointId(name)].idx_v

    def draw_inertias(self, rng: np.random.Generator) -> None:
        """Give each body of the model random, physically consistent inertial values."""
        for k in range(1, self.model.njoints):
            # the inertia tensor of four point masses, which is physically consistent
            points = rng.normal(scale=0.5, size=(4, 3))
            tensor = np.eye(3) * (points**2).sum() - points.T @ points
            self.model.inertias[k] = pin.Inertia(rng.uniform(1.0, 4.0), rng.uniform(-0.5, 0.5, 3), tensor)

    def configuration(self, q: np.ndarray) -> np.ndarray:
        return pin.integrate(self.model, self.neutral, self.ties @ q + self.rest)

    def mass(self, q: np.ndarray) -> np.ndarray:
        """Return the lower triangle of M at a configuration, as a vector."""
        full = pin.crba(self.model, self.data, self.configuration(q))
        full = np.triu(full) + np.triu(full, 1).T
        return (self.ties.T @ full @ self.ties)[np.tril_indices(len(q))]

    def potential(self, q: np.ndarray) -> float:
        return pin.computePotentialEnergy(self.model, self.data, self.configuration(q))

    def regressor(self, q: np.ndarray, v: np.ndarray, a: np.ndarray) -> np.ndarray:
        full = pin.computeJointTorqueRegressor(
            self.model, self.data, self.configuration(q), self.ties @ v, self.ties @ a
        )
        return self.ties.T @ full


@dataclass(frozen=True)
class Facts:
    """Facts on the structure of an arm with n joints: derived by spelgen, or measured with Pinocchio.

    entries: per entry of M, "zero", "constant" or "varying", and the joints that it depends on. potential: joints that
    V depends on. outputs_from: (n,); item k is the number of varying terms of M that depend on none of the first k
    joints. constants: number of constant terms.
    """

    entries: tuple[tuple[str, tuple[int, ...]], ...]
    potential: tuple[int, ...]
    outputs_from: tuple[int, ...]
    constants: int
    base_parameters: int


def measured(arm: DrawnArm, *, inertials: bool, rng: np.random.Generator) -> Facts:
    """Return the facts on the structure of an arm (see `Facts`) from M and V of Pinocchio at random configurations.

    inertials: True for the inertial values of the URDF, False for random values at each configuration.
    """
    reading = Reading(arm)
    n = len(arm.joints)
    entries = n * (n + 1) // 2
    base, levels, changes, lifts = [], [], [[] for _ in range(n)], [[] for _ in range(n)]
    for _ in range(2 * entries + 6):
        if not inertials:
            reading.draw_inertias(rng)
        q = rng.uniform(-3.0, 3.0, n)
        base.append(reading.mass(q))
        levels.append(reading.potential(q))
        for k in range(n):
            moved = q.copy()
            moved[k] = rng.uniform(-3.0, 3.0)
            changes[k].append(reading.mass(moved) - base[-1])
            lifts[k].append(reading.potential(moved) - levels[-1])
    rows, steps = np.array(base), np.array(changes)
    size, height = np.abs(rows).max(), max(1.0, np.abs(levels).max())
    kinds = []
    for index in range(entries):
        joints = tuple(k for k in range(n) if _is_something(steps[k][:, index], size))
        kinds.append(
            ("varying" if joints else "constant" if _is_something(rows[:, index], size) else "zero", joints)
        )
    ranks = [rank(steps[:k].reshape(-1, entries), size) for k in range(n + 1)]
    return Facts(
        entries=tuple(kinds),
        potential=tuple(k for k in range(n) if _is_something(np.array(lifts[k]), height)),
        outputs_from=tuple(ranks[n] - found for found in ranks[:n]),
        constants=rank(rows, size) - ranks[n],
        base_parameters=_base_parameters(reading, n, rng),
    )


def _base_parameters(reading: Reading, n: int, rng: np.random.Generator) -> int:
    rows = [reading.regressor(*rng.uniform(-3.0, 3.0, (3, n))) for _ in range(20 * reading.model.njoints)]
    return rank(np.concatenate(rows), np.abs(rows).max())


def rank(rows: np.ndarray, size: float) -> int:
    """Return the numerical rank of rows whose nonzero numbers have the magnitude ``size``."""
    return _count(np.linalg.svd(rows, compute_uv=False) / size / np.sqrt(len(rows) or 1))


def _is_something(values: np.ndarray, size: float) -> bool:
    return bool(_count(np.array([np.abs(values).max() / size])))


def _count(sizes: np.ndarray) -> int:
    clear = not ((sizes > NOTHING) & (sizes < SOMETHING)).any()
    event("sizes tell zeros" if clear else "sizes leave zeros open")
    assume(clear)
    return int((sizes > SOMETHING).sum())


def told(structure: Structure) -> Facts:
    """Return the facts that spelgen derived (see `Facts`), for the comparison with the result of `measured`."""
    n = len(structure.joints)
    return Facts(
        entries=tuple((entry.kind, entry.joints) for entry in structure.entries),
        potential=structure.potential,
        outputs_from=tuple(structure.outputs_from(k) for k in range(n)),
        constants=len(structure.constants),
        base_parameters=structure.base_parameter_count,
    )


RANDOM = settings(
    max_examples=40,
    derandomize=True,
    deadline=None,
    suppress_health_check=[HealthCheck.function_scoped_fixture, HealthCheck.too_slow],
)


def read(drawn: DrawnArm, folder: Path) -> Chain:
    path = folder / "drawn.urdf"
    path.write_text(drawn.text, encoding="utf-8")
    return make_arm(read_urdf(path), joints=drawn.joints)


@RANDOM
@given(drawn=arms())
def test_structure_agrees_with_pinocchio(tmp_path, drawn):
    arm = read(drawn, tmp_path)
    for inertials in (False, True):
        seen = measured(drawn, inertials=inertials, rng=np.random.default_rng(0))
        assert told(derive(arm, "inertials" if inertials else "kinematics")) == seen


@RANDOM
@given(drawn=arms())
def test_values_are_those_of_pinocchio(tmp_path, drawn):
    """M and V from the exact geometry and the lumped inertial values equal M and V of Pinocchio for the URDF."""
    arm = read(drawn, tmp_path)
    q = np.random.default_rng(0).uniform(-3.0, 3.0, (20, len(drawn.joints)))
    inertias = [[float(x) for x in body.inertia or ()] for body in arm.bodies]
    mass, potential = float_energies(arm, q, inertias)
    reading = Reading(drawn)
    assert_close(mass, np.array([reading.mass(each) for each in q]))
    heights = np.array([reading.potential(each) for each in q])
    assert_close(potential - potential[0], heights - heights[0])


def test_rational_rotations_keep_the_zeros_of_half_right_angles():
    """`exact_rotation`, a rational approximation, keeps the zero entries of a rotation exactly.

    Roll, pitch and yaw are multiples of 45 degrees. The cosine of 45 degrees, sqrt(1/2), is not rational.
    """
    for tilt in product(range(8), repeat=3):
        rotation = rotation_from_rpy([k * pi / 4 for k in tilt])
        found = exact_rotation(rotation)
        assert (np.array(found) == 0).tolist() == (np.abs(rotation) < 1e-12).tolist()
        assert np.abs(np.array(found, dtype=float) - rotation).max() < 1e-11


def assert_close(ours: np.ndarray, theirs: np.ndarray) -> None:
    assert np.abs(ours - theirs).max() < 1e-9 * max(1.0, np.abs(theirs).max())
