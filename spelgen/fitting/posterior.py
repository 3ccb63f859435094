"""Posterior of a fitted model: 95 % intervals of its parameters, of M(q), g(q) and of predicted torques.

The covariance of the fitted parameters (`fitting.torque.covariance`) is propagated to first order: the variance of a
function f is |df/dx R|^2 with the covariance R R^T. Torque predictions add the residual of held-out samples.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from spelgen.dynamics.body_regressor import regressor_of
from spelgen.dynamics.parameters import friction_factor
from spelgen.dynamics.protocol import motors_of
from spelgen.emission.assemble import ArmModel
from spelgen.errors import RunError
from spelgen.fitting.functional_model import evaluate_with
from spelgen.fitting.run_record import Content
from spelgen.fitting.torque.jacobian import TorqueJacobian
from spelgen.fitting.torque.parameters import ParameterVector
from spelgen.fitting.torque.samples import SampleBlock, TorqueSamples
from spelgen.identification.intervals import Interval, interval_listing
from spelgen.labels import BASE_ORDER, INERTIAL_PARAMETERS, UNITS, parameter_name
from spelgen.listing import Listing
from spelgen.runtime.friction_laws import FrictionLaws
from spelgen.runtime.inputs import MotorInputs

# Relative length below which a column of the regressor depends on the columns before it; smallest coefficient.
DEPENDENT = 1e-8
ROUNDING = 1e-9
# Finite difference, in standard deviations of the parameters.
STEP = 1e-4
# Speeds, relative to the typical speed, and positions at which viscous and Coulomb friction approximate friction.
SPEEDS = np.geomspace(0.02, 1.0, 25)
POSITIONS = 32
# Samples of one block of predicted torques.
BLOCK = 2048


class Uncertain(NamedTuple):
    """Values of a quantity and their standard deviations, of the same shape and unit."""

    value: np.ndarray
    std: np.ndarray


class Propagated(NamedTuple):
    """Value of a function of the model, (...), and its derivative times R, (..., k): the standard deviations' root."""

    value: Tensor
    root: Tensor


@dataclass(frozen=True, eq=False)
class Posterior:
    """Posterior of a model that was fitted to torques.

    covariance: (K, K) of the rigid-body, drive and friction parameters. torque_std: (n,) RMS torque residual of samples
    that were held out [Nm, N]. delay, delay_std: of the torques relative to the positions [s].
    """

    model: ArmModel
    covariance: Tensor
    torque_std: np.ndarray
    delay: float = 0.0
    delay_std: float = 0.0

    def propagate(self, function: Callable[[ArmModel], Tensor]) -> Propagated:
        """Return a function of the model, such as ``lambda model: model.armature``, with its errors."""

        def at(x: Tensor) -> Tensor:
            return evaluate_with(self.model, self._vector.unflatten(x), function)

        with torch.no_grad():
            steps = STEP * self._root.mT
            columns = [(at(self._x + step) - at(self._x - step)) / (2 * STEP) for step in steps]
            return Propagated(at(self._x), torch.stack(columns, dim=-1))

    def mass_matrix(self, q: np.ndarray) -> Uncertain:
        """Return M (T, n, n) at q (T, n), with standard deviations."""
        position, zero = torch.as_tensor(q), torch.zeros(len(q), self.model.n).double()
        at_rest, columns = self._regressor(position, zero, zero), []
        for unit in torch.eye(self.model.n).double():
            columns.append(self._regressor(position, zero, unit.expand_as(zero)) - at_rest)
        with torch.no_grad():
            return self._linear(self.model.mass_matrix(position), torch.stack(columns, dim=-2))

    def gravity(self, q: np.ndarray) -> Uncertain:
        """Return gravity torques (T, n) [Nm, N] at q (T, n), with standard deviations."""
        position, zero = torch.as_tensor(q), torch.zeros(len(q), self.model.n).double()
        with torch.no_grad():
            return self._linear(self.model.gravity(position), self._regressor(position, zero, zero))

    def torque(self, *motion: np.ndarray) -> Uncertain:
        """Return the torques (T, n) [Nm, N] that would be logged, with standard deviations.

        motion: q, qd, qdd (T, n), and z and direction where known. The standard deviation includes the torque residual
        of held-out samples, that is noise and errors of the model.
        """
        q, qd, qdd, *state = (torch.as_tensor(np.ascontiguousarray(x)) for x in motion)
        model, root = self.model, self._root.clone()
        constants, of_bodies = self._constants.root, self._vector.mask("bodies")
        root[of_bodies] = constants[: int(of_bodies.sum())]
        with torch.no_grad():
            value = model.inverse_dynamics(q, qd, qdd, *state)
            inputs = model.input_matrix(q[:1])[0]
            inverse = torch.linalg.inv(inputs + torch.diag((~inputs.any(dim=1)).double()))
        variance = (inverse.square() @ torch.from_numpy(self.torque_std).square()).expand_as(q).clone()
        samples = TorqueSamples(SampleBlock(q, qd, qdd, torch.zeros_like(q), *state), len(q))
        for first in range(0, len(q), BLOCK):
            block = samples.select(slice(first, first + BLOCK))
            rows = torch.zeros(block.count, model.n, root.shape[1]).double()
            for joint, columns, jacobian, _ in TorqueJacobian(model, block).joint_rows(self._x):
                rows[:, joint] = jacobian @ root[columns]
            variance[first : first + BLOCK] += (inverse @ rows).square().sum(dim=-1)
        return Uncertain(value.numpy(), variance.sqrt().numpy())

    @cached_property
    def base_parameters(self) -> tuple[Interval, ...]:
        """The identifiable combinations of inertial parameters and armatures."""
        names, combination = self._base
        values, roots = (combination @ factor for factor in self._constants)
        result = []
        for name, value, root in zip(names, values.tolist(), roots, strict=True):
            unit = {"m": "kg", "h": "kg m"}.get(name[0], "kg m²")
            result.append(Interval(name, value, float(root.norm()), unit))
        return tuple(result)

    @cached_property
    def bodies(self) -> tuple[Interval, ...]:
        """Mass [kg] and first moments [kg m] of each body that the logs can determine on their own."""
        names, _ = self._base
        value, root = self._constants
        result = []
        for index in range(10 * len(self.model.chain.parents)):
            if (
                index % 10 < 4 and parameter_name(index) in names
            ):  # base parameters of several have the suffix R
                unit, positive = ("kg", True) if index % 10 == 0 else ("kg m", False)
                std = float(root[index].norm())
                result.append(Interval(parameter_name(index), float(value[index]), std, unit, positive))
        return tuple(result)

    @property
    def unidentifiable(self) -> tuple[str, ...]:
        """Names of the masses and first moments that only occur in combinations, or in none."""
        known = {x.name for x in self.bodies}
        names = map(parameter_name, range(10 * len(self.model.chain.parents)))
        return tuple(name for name in names if name[0] in "mh" and name not in known)

    @cached_property
    def drives(self) -> tuple[Interval, ...]:
        """Armature, viscous and Coulomb friction, torque offset and trained gain per joint, and the torque delay.

        Viscous and Coulomb friction approximate the friction model by least squares up to the typical speed.
        """
        model, inputs = self.model, self.model.inputs
        gains = isinstance(inputs, MotorInputs) and len(inputs.gain_rows) > 0

        load, factor = self._loads()

        def constants(model: ArmModel) -> Tensor:
            rows = [model.armature, *_friction_line(model.friction, load, factor), model.torque_offset]
            return torch.stack([*rows, model.inputs.gains().sum(dim=1)] if gains else rows)

        value, root = self.propagate(constants)
        result = []
        for joint, (name, joint_type) in enumerate(zip(model.joint_names, model.joint_types, strict=True)):
            unit = UNITS[joint_type]
            quantities = [
                ("armature", unit.inertia), ("viscous", f"{unit.torque} s/{unit.position}"),
                ("coulomb", unit.torque), ("offset", unit.torque), ("gain", ""),
            ]  # fmt: skip
            for row, (quantity, label) in enumerate(quantities[: len(value)]):
                std = float(root[row, joint].norm())
                if quantity != "gain" or std:
                    positive = quantity in ("armature", "coulomb", "gain")
                    result.append(
                        Interval(f"{quantity} {name}", float(value[row, joint]), std, label, positive)
                    )
        if self.delay:
            result.append(Interval("torque delay", self.delay, self.delay_std, "s"))
        return tuple(result)

    @property
    def listings(self) -> tuple[Listing, Listing]:
        """Two tables with 95 % intervals: base parameters, and constants of the drives."""
        note = f"Unidentifiable on their own: {', '.join(self.unidentifiable) or 'none'}."
        title = "Base parameters [kg, m], with half 95 % intervals; numbers after names: joint"
        return (
            interval_listing(title, self.base_parameters, note),
            interval_listing("Drives and friction, with half 95 % intervals", self.drives),
        )

    def to_dict(self) -> Content:
        """Return all intervals in their JSON form."""
        groups = {"base_parameters": self.base_parameters, "bodies": self.bodies, "drives": self.drives}
        result: Content = {name: [x.to_dict() for x in group] for name, group in groups.items()}
        return result | {"unidentifiable": self.unidentifiable, "torque_std": self.torque_std.tolist()}

    def _loads(self) -> tuple[Tensor, Tensor]:
        """Return gravity torques on the drives and residual factors on friction at random positions, (P, n) each."""
        joints = self.model.spec.joints
        places = np.random.default_rng(0).uniform(-1.0, 1.0, (POSITIONS, self.model.n))
        q = torch.from_numpy([x.center for x in joints] + places * [x.half_range for x in joints])
        with torch.no_grad():
            load = self.model.gravity(q) @ torch.linalg.inv(motors_of(self.model))
            return load, friction_factor(self.model, q)

    @cached_property
    def _vector(self) -> ParameterVector:
        return ParameterVector(self.model)

    @cached_property
    def _x(self) -> Tensor:
        return self._vector.flatten(self._vector.initial)

    @cached_property
    def _root(self) -> Tensor:
        """R, (K, k), without directions of negligible variance."""
        values, vectors = torch.linalg.eigh(self.covariance)
        kept = values > 1e-14 * values.max()
        return vectors[:, kept] * values[kept].sqrt()

    @cached_property
    def _base(self) -> tuple[list[str], Tensor]:
        """Names and combinations (r, 10 B + n) of the base parameters, by inertial parameters and armatures.

        They are those of `identification.base_parameters`, without exact arithmetic: a column of the regressor at
        random states in the span of the columns before it is regrouped into these (Gautier and Khalil, IEEE T-RA
        6:368, 1990).
        """
        model, bodies = self.model, len(self.model.chain.parents)
        order = [10 * body + INERTIAL_PARAMETERS.index(name) for body in range(bodies) for name in BASE_ORDER]
        order += range(10 * bodies, 10 * bodies + model.n)
        shape = (3, 2 * len(order) // model.n + 1, model.n)  # twice as many equations as parameters
        q, qd, qdd = torch.from_numpy(np.random.default_rng(0).uniform(-3.0, 3.0, shape))
        columns = self._regressor(q, qd, qdd).flatten(0, 1)
        remainder = torch.linalg.qr(columns[:, order]).R.diagonal().abs()
        is_base = remainder > DEPENDENT * columns[:, order].norm(dim=0).clamp(min=1.0)
        base = torch.tensor(order)[is_base]
        combination = torch.linalg.lstsq(columns[:, base], columns).solution
        combination[combination.abs() < ROUNDING] = 0.0
        names = []
        for index, row in zip(base.tolist(), combination, strict=True):
            if index >= 10 * bodies:
                names.append(f"armature{index - 10 * bodies + 1}")
            else:
                regrouped = int(row[: 10 * bodies].count_nonzero()) > 1
                names.append(parameter_name(index) + ("R" if regrouped else ""))
        return names, combination

    @cached_property
    def _constants(self) -> Propagated:
        """Inertial parameters of all bodies, then armatures, (10 B + n,)."""
        return self.propagate(lambda model: torch.cat([model.inertial_parameters.flatten(), model.armature]))

    def _regressor(self, q: Tensor, qd: Tensor, qdd: Tensor) -> Tensor:
        """Return the derivative of joint torques with respect to these constants, (T, n, 10 B + n)."""
        motors = motors_of(self.model)
        rotors = (qdd @ motors.mT).unsqueeze(-2) * motors.mT
        return torch.cat([regressor_of(self.model.chain, q, qd, qdd), rotors], dim=-1)

    def _linear(self, value: Tensor, rows: Tensor) -> Uncertain:
        """Return a value (...) with the standard deviation of the constants' contribution, rows (..., 10 B + n)."""
        return Uncertain(value.numpy(), (rows @ self._constants.root).norm(dim=-1).numpy())


def posterior_of(
    model: ArmModel, content: Content | None, delay: float, file: Path | None = None
) -> Posterior:
    """Return the posterior of a fitted model.

    Args:
        model: with the fitted parameters.
        content: `Checkpoint.posterior`: covariance (K, K), torque_std (n,) and delay_std [s]; it may be any file's.
        delay: of the torques [s].
        file: checkpoint, for messages.

    Raises RunError without content, and for the content of another model.
    """
    if content is None:
        raise RunError(
            "a fit without intervals", file=file, expected="rigid bodies fitted to torques, and not adapted",
            do="fit the preset closed-form or hybrid by the objective torque",
        )  # fmt: skip
    covariance, torque_std, delay_std = map(content.get, ("covariance", "torque_std", "delay_std"))
    vector = ParameterVector(model)
    count = len(vector.flatten(vector.initial))
    tensors = {(count, count): covariance, (model.n,): torque_std}
    sound = isinstance(delay_std, float) and all(
        isinstance(x, Tensor) and x.shape == shape and x.dtype == torch.float64 and bool(x.isfinite().all())
        for shape, x in tensors.items()
    )
    if not sound:
        raise RunError(
            "a posterior of another model",
            file=file,
            element="posterior",
            do="restore it from a copy, or fit again",
        )
    return Posterior(model, covariance, torque_std.numpy(), delay, delay_std)


def _friction_line(friction: FrictionLaws, load: Tensor, factor: Tensor) -> Tensor:
    """Return the viscous and Coulomb friction, (2, n), that are nearest to a friction model.

    Args:
        friction: of the drives.
        load: gravity torques on the drives, (P, n) [Nm, N].
        factor: of the residual terms on friction, (P, n).
    """
    speed = torch.from_numpy(SPEEDS).unsqueeze(-1) * friction.speed
    torque = (factor * friction.prepare().torque(speed.unsqueeze(1), load)).mean(dim=1)
    line = np.linalg.pinv(np.stack([SPEEDS, np.ones_like(SPEEDS)], axis=-1))
    slope, intercept = torch.from_numpy(line) @ torque
    return torch.stack([slope / friction.speed, intercept])
