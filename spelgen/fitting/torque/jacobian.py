"""Torque residual of rigid bodies, drives and friction on samples, with its Jacobian and normal equations."""

from collections.abc import Iterable, Iterator, Mapping
from functools import cached_property
from typing import NamedTuple

import torch
from torch.autograd import grad as gradient

from spelgen.dynamics.body_regressor import regressor_of
from spelgen.dynamics.parameters import NamedTensors, evaluate_with, friction_factor, residual_torque
from spelgen.dynamics.protocol import motors_of
from spelgen.emission.assemble import ArmModel
from spelgen.fitting.torque import linearization
from spelgen.fitting.torque.linearization import (
    NO_TERMS,
    JointRows,
    LinearTerms,
    RigidProjection,
    concatenate_blocks,
)
from spelgen.fitting.torque.parameters import ParameterVector, joint_torque, step_in_inertial_parameters
from spelgen.fitting.torque.samples import SampleBlock, TorqueSamples
from spelgen.fitting.torque.tuning import TUNING
from spelgen.runtime.motors import MotorInputs

LOGARITHMIC_GROUPS = ("armature", "sizes", "effects", "load_dependence")


class _RegressorBlock(NamedTuple):
    """T samples with all factors of the modelled torque that do not depend on the parameters x.

    Attributes:
        samples: the T samples.
        speed, acceleration: speeds [rad/s, m/s] and accelerations [rad/s^2, m/s^2] of the drives, (T, n).
        regressor: regressor of the joint torque with respect to the inertial parameters of B bodies, (T, n, 10 B).
        load_regressor: regressor of the gravity torque on the drives, (T, n, 10 B).
        residual_torque: torque of the residual terms, (T, n) [Nm, N].
        friction_factor: factor by which the residual terms multiply the friction torque, (T, n) [1].
    """

    samples: SampleBlock
    speed: torch.Tensor
    acceleration: torch.Tensor
    regressor: torch.Tensor
    load_regressor: torch.Tensor
    residual_torque: torch.Tensor
    friction_factor: torch.Tensor


class ResidualSamples(NamedTuple):
    """T samples with the torque residual of the model and the friction torque of its drives, all (T, n).

    q, qd, qdd: positions [rad, m], velocities and accelerations (per s and s^2). torque_residual: measured minus
    modelled joint torque [Nm, N]. friction: friction torque of the drives [Nm, N].
    """

    q: torch.Tensor
    qd: torch.Tensor
    qdd: torch.Tensor
    torque_residual: torch.Tensor
    friction: torch.Tensor


class TorqueJacobian:
    """Torque residual of a model on T samples, and the derivatives of the residual with respect to parameters x (K,).

    x contains the K parameters of bodies, drives and friction (`ParameterVector`). The modelled joint torque is

        Y(q, qd, qdd) pi + C^T (f friction + armature C qdd) + torque of the residual terms,

    with the regressor Y, the inertial parameters pi of B bodies, the matrix C from joint speeds to drive speeds, and
    the factor f by which residual terms multiply friction. The friction of a drive depends on its speed, an entry of C
    qd, on the gravity torque that loads it, and on the bristle displacements. The measured joint torque is G (tau -
    offset) plus friction compensation, where G maps logged torques to joint torques. The torque residual is the
    measured minus the modelled joint torque.

    The residual terms of the model are evaluated once, when this object is created. `terms` are additional linear
    terms, which are eliminated by variable projection. theta (K,) is x with pi in place of the log-Cholesky parameters
    of the bodies.
    """

    def __init__(
        self, model: ArmModel, samples: TorqueSamples, terms: Mapping[int, LinearTerms] = NO_TERMS
    ) -> None:
        self.model, self.samples, self.terms = model, samples, terms
        self.rigid = ParameterVector(model)
        self._of_bodies = self.rigid.mask("bodies")
        inputs = model.inputs
        self._gain_rows = inputs.gain_rows if isinstance(inputs, MotorInputs) else torch.zeros(0).long()
        self._motors = motors_of(model)
        self._affects = self._motors != 0  # _affects: (n, n), entry (i, j): True if drive i acts on joint j
        self._affected = self._affected_joints()
        self._colours = _colour(self._affects.double().mT @ self._affects.double() > 0)
        # Regressors do not depend on x, so they are computed once. The samples are divided into blocks to limit the
        # memory, since `_compressed_jacobian` copies the parameters for each sample of a block.
        self._blocks = [self._with_regressors(block) for block in samples.blocks(TUNING.block)]

    @cached_property
    def torque_std(self) -> torch.Tensor:
        """Standard deviation over the samples of the logged torques, converted to joint torques G tau, (n,) [Nm, N]."""
        return joint_torque(self.model, self.samples.columns).std(dim=0)

    def squared_residual(self, x: torch.Tensor) -> torch.Tensor:
        """Return, per joint, the sum of the squared torque residuals at the parameters x (K,): (n,) [Nm^2, N^2].

        For a joint with eliminated terms, the sum includes the penalty of their weights. If motor gains are trained,
        the residual is scaled to the initial gains (see `logged_scale`): otherwise gains near zero would make it small.
        """
        parameters = self.rigid.unflatten(x)
        with torch.no_grad():
            blocks = [self._torque_residual(parameters, block)[0] for block in self._blocks]
            # The weights of eliminated terms depend on all samples of a joint, so the blocks are concatenated.
            residual = torch.cat(blocks) * self._logged_scale(parameters)
        squared_residual = residual.square().sum(dim=0)
        for joint, terms in self.terms.items():
            squared_residual[joint] = terms.residual(residual[:, joint]).square().sum()
        return squared_residual

    def logged_scale(self, x: torch.Tensor) -> torch.Tensor:
        """Return initial / current motor gain per joint, (n,) [1]; 1 for fixed gains.

        The measured joint torque is logged torque times motor gain, plus friction compensation. Multiplied by the
        returned factor, the first term does not depend on the current gain.
        """
        return self._logged_scale(self.rigid.unflatten(x)).detach()

    def _logged_scale(self, parameters: NamedTensors) -> torch.Tensor:
        """Return the initial divided by the current motor gain of each joint, (..., n) [1]; 1 for fixed gains.

        Unlike `logged_scale`, the result can be differentiated by autograd with respect to the gains in `parameters`.
        parameters: {name: values} of one set of parameters, or of a batch (...) of sets.
        """
        ones = torch.ones(self.model.n).double()
        # The parameter x is the logarithm of a motor gain (joint torque / logged torque). Initial / current gain is
        # therefore exp(x_initial - x) = exp(-change).
        for name in self.rigid.names("gains"):
            change = parameters[name] - self.rigid.initial[name]
            return ones.expand(*change.shape[:-1], -1).index_copy(-1, self._gain_rows, (-change).exp())
        return ones

    def normal_equations(self, x: torch.Tensor, noise: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Return the Gauss-Newton Hessian J^T W J (K, K) and the negative gradient J^T W r (K,) at x (K,).

        r is the torque residual at the initial motor gains (see `squared_residual`), J is minus its Jacobian, and W =
        1 / noise^2. noise: (n,) [Nm, N].
        """
        rows: Iterable[JointRows] = self.joint_rows(x)
        if self.terms:
            rows = self._projected(rows)
        curvature, descent = linearization.normal_equations(rows, noise, len(x))
        # The products J^T W J and J^T W r are computed with respect to theta (x with inertial parameters in place of
        # log-Cholesky parameters) and then transformed to x: this transforms matrices (K, K) instead of Jacobians (T,
        # K).
        change = self.theta_jacobian(x)
        return change.mT @ curvature @ change, change.mT @ descent

    def joint_rows(self, x: torch.Tensor) -> Iterator[JointRows]:
        """Yield the torque Jacobian of each joint and each block of samples with respect to theta (K,), at x (K,).

        theta is x with inertial parameters in place of the bodies' log-Cholesky parameters. The Jacobian with respect
        to inertial parameters is the regressor, plus the derivative of load-dependent friction times the regressor of
        the gravity torque. `theta_jacobian` converts from theta to x.
        """
        parameters, scale = self.rigid.unflatten(x), self.logged_scale(x)
        body_columns = self._of_bodies.nonzero()[:, 0]
        other_columns = (~self._of_bodies).nonzero()[:, 0]
        for block in self._blocks:
            residual, parameter_columns, load_columns = self._compressed_jacobian(parameters, block)
            for joint, colour in enumerate(self._colours):
                # Decompression: a colour is a set of joints that share no drive. The compressed Jacobian contains one
                # sum of the rows of all joints of a colour. The row of this joint is the part of the sum in the columns
                # of the parameters that affect its torque.
                affecting, drives = self._affected[:, joint], self._affects[:, joint]
                loads = load_columns[colour][:, drives].unsqueeze(-1) * block.load_regressor[:, drives]
                bodies = scale[joint] * block.regressor[:, joint] + loads.sum(dim=1)
                jacobian = torch.cat([bodies, parameter_columns[colour][:, affecting]], dim=1)
                columns = torch.cat([body_columns, other_columns[affecting]])
                yield JointRows(joint, columns, jacobian, residual[:, joint])

    def _projected(self, rows: Iterable[JointRows]) -> Iterator[JointRows]:
        """Yield the Jacobian rows of each joint after variable projection of the joint's linear terms.

        The rows of all blocks of samples are concatenated, since the linear terms depend on all samples.
        """
        for of_joint in concatenate_blocks(rows, self.model.n):
            terms = self.terms.get(of_joint.joint)
            if terms is None:
                yield of_joint
            else:
                jacobian, residual = terms.residual(of_joint.jacobian), terms.residual(of_joint.residual)
                yield of_joint._replace(jacobian=jacobian, residual=residual)

    def theta_jacobian(self, x: torch.Tensor) -> torch.Tensor:
        """Return d theta / d x at x (K,), (K, K): block diagonal over bodies, identity for all other parameters.

        theta is x with inertial parameters in place of the bodies' log-Cholesky parameters.
        """
        parameters = self.rigid.unflatten(x)
        # Ten copies of the bodies' parameters are used, so that one reverse pass computes the gradients of all ten
        # inertial parameters: copy k receives the gradient of inertial parameter k.
        copies = parameters[self.rigid.bodies].expand(10, -1, -1).detach().requires_grad_()
        with torch.enable_grad():
            theta = self._inertial_parameters({**parameters, self.rigid.bodies: copies})
        (gradients,) = gradient(theta.diagonal(dim1=0, dim2=2).sum(), copies)
        change = torch.eye(len(x)).double()
        of_bodies = self._of_bodies[:, None] & self._of_bodies
        change[of_bodies] = torch.block_diag(*gradients.transpose(0, 1)).flatten()
        return change

    def residual_samples(self, x: torch.Tensor) -> ResidualSamples:
        """Return all samples with the residual and the friction torque for parameters x (K,), see `ResidualSamples`."""
        parameters, blocks = self.rigid.unflatten(x), []
        with torch.no_grad():
            for block in self._blocks:
                motion = block.samples[:3]
                blocks.append(ResidualSamples(*motion, *self._torque_residual(parameters, block)))
        return ResidualSamples(*(torch.cat(column) for column in zip(*blocks, strict=True)))

    def rigid_projection(
        self, x: torch.Tensor, noise: torch.Tensor, covariance: torch.Tensor
    ) -> RigidProjection:
        """Return the projection of joint torques onto the rigid-body and friction model (see `RigidProjection`).

        Args:
            x: (K,) parameters, at which the torque is linearized.
            noise: (n,) standard deviations of the torque noise [Nm, N].
            covariance: (K, K) posterior covariance of x.
        """
        change = self.theta_jacobian(x)
        covariance = change @ covariance @ change.mT
        # The projection describes how the model would absorb an added joint torque of any magnitude. It is computed
        # with respect to theta, because the torque is linear in inertial parameters. With respect to x, which contains
        # log-Cholesky parameters instead, the projection would be valid only for small added torques.
        rows = concatenate_blocks(self.joint_rows(x), len(noise))
        gains = []
        for joint, columns, _, _ in rows:
            gains.append(covariance[columns[:, None], columns] / noise[joint] ** 2)
        return RigidProjection(tuple(of_joint.jacobian for of_joint in rows), tuple(gains))

    def curved_step(self, x: torch.Tensor, step: torch.Tensor) -> torch.Tensor:
        """Return the parameters (K,) after a step (K,) from x along a curve: a candidate of the solver.

        The torque is linear in the inertial parameters of the bodies, and in armatures and friction coefficients c, but
        x contains log-Cholesky parameters and log c. The curve is a straight line in the quantities in which the torque
        is linear, except for coefficients that fall: a step s > 0 of log c changes c to c (1 + s), a step s < 0 changes
        c to c exp(s), as x + step does, since c (1 + s) could be negative. For the bodies see
        `step_in_inertial_parameters`.
        """
        change, bodies = self.rigid.unflatten(step), self.rigid.bodies
        parameters = self.rigid.unflatten(x + step)
        for name in self.rigid.names(*LOGARITHMIC_GROUPS):
            # For s > 0, c becomes c (1 + s): log c changes by log1p(s). With a change by s, c would grow exponentially
            # with s. For s < 0, log c changes by s, since 1 + s could be negative.
            parameters[name] = (
                parameters[name]
                - change[name]
                + torch.minimum(change[name], change[name].clamp(min=0).log1p())
            )
        moved = step_in_inertial_parameters(self.rigid.unflatten(x)[bodies], change[bodies])
        # A body whose step is zero keeps its parameters exactly, without rounding errors.
        changed = change[bodies].any(dim=-1, keepdim=True)
        parameters[bodies] = torch.where(changed, moved, parameters[bodies])
        return self.rigid.flatten(parameters)

    def _with_regressors(self, block: SampleBlock) -> _RegressorBlock:
        model, q, qd, qdd = self.model, block.q, block.qd, block.qdd
        zero = torch.zeros_like(q)
        with torch.no_grad():
            # Load-dependent friction depends only on the gravity torque, whose regressor is the regressor at zero
            # velocity and zero acceleration.
            gravity_regressor = regressor_of(model.chain, q, zero, zero)
            return _RegressorBlock(
                samples=block,
                speed=qd @ self._motors.mT,
                acceleration=qdd @ self._motors.mT,
                regressor=regressor_of(model.chain, q, qd, qdd),
                load_regressor=torch.einsum("jm,tjk->tmk", torch.linalg.inv(self._motors), gravity_regressor),
                residual_torque=residual_torque(model, q, qd, qdd),
                friction_factor=friction_factor(model, q),
            )

    def _affected_joints(self) -> torch.Tensor:
        """Return a mask (K', n), True if a parameter affects the torque of a joint.

        The K' parameters are the entries of x that are not parameters of bodies: parameters of drives and friction.
        """
        masks = []
        for name, tensor in self.rigid.initial.items():
            if name == self.rigid.bodies:
                continue
            rows = self._affects
            if self.rigid.groups[name] == "gains":
                rows = rows[self._gain_rows]
            masks.append(rows.repeat_interleave(tensor[0].numel(), dim=0))
        return torch.cat(masks)

    def _inertial_parameters(self, parameters: NamedTensors) -> torch.Tensor:
        """Return the inertial parameters (..., B, 10) of B bodies for parameters {name: values}, or a batch of them."""
        theta: torch.Tensor = evaluate_with(self.model, parameters, lambda model: model.inertial_parameters)
        return theta

    def _torque_residual(
        self, parameters: NamedTensors, block: _RegressorBlock, load: torch.Tensor | None = None
    ) -> tuple[torch.Tensor, torch.Tensor]:
        """Return measured minus modelled joint torque, and the friction torque of the drives, both (T, n) [Nm, N].

        block: T samples with their regressors. load: gravity torque on the drives, (T, n); None: it is computed from
        the parameters.
        """
        samples = block.samples

        def torques(model: ArmModel) -> tuple[torch.Tensor, torch.Tensor]:
            constants, theta = model.friction.prepare(), model.inertial_parameters.flatten()
            gravity = block.load_regressor @ theta if load is None else load
            friction = constants.torque(block.speed, gravity, samples.z, samples.direction)
            friction = block.friction_factor * friction
            drive_torque = friction + model.armature * block.acceleration
            force = model.input_force(None, samples.qd, samples.tau) - block.residual_torque
            return force - block.regressor @ theta - drive_torque @ self._motors, friction

        return evaluate_with(self.model, parameters, torques)

    def _compressed_jacobian(
        self, parameters: NamedTensors, block: _RegressorBlock
    ) -> tuple[torch.Tensor, list[torch.Tensor], list[torch.Tensor]]:
        """Return the torque residual at the initial motor gains, and its negated Jacobian, compressed by graph colours.

        The residual is measured minus modelled joint torque, multiplied by initial / current motor gain
        (`logged_scale`; 1 for fixed gains). The negated Jacobian has the sign of the modelled torque. One reverse pass
        differentiates the sum of the torques of several joints, which have the same colour (graph colouring: Curtis,
        Powell and Reid, J. Inst. Maths Applics 13:117, 1974). No common drive acts on joints of one colour. A parameter
        of a drive, or the gravity torque on the drive, then affects the torque of at most one joint of a colour, and
        the derivative of the sum is the derivative of this torque. Most arms have one colour, so one pass replaces n
        passes. Each sample has its own copy of the parameters, so that a pass gives the derivatives of all samples.

        Args:
            parameters: {name: values}, the parameters at which the derivatives are computed.
            block: T samples with their regressors.

        Returns:
            The scaled residual, (T, n) [Nm, N].
            A list of matrices (T, K'), one per colour: derivatives with respect to the K' parameters of drives and
                friction, that is, to all parameters except body parameters.
            A list of matrices (T, n), one per colour: derivatives with respect to the gravity torques on the drives, on
                which friction depends.
        """
        copies = {}
        for name, tensor in parameters.items():
            if name != self.rigid.bodies:
                copies[name] = tensor.expand(len(block.speed), *tensor.shape).detach().requires_grad_()
        theta = self._inertial_parameters(parameters).flatten()
        load = (block.load_regressor @ theta).detach().requires_grad_()
        with torch.enable_grad():
            per_sample = {**parameters, **copies}
            residual = self._torque_residual(per_sample, block, load)[0] * self._logged_scale(per_sample)
        parameter_columns, load_columns, colours = [], [], torch.tensor(self._colours)
        for colour in range(max(self._colours) + 1):
            # The colours are processed one by one: a batch of gradients (`is_grads_batched`) would import torch's
            # symbolic shapes, which takes half a second.
            total = -residual[:, colours == colour].sum()
            gradients = gradient(total, [load, *copies.values()], retain_graph=True, materialize_grads=True)
            load_columns.append(gradients[0])
            parameter_columns.append(torch.cat([x.flatten(1) for x in gradients[1:]], dim=1))
        return residual.detach(), parameter_columns, load_columns


def _colour(coupled: torch.Tensor) -> list[int]:
    """Return one colour, an index, per joint by the greedy algorithm; coupled joints have different colours.

    coupled: mask (n, n), True for pairs of joints that share a drive.
    """
    colours: list[int] = []
    for row in coupled.tolist():
        used = {colour for colour, shared in zip(colours, row, strict=False) if shared}
        colours.append(min(set(range(len(row))) - used))
    return colours
