"""Posterior of a fitted model: 95 % intervals of its parameters, of M(q), g(q) and of predicted torques.

The covariance R R^T of the fitted parameters x (`fitting.torque.covariance`, `fitting.servo.posterior`) is propagated
to first order: the variance of a function f(x) is |J R|^2, with the Jacobian J = df/dx. The variance of a predicted
torque also includes the squared residual of held-out samples.
"""

import copy
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from spelgen.dynamics.body_regressor import base_combinations, constants_regressor
from spelgen.dynamics.parameters import evaluate_with
from spelgen.dynamics.protocol import motors_of
from spelgen.emission.assemble import ArmModel
from spelgen.errors import RunError
from spelgen.fitting.drive_quantities import DriveQuantity, ModelFunction, torque_drive_quantities
from spelgen.fitting.run_record import Content
from spelgen.fitting.torque.parameters import ParameterVector
from spelgen.identification.intervals import PRECISE, Interval, base_unit, interval_listing
from spelgen.labels import UNITS, parameter_name
from spelgen.listing import Listing


class Uncertain(NamedTuple):
    """Values of a quantity and their standard deviations, of the same shape and unit."""

    value: np.ndarray
    std: np.ndarray


class Propagated(NamedTuple):
    """Value of a function of the model, (...), and a square root of the covariance of the value, (..., k).

    root: J R, with the Jacobian J, (..., K), of the value with respect to the K fitted parameters. R, (K, k), is a
    square root of rank k of the covariance R R^T of these parameters. The norm of ``root`` over the last axis is the
    standard deviation of the value.
    """

    value: Tensor
    root: Tensor


@dataclass(frozen=True, eq=False)
class Posterior:
    """Posterior (mean and covariance of the parameters) of a model that was fitted to torques.

    Models with position servos have the derived class `ServoPosterior`.

    Attributes:
        covariance: (K, K), covariance of the K rigid-body, drive and friction parameters.
        torque_std: (n,) [Nm, N], RMS of the low-pass filtered torque residual on blocks of samples that were not
            fitted; None in `ServoPosterior`, because torques are not logged.
        delay: delay of the torques relative to the positions [s], in `ServoPosterior` delay of the commands; None if
            there is no delay.
    """

    model: ArmModel
    covariance: Tensor
    torque_std: np.ndarray | None
    delay: Interval | None = None

    def uncertain(self, function: ModelFunction) -> Uncertain:
        """Return the value (...) of a function of the model, and its standard deviations.

        Example of a function: ``lambda model: model.armature``.
        """
        value, root = self.propagate(function)
        return Uncertain(value.numpy(), root.norm(dim=-1).numpy())

    def propagate(self, function: ModelFunction) -> Propagated:
        """Return the value (...) of a function of the model, and a square root J R of its covariance, (..., k).

        J is the Jacobian of the function with respect to the fitted parameters, computed by central differences. R has
        k columns (see `_root`).
        """

        def at(x: Tensor) -> Tensor:
            """Return the value (...) of `function` for the model with the K fitted parameters x, (K,)."""
            return evaluate_with(self.model, self._vector.unflatten(x), function)

        # Step of the central differences, in standard deviations of the fitted parameters: small enough that the
        # function is linear within a step, and large enough that rounding errors are negligible.
        part = 1e-4
        with torch.no_grad():
            columns = [(at(self._x + part * x) - at(self._x - part * x)) / (2 * part) for x in self._root.mT]
            return Propagated(at(self._x), torch.stack(columns, dim=-1))

    def mass_matrix(self, q: np.ndarray) -> Uncertain:
        """Return M (T, n, n) [kg m^2, kg m, kg] at q (T, n) [rad, m], with standard deviations."""
        position = self._positions(q)
        zero = torch.zeros_like(position)
        at_rest, units = self._regressor(position, zero, zero), torch.eye(self.model.n).double()
        columns = [self._regressor(position, zero, unit.expand_as(zero)) - at_rest for unit in units]
        with torch.no_grad():
            return self._linear(self.model.mass_matrix(position), torch.stack(columns, dim=-2))

    def gravity(self, q: np.ndarray) -> Uncertain:
        """Return gravity torques (T, n) [Nm, N] at q (T, n) [rad, m], with standard deviations."""
        position = self._positions(q)
        zero = torch.zeros_like(position)
        with torch.no_grad():
            return self._linear(self.model.gravity(position), self._regressor(position, zero, zero))

    def _positions(self, q: np.ndarray) -> Tensor:
        """Return positions (T, n) as a tensor. Raises ValueError for another shape."""
        position = torch.as_tensor(q, dtype=torch.float64)
        if position.ndim != 2 or position.shape[1] != self.model.n:
            raise ValueError(f"got q of shape {tuple(position.shape)}, expected (T, {self.model.n})")
        return position

    def torque(self, *motion: np.ndarray) -> Uncertain:
        """Return the torques (T, n) [Nm, N] that would be logged, with standard deviations.

        motion: q, qd, qdd, (T, n) each and, if known, the friction state z and the direction of motion (see
        `DynamicsSamples`). The variance is the sum of two variances: the one due to errors of the parameters, and
        `torque_std` squared, which includes noise and model errors. Raises RunError for position servos.
        """
        if self.torque_std is None:
            raise RunError("intervals of torques", expected="a fit to logs with torques, not to commands")
        # Jacobian and samples of torques are imported here, since intervals of parameters do not need them.
        from spelgen.fitting.torque.jacobian import TorqueJacobian
        from spelgen.fitting.torque.samples import TorqueSamples
        from spelgen.logs.dynamics_samples import DynamicsSamples

        q, *motion_and_state = (torch.as_tensor(np.ascontiguousarray(x)) for x in motion)
        model, root, of_bodies = self.model, self._root.clone(), self._vector.mask("bodies")
        root[of_bodies] = self._constants.root[: int(of_bodies.sum())]
        with torch.no_grad():
            value = model.inverse_dynamics(q, *motion_and_state)
            inputs = model.input_matrix(q[:1])[0]
            inverse = torch.linalg.inv(inputs + torch.diag((~inputs.any(dim=1)).double()))
        variance = (inverse.square() @ torch.from_numpy(self.torque_std).square()).expand_as(q).clone()
        samples = DynamicsSamples("", motion[0], motion[1], motion[2], np.zeros_like(motion[0]), *motion[3:])
        # Samples are processed in blocks, since the Jacobian of all samples of a log may not fit into memory.
        size = 2048
        for first in range(0, len(q), size):
            block = TorqueSamples.of([samples[first : first + size]])
            rows = torch.zeros(block.count, model.n, root.shape[1]).double()
            for joint, columns, jacobian, _ in TorqueJacobian(model, block).joint_rows(self._x):
                rows[:, joint] = jacobian @ root[columns]
            variance[first : first + size] += (inverse @ rows).square().sum(dim=-1)
        return Uncertain(value.numpy(), variance.sqrt().numpy())

    @cached_property
    def base_parameters(self) -> tuple[Interval, ...]:
        """95 % intervals of the base parameters: identifiable combinations of inertial parameters and armatures."""
        names, values = self._base[0], self._base_values
        rows = zip(names, values.value.tolist(), values.root.norm(dim=1).tolist(), strict=True)
        return tuple(Interval(name, value, std, base_unit(name)) for name, value, std in rows)

    @property
    def base_units(self) -> str:
        """Units of the base parameters, for the title of a table."""
        return "kg, m"

    @cached_property
    def bodies(self) -> tuple[Interval, ...]:
        """95 % intervals of the masses [kg] and first moments [kg m] that are identifiable individually."""
        pairs = zip(self._base[0], self.base_parameters, strict=True)
        return tuple(replace(x, positive=name[0] == "m") for name, x in pairs if name in self._first_moments)

    @property
    def unidentifiable(self) -> tuple[str, ...]:
        """Names of the masses and first moments that logs determine only in combinations, or not at all."""
        names, _ = self._base
        return tuple(name for name in self._first_moments if name not in names)

    @property
    def _first_moments(self) -> list[str]:
        """Names of the masses and first moments of all bodies."""
        names = map(parameter_name, range(10 * len(self.model.chain.parents)))
        return [name for name in names if name[0] in "mh"]

    @cached_property
    def drives(self) -> dict[str, tuple[Interval, ...]]:
        """{quantity: 95 % intervals of the joints}.

        The quantities are armature, viscous and Coulomb friction, torque offset, and trained motor gain.
        """
        model = self.model
        quantities, function = self._drive_quantities()
        result = {}
        for quantity, value, std in zip(quantities, *self.uncertain(function), strict=True):
            labels = [quantity.unit.format(UNITS[joint_type]) for joint_type in model.joint_types]
            result[quantity.name] = tuple(
                Interval(model.joint_names[k], float(value[k]), float(std[k]), labels[k], quantity.positive)
                for k in quantity.joints
            )
        return result

    @property
    def drive_columns(self) -> dict[str, list[str]]:
        """Columns of the table of the drives' constants, {quantity: column}.

        A column has one text per joint, the value with interval and unit; the text is empty if the joint has no value.
        """
        columns = {}
        for quantity, of_joints in self.drives.items():
            cells = {x.name: f"{x.text} {x.unit}".rstrip() for x in of_joints}
            columns[quantity] = [cells.get(name, "") for name in self.model.joint_names]
        return columns

    @property
    def listings(self) -> tuple[Listing, Listing]:
        """Two tables with 95 % intervals: the determined base parameters, and constants of the drives."""
        determined = [x for x in self.base_parameters if x.determined in PRECISE]
        others = len(self.base_parameters) - len(determined)
        note = f"{others} more are not determined to 20 %. " if others else ""
        note += f"Unidentifiable on their own: {', '.join(self.unidentifiable) or 'none'}."
        title = f"Base parameters [{self.base_units}], with half 95 % intervals; numbers after names: joint"
        columns = {"joint": list(self.model.joint_names), **self.drive_columns}
        note_delay = "" if self.delay is None else f"{self.delay.name.capitalize()}: {self.delay.text} s."
        return (
            interval_listing(title, determined, note),
            Listing.of_columns("Drives, with half 95 % intervals", columns, note_delay),
        )

    def to_dict(self) -> Content:
        """Return all intervals and the RMS torque residuals as JSON."""
        return {
            "base_parameters": [x.to_dict() for x in self.base_parameters],
            "bodies": [x.to_dict() for x in self.bodies],
            "unidentifiable": list(self.unidentifiable),
            "drives": {name: [x.to_dict() for x in of_joints] for name, of_joints in self.drives.items()},
            "delay": None if self.delay is None else self.delay.to_dict(),
            "torque_deviation": None if self.torque_std is None else self.torque_std.tolist(),
        }

    @cached_property
    def _vector(self) -> ParameterVector:
        return ParameterVector(self.model)

    @cached_property
    def _x(self) -> Tensor:
        return self._vector.flatten(self._vector.initial)

    @cached_property
    def _root(self) -> Tensor:
        """Square root R (K, k) of the covariance R R^T of the K fitted parameters.

        The columns of R are the k eigenvectors of non-negligible variance, each times its standard deviation.
        """
        values, vectors = torch.linalg.eigh(self.covariance)
        kept = values > 1e-14 * values.max()
        root: Tensor = vectors[:, kept] * values[kept].sqrt()
        return root

    @cached_property
    def _base(self) -> tuple[tuple[str, ...], Tensor]:
        return base_combinations(self.model.chain, motors_of(self.model))

    @cached_property
    def _constants(self) -> Propagated:
        """Inertial parameters of all B bodies, then armatures, (10 B + n,), with a square root of their covariance.

        The square root is (10 B + n, k), see `Propagated`.
        """
        return self.propagate(lambda model: torch.cat([model.inertial_parameters.flatten(), model.armature]))

    @cached_property
    def _base_values(self) -> Propagated:
        """Values of the r base parameters, (r,), with a square root (r, k) of their covariance, see `Propagated`."""
        return Propagated(*(self._base[1] @ factor for factor in self._constants))

    def _drive_quantities(self) -> tuple[list[DriveQuantity], ModelFunction]:
        """Return the constants of drives that have 95 % intervals, and the function that computes their values.

        The constants are armature, friction, torque offset and motor gain (see `torque_drive_quantities`). The function
        returns their values for a model, one row of n joints per constant, (constants, n).
        """
        return torque_drive_quantities(self.model)

    def _regressor(self, q: Tensor, qd: Tensor, qdd: Tensor) -> Tensor:
        return constants_regressor(self.model.chain, motors_of(self.model), q, qd, qdd)

    def _linear(self, value: Tensor, rows: Tensor) -> Uncertain:
        """Return a value (...) that is linear in inertial parameters and armatures, with its standard deviation.

        rows: (..., 10 B + n), derivatives of the value with respect to the inertial parameters of the B bodies, then
        with respect to the n armatures.
        """
        return Uncertain(value.numpy(), (rows @ self._constants.root).norm(dim=-1).numpy())


def posterior_of(model: ArmModel, content: Content | None, delay: float, file: Path | None) -> Posterior:
    """Return the posterior of a fitted model.

    Args:
        model: model with the fitted parameters.
        content: field ``posterior`` of a checkpoint: covariance of the K parameters, (K, K), delay_std [s], and, unless
            the model has position servos, torque_std, (n,) [Nm, N].
        delay: delay of the torques relative to the positions [s].
        file: path of the checkpoint, for error messages; None for a fit without a folder.

    Raises RunError if the content is None, or if it belongs to another model.
    """
    if content is None:
        raise RunError(
            "a fit without intervals", file=file,
            expected="rigid bodies fitted to torques or by the objective servo, and not adapted",
            do="fit the preset closed-form or hybrid by the objective torque or servo",
        )  # fmt: skip
    vector = ParameterVector(model)
    count = len(vector.flatten(vector.initial))
    covariance = _tensor(content, "covariance", (count, count))
    torque_std, delay_std = _tensor(content, "torque_std", (model.n,)), content.get("delay_std")
    servos = model.input_quantity == "position"
    if covariance is None or (torque_std is None) != servos or not isinstance(delay_std, float):
        do = "restore it from a copy, or fit again"
        raise RunError("a posterior of another model", file=file, element="posterior", do=do)
    if servos:
        delay = float(model.servo.delay)
    late = Interval("delay of the commands" if servos else "torque delay", delay, delay_std, "s", servos)
    # The posterior keeps a copy of the model, because the caller may change the model.
    model = copy.deepcopy(model).double().cpu().requires_grad_(False)
    std = None if torque_std is None else torque_std.numpy()
    delay_interval = late if delay else None
    if not servos:
        return Posterior(model, covariance, std, delay_interval)
    # `ServoPosterior` is imported here, since its file imports this file.
    from spelgen.fitting.servo.posterior import ServoPosterior

    return ServoPosterior(model, covariance, std, delay_interval)


def _tensor(content: Content, name: str, shape: tuple[int, ...]) -> Tensor | None:
    """Return the tensor ``name`` of a posterior's content.

    Return None if the content is damaged or belongs to another model: it has no float64 tensor of this name and shape,
    an element is not finite, or all elements are zero.
    """
    tensor = content.get(name)
    if isinstance(tensor, Tensor) and tensor.shape == shape and tensor.dtype == torch.float64:
        return tensor if tensor.any() and tensor.isfinite().all() else None
    return None
