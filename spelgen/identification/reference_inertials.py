"""Inertial parameters that show the unit of logged torques: the URDF's, or a guess from the dimensions of the arm."""

from typing import NamedTuple

import numpy as np

from spelgen.arm.arm import Chain
from spelgen.dynamics.regressor_dynamics import urdf_parameters
from spelgen.identification.tuning import GEOMETRY


class ReferenceInertials(NamedTuple):
    """Inertial parameters with which logged torques are compared.

    parameters: (10 B,) inertial parameters of the B bodies, in the order of the columns of `regressor`. other_unit:
    gravity torques are in another unit if they are at least this multiple of the torques with these parameters.
    """

    parameters: np.ndarray
    other_unit: float

    @property
    def is_guess(self) -> bool:
        """True if the URDF lacks masses, or has copied ones, so that the parameters are a guess."""
        return self.other_unit != GEOMETRY.other_unit

    @property
    def source(self) -> str:
        """Source of the parameters for tables: "URDF" or "guess"."""
        return "guess" if self.is_guess else "URDF"

    def is_other_unit(self, ratio: np.ndarray | float) -> np.ndarray:
        """Return True for ratios of logged gravity torques to the torques with `parameters` that show another unit."""
        return is_other_unit(ratio, self.other_unit)

    def rounded_factor(self, factor: float) -> float:
        """Return a factor on torques, rounded for a message; its sign remains.

        A factor near 0.001 becomes 0.001, the factor from mNm to Nm. Any other factor is rounded to one digit if this
        changes it by less than 10 %, otherwise to two digits.
        """
        # Magnitudes from 0.00067 to 0.0015 become 0.001. The range is wide, since the factor is only as exact as the
        # masses of the URDF; with guessed masses it is the range of factors that show no other unit.
        if not is_other_unit(factor / 1e-3, self.other_unit if self.is_guess else 1.5):
            return float(np.copysign(1e-3, factor))
        one = float(f"{factor:.1g}")
        return one if abs(one - factor) < 0.1 * abs(factor) else float(f"{factor:.2g}")


def is_other_unit(ratio: np.ndarray | float, limit: float) -> np.ndarray:
    """Return True for ratios of torques whose magnitude is at least `limit`, or at most its inverse.

    ratio: any shape, which the result has, too.
    """
    return np.asarray(np.abs(np.log(np.abs(ratio))) >= np.log(limit))


def reference_inertials(arm: Chain) -> ReferenceInertials:
    """Return the inertial parameters of the URDF, or a guess if it has copied masses or lacks a third of the masses.

    The guess has a point mass at the middle of each link, proportional to its length and the square of the reach, the
    sum of all lengths. It is zero for arms with fewer than four joints or with a prismatic joint, since the length of
    the last link or of a telescope is not in the URDF.
    """
    stated = urdf_parameters(arm)
    if 3 * np.count_nonzero(stated[::10]) >= 2 * len(arm.bodies) and not arm.masses_are_copied:
        return ReferenceInertials(stated, GEOMETRY.other_unit)
    guess = np.zeros((len(arm.bodies), 10))
    links = [body for body in arm.bodies if body.parent >= 0]
    if len(arm.bodies) >= 4 and set(arm.joint_types) == {"revolute"}:
        ends = np.array([body.translation for body in links], dtype=float)
        lengths = np.linalg.norm(ends, axis=1)
        masses = GEOMETRY.link_density * lengths.sum() ** 2 * lengths
        for body, mass, end in zip(links, masses, ends, strict=True):
            guess[body.parent, :4] += mass, *(mass * end / 2)
    return ReferenceInertials(guess.ravel(), GEOMETRY.guessed_unit)
