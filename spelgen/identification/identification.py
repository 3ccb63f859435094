"""Options and result of a linear identification: base parameters with standard deviations."""

import textwrap
from collections import Counter
from dataclasses import dataclass, field
from functools import cached_property
from typing import Literal

import numpy as np
import torch

from spelgen.arm.actuation import Drives
from spelgen.arm.arm import Chain
from spelgen.dynamics.friction import FrictionModel
from spelgen.dynamics.regressor_dynamics import RegressorDynamics, identified_dynamics
from spelgen.errors import Diagnostic, SettingsError
from spelgen.identification.base_parameters import BaseParameters
from spelgen.identification.intervals import DETERMINED, Interval, base_unit, interval_listing
from spelgen.identification.torque_delay import NO_DELAY, TorqueDelay
from spelgen.labels import UNITS, counted
from spelgen.listing import WIDTH, Listing

SCHEMA = 3
_WEIGHTED = {
    "equal": "joints weighted equally",
    "range": "each joint weighted by its torque's range",
    "noise": "each joint weighted by its residual noise",
}


@dataclass(frozen=True)
class LeastSquares:
    """Options of a linear identification.

    weights: weights of the joints' squared torque residuals: ``equal``, ``range`` (inverse variance of a joint's
    torque) or ``noise`` (inverse variance of a joint's residual, in a few iterations). friction: friction model;
    ``FrictionModel(memory=True)`` has dry friction with hysteresis. Raises SettingsError for other values.
    """

    weights: Literal["equal", "range", "noise"] = "noise"
    friction: FrictionModel = field(default_factory=FrictionModel)

    def __post_init__(self) -> None:
        if self.weights not in ("equal", "range", "noise"):
            raise SettingsError(repr(self.weights), element="weights", expected="equal, range or noise")
        if not isinstance(self.friction, FrictionModel):
            raise SettingsError(
                repr(self.friction),
                element="friction",
                expected="FrictionModel(memory=True), or without memory",
            )


@dataclass(frozen=True, eq=False, repr=False)
class Identification:
    """Result of linear least squares for an arm with n joints, K parameters and r base parameters.

    Attributes:
        arm: the arm with its URDF parameters.
        method: options of the identification.
        base: base parameters of the arm.
        parameters: (K,) fitted parameters; parameters outside the base columns are zero.
        values: (r,) values of the base parameters.
        deviations: (r,) standard deviations of the base parameters.
        condition: condition number of the regressor, with columns of length one and weighted joints.
        unseen: number of directions in the space of base parameters that the logs do not excite.
        residual: (n,) root mean square of the torque residual [Nm, N].
        nmse: (n,) mean squared torque residual divided by the variance of the torque.
        trajectories: names of the trajectories.
        samples: number of samples.
        drives: map of logged torques to joint torques.
        diagnostics: remarks and warnings about the logs.
        torque_delay: estimated or given delay [s] of the logged torques after the positions, which was removed.
    """

    arm: Chain
    method: LeastSquares
    base: BaseParameters
    parameters: np.ndarray
    values: np.ndarray
    deviations: np.ndarray
    condition: float
    unseen: int
    residual: np.ndarray
    nmse: np.ndarray
    trajectories: tuple[str, ...]
    samples: int
    drives: Drives
    diagnostics: tuple[Diagnostic, ...] = ()
    torque_delay: TorqueDelay = NO_DELAY

    @cached_property
    def dynamics(self) -> RegressorDynamics:
        """Dynamics of the arm with the identified parameters, e.g. as a baseline for `evaluate`."""
        return identified_dynamics(self.arm, self.method.friction, self.parameters, self.drives)

    def torque(
        self, q: np.ndarray, qd: np.ndarray, qdd: np.ndarray, z: np.ndarray | None = None
    ) -> np.ndarray:
        """Return the joint torques (T, n) [Nm, N] of the identified arm.

        Args:
            q: (T, n) positions [rad, m].
            qd: (T, n) velocities [rad/s, m/s].
            qdd: (T, n) accelerations [rad/s^2, m/s^2].
            z: (T, n, B) [rad, m] states of the B bristles of each joint, for a friction model with hysteresis; None
                for other friction models.
        """
        past = None if z is None else torch.as_tensor(z)
        position, velocity, acceleration = (torch.as_tensor(np.asarray(x, float)) for x in (q, qd, qdd))
        return self.dynamics.joint_torque(position, velocity, acceleration, past).numpy()

    @cached_property
    def intervals(self) -> tuple[Interval, ...]:
        """The base parameters, each with its standard deviation and its 95 % interval."""
        estimates = zip(self.base.names, self.values.tolist(), self.deviations.tolist(), strict=True)
        return tuple(Interval(name, value, std, base_unit(name)) for name, value, std in estimates)

    def to_dict(self) -> dict[str, object]:
        """Return the identified parameters and the residual in JSON form for other programs.

        `SCHEMA` is the version of the form, which is a public contract.
        """
        joints = list(self.arm.joint_names)
        friction = self.method.friction
        records = []
        for interval, formula in zip(self.intervals, self.base.formulas(), strict=True):
            records.append(interval.to_dict() | {"formula": formula})
        return {
            "schema": SCHEMA,
            "robot": self.arm.name,
            "joints": joints,
            "bodies": [body.name for body in self.arm.bodies],
            "trajectories": list(self.trajectories),
            "samples": self.samples,
            "method": {
                "weights": self.method.weights,
                "coulomb_smoothing_velocity": friction.coulomb_smoothing_velocity,
                "effects": [effect.removesuffix(", joint ") for effect in friction.effects],
            },
            "torque_delay": {"delay": self.torque_delay.delay, "interval": self.torque_delay.interval},
            "condition": _finite(self.condition),
            "unseen_directions": self.unseen,
            "base_parameters": records,
            "identifiability": self.base.identifiability(),
            "residual": dict(zip(joints, map(float, self.residual), strict=True)),
            "nmse": dict(zip(joints, map(_finite, self.nmse), strict=True)),
            "diagnostics": list(map(Diagnostic.to_dict, self.diagnostics)),
        }

    def text(self) -> str:
        """Return the identification as text for a terminal of 80 columns.

        The text has the condition number, the torque residual of each joint, and the base parameters with 95 %
        intervals.
        """
        residuals, parameters = self.listings()
        definitions = ["where"]
        for name, formula in zip(self.base.names, self.base.formulas(), strict=True):
            if name != formula:
                line = f"{name} = {formula}"
                definitions.append(textwrap.fill(line, WIDTH, initial_indent="  ", subsequent_indent=" " * 8))
        never = [name for name, how in self.base.identifiability().items() if how == "never"]
        unseen = f"Unidentifiable: {', '.join(never) or 'none'}."
        return "\n\n".join([
            textwrap.fill(self.heading(), WIDTH), self.quality(), residuals.text(), parameters.text(),
            "\n".join(definitions), textwrap.fill(unseen, WIDTH),
        ])  # fmt: skip

    def listings(self) -> tuple[Listing, Listing]:
        """Return two tables of an identification for display: torque residual per joint, and base parameters."""
        joints: list[tuple[str, ...]] = []
        for x, rms, nmse in zip(self.arm.coordinates, self.residual, self.nmse, strict=True):
            joints.append((x.name, f"{rms:.4g}", UNITS[x.joint_type].torque, f"{nmse:.3g}"))
        title = "Base parameters [kg, m, s], with half 95 % intervals; numbers after names: joint"
        head = ("joint", "RMS", "", "nMSE")
        return (
            Listing("Torque residual: RMSE and nMSE", head, joints, left=(0, 2)),
            interval_listing(title, self.intervals),
        )

    def __repr__(self) -> str:
        return f"<Identification of {self.heading()}>"

    def _repr_html_(self) -> str:
        return "".join(listing.html() for listing in self.listings())

    def heading(self) -> str:
        """Return a sentence about the identification: numbers of parameters and samples, and weighting of the joints.

        In the least-squares fit, the torque residuals of all joints have equal weights, or are divided by the range or
        by the noise of the joint's torque.
        """
        drives = len(self.base) - self.base.bodies
        weighted = _WEIGHTED[self.method.weights]
        return (
            f"{self.arm.name}: {self.base.bodies} base parameters of the bodies and {drives} of friction and drives, "
            f"from {self.samples} samples of {counted(len(self.trajectories), 'trajectory')}, {weighted}."
        )

    def quality(self) -> str:
        """Return sentences about the condition number, and the number of parameters in each class of precision."""
        conditioned = f"Condition number {self.condition:.3g} (columns of length one): "
        if self.unseen:
            conditioned = (
                f"The logs do not excite {counted(self.unseen, 'direction')} of the base parameters: those values are "
                "arbitrary; excite the arm more, or train the preset closed-form, which has a prior at the URDF."
            )
        # [1] condition number below which torque errors are not amplified noticeably
        elif self.condition < 30.0:
            conditioned += "well posed."
        elif self.condition < 300.0:
            conditioned += "acceptable."
        else:
            conditioned += "poor: some parameters trade against each other; excite the arm more."
        counts = Counter(x.determined for x in self.intervals)
        sure = ", ".join(f"{counts[word]} {word}" for word in DETERMINED if word in counts)
        return textwrap.fill(conditioned, WIDTH) + f"\nParameters: {sure}."


def _finite(value: float) -> float | None:
    """Return a float for JSON: None if it is infinite or NaN, which JSON does not have."""
    return float(value) if np.isfinite(value) else None
