"""Posterior of a fitted model: 95 % intervals of its parameters, of M(q), g(q) and of predicted torques.

The covariance of the fitted parameters (`fitting.torque.covariance`) is propagated to first order: the variance of a
function f is |df/dx R|^2 with the covariance R R^T. Torque predictions add the residual of held-out samples.
"""

import copy
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import compress
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from spelgen.dynamics.body_regressor import base_combinations, constants_regressor
from spelgen.dynamics.parameters import evaluate_with, friction_factor
from spelgen.dynamics.protocol import motors_of
from spelgen.emission.assemble import ArmModel
from spelgen.errors import RunError
from spelgen.fitting.run_record import Content
from spelgen.fitting.torque.jacobian import TorqueJacobian
from spelgen.fitting.torque.parameters import ParameterVector
from spelgen.fitting.torque.samples import TorqueSamples
from spelgen.identification.intervals import Interval, base_unit, interval_listing
from spelgen.labels import UNITS, parameter_name
from spelgen.listing import Listing
from spelgen.logs.dynamics_samples import DynamicsSamples
from spelgen.runtime.motors import MotorInputs

QUANTITIES = {
    "armature": "{0.inertia}",
    "viscous": "{0.torque} s/{0.position}",
    "coulomb": "{0.torque}",
    "offset": "{0.torque}",
    "gain": "",
}
"""Units of the quantities of a drive, formatted with `UNITS` of its joint type."""


class Uncertain(NamedTuple):
    """Values of a quantity and their standard deviations, of the same shape and unit."""

    value: np.ndarray
    std: np.ndarray


class Propagated(NamedTuple):
    """Value of a function of the model, (...), and its derivative times R, (..., k): norms over k are deviations."""

    value: Tensor
    root: Tensor


@dataclass(frozen=True, eq=False)
class Posterior:
    """Posterior of a model that was fitted to torques.

    covariance: (K, K) of the rigid-body, drive and friction parameters. torque_std: (n,) RMS torque residual of blocks
    of samples that were not fitted [Nm, N], below the cutoff of the fit's filter. delay: of the torques relative to the
    positions.
    """

    model: ArmModel
    covariance: Tensor
    torque_std: np.ndarray
    delay: Interval | None = None

    def uncertain(self, function: Callable[[ArmModel], Tensor]) -> Uncertain:
        """Return a function of the model, (...,), with standard deviations: ``lambda model: model.armature``."""
        value, root = self.propagate(function)
        return Uncertain(value.numpy(), root.norm(dim=-1).numpy())

    def propagate(self, function: Callable[[ArmModel], Tensor]) -> Propagated:
        """Return a function of the model, (...), and its derivative times R."""

        def at(x: Tensor) -> Tensor:
            """Return the function at parameters x, (K,)."""
            return evaluate_with(self.model, self._vector.unflatten(x), function)

        part = 1e-4  # central differences over a part of a standard deviation: linear, and far above rounding
        with torch.no_grad():
            columns = [(at(self._x + part * x) - at(self._x - part * x)) / (2 * part) for x in self._root.mT]
            return Propagated(at(self._x), torch.stack(columns, dim=-1))

    def mass_matrix(self, q: np.ndarray) -> Uncertain:
        """Return M (T, n, n) at q (T, n), with standard deviations."""
        position, zero = torch.as_tensor(q), torch.zeros(len(q), self.model.n).double()
        at_rest, units = self._regressor(position, zero, zero), torch.eye(self.model.n).double()
        columns = [self._regressor(position, zero, unit.expand_as(zero)) - at_rest for unit in units]
        with torch.no_grad():
            return self._linear(self.model.mass_matrix(position), torch.stack(columns, dim=-2))

    def gravity(self, q: np.ndarray) -> Uncertain:
        """Return gravity torques (T, n) [Nm, N] at q (T, n), with standard deviations."""
        position, zero = torch.as_tensor(q), torch.zeros(len(q), self.model.n).double()
        with torch.no_grad():
            return self._linear(self.model.gravity(position), self._regressor(position, zero, zero))

    def torque(self, *motion: np.ndarray) -> Uncertain:
        """Return the torques (T, n) [Nm, N] that would be logged, with standard deviations.

        motion: q, qd, qdd (T, n), and z and direction where known. The standard deviation includes noise and errors
        of the model, from the torque residual of blocks of samples that were not fitted.
        """
        q, *motion_and_state = (torch.as_tensor(np.ascontiguousarray(x)) for x in motion)
        model, root, of_bodies = self.model, self._root.clone(), self._vector.mask("bodies")
        root[of_bodies] = self._constants.root[: int(of_bodies.sum())]
        with torch.no_grad():
            value = model.inverse_dynamics(q, *motion_and_state)
            inputs = model.input_matrix(q[:1])[0]
            inverse = torch.linalg.inv(inputs + torch.diag((~inputs.any(dim=1)).double()))
        variance = (inverse.square() @ torch.from_numpy(self.torque_std).square()).expand_as(q).clone()
        samples = DynamicsSamples("", motion[0], motion[1], motion[2], np.zeros_like(motion[0]), *motion[3:])
        size = 2048  # of a block: the Jacobians of all samples of a log may not fit into memory
        for first in range(0, len(q), size):
            block = TorqueSamples.of([samples[first : first + size]])
            rows = torch.zeros(block.count, model.n, root.shape[1]).double()
            for joint, columns, jacobian, _ in TorqueJacobian(model, block).joint_rows(self._x):
                rows[:, joint] = jacobian @ root[columns]
            variance[first : first + size] += (inverse @ rows).square().sum(dim=-1)
        return Uncertain(value.numpy(), variance.sqrt().numpy())

    @cached_property
    def base_parameters(self) -> tuple[Interval, ...]:
        """The identifiable combinations of inertial parameters and armatures."""
        names, combination = self._base
        values, roots = (combination @ factor for factor in self._constants)
        rows = zip(names, values.tolist(), roots.norm(dim=1).tolist(), strict=True)
        return tuple(Interval(name, value, std, base_unit(name)) for name, value, std in rows)

    @cached_property
    def bodies(self) -> tuple[Interval, ...]:
        """Mass [kg] and first moments [kg m] of each body that the logs determine individually."""
        _, combination = self._base
        alone = compress(self.base_parameters, (combination.count_nonzero(dim=1) == 1).tolist())
        return tuple(replace(x, positive=x.name[0] == "m") for x in alone if x.name[0] in "mh")

    @property
    def unidentifiable(self) -> tuple[str, ...]:
        """Names of the masses and first moments that the logs determine only in combinations, or not at all."""
        known = {x.name for x in self.bodies}
        names = map(parameter_name, range(10 * len(self.model.chain.parents)))
        return tuple(name for name in names if name[0] in "mh" and name not in known)

    @cached_property
    def drives(self) -> dict[str, tuple[Interval, ...]]:
        """Armature, viscous and Coulomb friction, torque offset and trained gain, each per joint, by quantity.

        Viscous and Coulomb friction approximate the friction model by least squares up to the typical speed.
        """
        model, inputs = self.model, self.model.inputs
        trained = inputs.gain_rows.tolist() if isinstance(inputs, MotorInputs) else []
        friction_line = _friction_line(model)

        def constants(model: ArmModel) -> Tensor:
            """Return the quantities of all joints, (4, n) or (5, n)."""
            rows = [model.armature, *friction_line(model), model.torque_offset]
            if isinstance(model.inputs, MotorInputs) and trained:
                rows.append(model.inputs.gains().sum(dim=1))
            return torch.stack(rows)

        rows = zip(QUANTITIES.items(), *self.uncertain(constants), strict=False)
        result = {}
        for (quantity, unit), value, std in rows:
            positive, joints = quantity in ("armature", "coulomb", "gain"), range(model.n)
            labels = [unit.format(UNITS[joint_type]) for joint_type in model.joint_types]
            result[quantity] = tuple(
                Interval(model.joint_names[k], float(value[k]), float(std[k]), labels[k], positive)
                for k in (trained if quantity == "gain" else joints)
            )
        return result

    @property
    def drive_columns(self) -> dict[str, list[str]]:
        """Columns of the table of drives: quantity -> texts of value and unit, (n,), empty for joints without it."""
        columns = {}
        for quantity, of_joints in self.drives.items():
            cells = {x.name: f"{x.text} {x.unit}".rstrip() for x in of_joints}
            columns[quantity] = [cells.get(name, "") for name in self.model.joint_names]
        return columns

    @property
    def listings(self) -> tuple[Listing, Listing]:
        """Two tables with 95 % intervals: the determined base parameters, and constants of the drives."""
        determined = [x for x in self.base_parameters if x.determined in ("firm", "fair")]
        note = (
            f"{len(self.base_parameters) - len(determined)} more are not determined to 20 %. Unidentifiable on their "
            f"own: {', '.join(self.unidentifiable) or 'none'}."
        )
        title = "Base parameters [kg, m], with half 95 % intervals; numbers after names: joint"
        columns = {"joint": list(self.model.joint_names), **self.drive_columns}
        drives = tuple(zip(*columns.values(), strict=True))
        note_delay = "" if self.delay is None else f"Torque delay: {self.delay.text} s."
        return (
            interval_listing(title, determined, note),
            Listing("Drives, with half 95 % intervals", tuple(columns), drives, note_delay),
        )

    def to_dict(self) -> Content:
        """Return all intervals in their JSON form."""
        return {
            "base_parameters": [x.to_dict() for x in self.base_parameters],
            "bodies": [x.to_dict() for x in self.bodies],
            "unidentifiable": list(self.unidentifiable),
            "drives": {name: [x.to_dict() for x in of_joints] for name, of_joints in self.drives.items()},
            "torque_delay": None if self.delay is None else self.delay.to_dict(),
            "torque_deviation": self.torque_std.tolist(),
        }

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
        root: Tensor = vectors[:, kept] * values[kept].sqrt()
        return root

    @cached_property
    def _base(self) -> tuple[tuple[str, ...], Tensor]:
        return base_combinations(self.model.chain, motors_of(self.model))

    @cached_property
    def _constants(self) -> Propagated:
        """Inertial parameters of all bodies, then armatures, (10 B + n,)."""
        return self.propagate(lambda model: torch.cat([model.inertial_parameters.flatten(), model.armature]))

    def _regressor(self, q: Tensor, qd: Tensor, qdd: Tensor) -> Tensor:
        return constants_regressor(self.model.chain, motors_of(self.model), q, qd, qdd)

    def _linear(self, value: Tensor, rows: Tensor) -> Uncertain:
        """Return a value (...) with the standard deviation of the constants' contribution, rows (..., 10 B + n)."""
        return Uncertain(value.numpy(), (rows @ self._constants.root).norm(dim=-1).numpy())


def posterior_of(
    model: ArmModel, content: Content | None, delay: float, file: Path | None = None
) -> Posterior:
    """Return the posterior of a fitted model.

    Args:
        model: with the fitted parameters.
        content: `Checkpoint.posterior`: covariance (K, K), torque_std (n,) and delay_std [s]; untrusted.
        delay: of the torques [s].
        file: checkpoint, for messages.

    Raises RunError without content, and for the content of another model.
    """
    if content is None:
        raise RunError(
            "a fit without intervals", file=file, expected="rigid bodies fitted to torques, and not adapted",
            do="fit the preset closed-form or hybrid by the objective torque",
        )  # fmt: skip
    vector = ParameterVector(model)
    count = len(vector.flatten(vector.initial))
    covariance = _tensor(content, "covariance", (count, count))
    torque_std, delay_std = _tensor(content, "torque_std", (model.n,)), content.get("delay_std")
    if covariance is None or torque_std is None or not isinstance(delay_std, float):
        do = "restore it from a copy, or fit again"
        raise RunError("a posterior of another model", file=file, element="posterior", do=do)
    late = Interval("torque delay", delay, delay_std, "s") if delay else None
    model = copy.deepcopy(model).double().cpu().requires_grad_(False)  # the caller may change its own
    return Posterior(model, covariance, torque_std.numpy(), late)


def _tensor(content: Content, name: str, shape: tuple[int, ...]) -> Tensor | None:
    """Return a tensor by its name; None if it is absent, has another shape or type, is zero or not finite."""
    tensor = content.get(name)
    if isinstance(tensor, Tensor) and tensor.shape == shape and tensor.dtype == torch.float64:
        return tensor if tensor.any() and tensor.isfinite().all() else None
    return None


def _friction_line(model: ArmModel) -> Callable[[ArmModel], Tensor]:
    """Return a function of a model: viscous and Coulomb friction, (2, n), that are nearest to its friction.

    The line is fitted by least squares to friction at speeds up to the typical speed, averaged over random positions,
    at which gravity and residual terms have the values of the fitted model.
    """
    rng, joints = np.random.default_rng(0), model.spec.joints
    places = rng.uniform(-1.0, 1.0, (32, model.n)) * [x.half_range for x in joints]
    q = torch.from_numpy([x.center for x in joints] + places)
    with torch.no_grad():
        load = model.gravity(q) @ torch.linalg.inv(motors_of(model))  # (P, n), on the drives
        factor = friction_factor(model, q)
    # logarithmic: the Stribeck effect and the intercept are at low speeds
    speeds = np.geomspace(0.02, 1.0, 25)
    line = torch.from_numpy(np.linalg.pinv(np.stack([speeds, np.ones_like(speeds)], axis=-1)))

    def friction_line(model: ArmModel) -> Tensor:
        friction = model.friction
        speed = torch.from_numpy(speeds)[:, None] * friction.speed
        slope, intercept = line @ (factor * friction.prepare().torque(speed[:, None], load)).mean(dim=1)
        return torch.stack([slope / friction.speed, intercept])

    return friction_line
