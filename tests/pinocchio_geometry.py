"""The geometry of an arm, computed by Pinocchio at random configurations."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pinocchio as pin

from spelgen.arm.arm import Chain
from spelgen.dynamics.pinocchio_arm import arm_dynamics
from spelgen.settings.settings import Settings

NOTHING = 1e-9  # [1] magnitude below which a quantity of order 1 counts as zero


@dataclass
class Seen:
    """Joint axes and origins of an arm at three random configurations, and the inertia of its last body, by Pinocchio.

    Its methods test statements about the geometry, such as parallel axes. They number the joints from 1.
    """

    arm: Chain

    def __post_init__(self) -> None:
        rng = np.random.default_rng(1)
        self.engine = arm_dynamics(self.arm, Settings())
        self.n = self.engine.model.nv
        self.configurations = rng.uniform(-2, 2, (3, self.n))
        self.places = [self._places(q) for q in self.configurations]
        self.axes = np.array([[place.rotation[:, 2] for place in places] for places in self.places])
        self.points = np.array([[place.translation for place in places] for places in self.places])
        mass = self.engine.model.inertias[self.n]
        # centre of mass of the last body, and its inertia about this centre
        self.lever, self.inertia = mass.lever, mass.inertia

    def _places(self, q: np.ndarray) -> list:
        pin.forwardKinematics(self.engine.model, self.engine.data, q)
        return [place.copy() for place in self.engine.data.oMi[1:]]

    def slides(self, *joints: int) -> bool:
        return all(self.arm.coordinates[joint - 1].joint_type == "prismatic" for joint in joints)

    def turns(self, *joints: int) -> bool:
        return all(self.arm.coordinates[joint - 1].joint_type == "revolute" for joint in joints)

    def parallel(self, *joints: int) -> bool:
        first, rest = self.axes[:, [joints[0] - 1]], self.axes[:, [joint - 1 for joint in joints]]
        return np.abs(np.cross(first, rest)).max() < NOTHING

    def one_line(self, *joints: int) -> bool:
        apart = self.points[:, [joint - 1 for joint in joints]] - self.points[:, [joints[0] - 1]]
        return (
            self.parallel(*joints) and np.abs(np.cross(apart, self.axes[:, [joints[0] - 1]])).max() < NOTHING
        )

    def cosines(self, one: int, joints: list[int]) -> np.ndarray:
        return np.einsum("ci,cji->cj", self.axes[:, one - 1], self.axes[:, [joint - 1 for joint in joints]])

    def lifts_nothing(self, joint: int) -> bool:
        down = np.array(self.arm.gravity, dtype=float)
        axis = self.axes[:, joint - 1]
        return np.abs(axis @ down if self.slides(joint) else np.cross(axis, down)).max() < NOTHING

    def commute(self, mover: int, others: list[int]) -> bool:
        """Return True if the motion of joint `mover` moves no axis of the joints `others`.

        The axis of a revolute joint is a line, the axis of a prismatic joint a direction.
        """
        for q in self.configurations:
            moved = q + 0.7 * np.eye(self.n)[mover - 1]
            before, after = self._places(q), self._places(moved)
            # rigid displacement of all bodies after the joint `mover`, relative to the base
            step = after[-1] * before[-1].inverse()
            for other in others:
                place = before[other - 1]
                axis, point = place.rotation[:, 2], place.translation
                off = np.cross(step.act(point) - point, axis) if self.turns(other) else np.zeros(3)
                if np.abs([step.rotation @ axis - axis, off]).max() > NOTHING:
                    return False
        return True

    def carried(self, joint: int, turner: int) -> np.ndarray:
        """Return d sin(a) [m], (configurations,), with the distance d of a centre of mass from a plane.

        The mass is all bodies that the sliding ``joint`` moves. The plane contains the axis of joint ``turner`` and is
        parallel to the axis of ``joint``. a is the angle between both axes: their cross product, of length sin(a), is
        used as the normal of the plane.
        """
        found = []
        for q, axes, points in zip(self.configurations, self.axes, self.points, strict=True):
            pin.centerOfMass(self.engine.model, self.engine.data, q, True)
            data, here = self.engine.data, self.engine.data.oMi[joint]
            normal = np.cross(axes[joint - 1], axes[turner - 1])
            found.append(normal @ (here.act(data.com[joint]) - points[turner - 1]))
        return np.array(found)

    @property
    def balanced(self) -> bool:
        off = [*self.lever[:2], self.inertia[0, 2], self.inertia[1, 2]]
        return self.turns(self.n) and np.abs(off).max() < NOTHING

    @property
    def symmetric(self) -> bool:
        uneven = [self.inertia[0, 0] - self.inertia[1, 1], self.inertia[0, 1]]
        return self.balanced and np.abs(uneven).max() < NOTHING

    def mass_behind(self, joint: int) -> float:
        return sum(inertia.mass for inertia in self.engine.model.inertias[joint:])

    def mass(self, row: int) -> np.ndarray:
        return np.array([self.engine.mass_matrix(q)[row - 1, row - 1] for q in self.configurations])
