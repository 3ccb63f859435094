"""Regressor of an arm, and dynamics for given (identified) inertial parameters, also physically inconsistent ones."""

from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np
import torch
from torch import Tensor

from spelgen.arm.actuation import Drives
from spelgen.arm.arm import Chain
from spelgen.dynamics.body_regressor import chain_regressor, pseudo_inertia
from spelgen.dynamics.bristles import moved_bristles, reach_of
from spelgen.dynamics.equations import MotionEquations
from spelgen.dynamics.friction import FrictionModel
from spelgen.runtime.body_chain import BodyChain, ChainConfiguration
from spelgen.runtime.parts import Row, applied


def body_chain(arm: Chain, gravity: Row | None = None) -> BodyChain:
    """Return the kinematics of the bodies of an arm; gravity: (3,) [m/s^2], by default the gravity of the arm."""
    rows: list[tuple[Any, ...]] = []
    for body in arm.bodies:
        placement = [(*_row(row), float(x)) for row, x in zip(body.rotation, body.translation, strict=True)]
        is_revolute, ratio = body.joint_type == "revolute", float(body.multiplier)
        rows.append((body.parent, body.coordinate, is_revolute, ratio, body.offset, placement))
    return BodyChain(len(arm.coordinates), gravity or _row(arm.gravity), *zip(*rows, strict=True))


def regressor(arm: Chain, q: np.ndarray, qd: np.ndarray, qdd: np.ndarray) -> np.ndarray:
    """Return the regressor Y, (T, n, 10 B), of the arm's B bodies: joint torques are Y @ inertial parameters [Nm, N].

    Column 10 b + i belongs to parameter i of ``arm.bodies[b]``, in the order of ``Body.inertia``.

    q, qd, qdd: positions [rad, m], velocities [rad/s, m/s] and accelerations [rad/s^2, m/s^2], (T, n).
    """
    return chain_regressor(body_chain(arm), q, qd, qdd)


def urdf_parameters(arm: Chain) -> np.ndarray:
    """Return the inertial parameters of the arm's B bodies from the URDF, (10 B,); zero for bodies without <inertial>.

    The parameters are in the order of the columns of ``regressor``.
    """
    return np.array([body.inertia or (0,) * 10 for body in arm.bodies], dtype=float).ravel()


def _row(values: tuple[object, ...]) -> Row:
    return tuple(map(float, values))  # type: ignore[arg-type]


class RegressorDynamics:
    """Dynamics of an arm of n coordinates and B bodies with given inertial parameters (see ``RigidDynamics``).

    Friction may have a state: the deflections of K bristles per drive.

    Args:
        arm: kinematics and gravity.
        parameters: inertial parameters, (10 B,), in the order of the columns of ``regressor``.
        armature: armature of the drives, (n,) [kg m^2, kg].
        friction: function of velocities (T, n), and of the friction state z (T, n, K) or None, that returns the
            friction torques of the joints, (T, n) [Nm, N].
        bristle_reach: break-away displacements, (n, K) [rad, m]; None: friction has no state.
        drives: matrices G of the inputs and C of the motors (see ``Drives``); None: each input is the torque of its
            joint.
    """

    def __init__(
        self,
        arm: Chain,
        parameters: np.ndarray,
        armature: np.ndarray,
        friction: Callable[[np.ndarray, np.ndarray | None], np.ndarray],
        drives: Drives | None = None,
        bristle_reach: np.ndarray | None = None,
    ) -> None:
        # Trained models use Cholesky factors of pseudo-inertias. They do not exist for physically inconsistent
        # parameters, which least squares may return: this class uses the pseudo-inertias themselves.
        self.chain, self.friction = body_chain(arm), friction
        by_body = torch.from_numpy(parameters).double().reshape(-1, 10)
        self.inertia = torch.block_diag(*pseudo_inertia(by_body))
        self.armature = torch.tensor(armature, dtype=torch.float64)
        reach = np.zeros((len(armature), 0)) if bristle_reach is None else bristle_reach
        self.bristle_reach = torch.from_numpy(reach)
        inputs, motors = drives or Drives.direct(len(armature))
        self.inputs, self.motors = torch.from_numpy(inputs), torch.from_numpy(motors)

    @property
    def n(self) -> int:
        """Number of coordinates."""
        return len(self.armature)

    @property
    def elements(self) -> int:
        """Number of bristles per drive, K."""
        return self.bristle_reach.shape[1]

    def mass_matrix(self, q: Tensor) -> Tensor:
        """Return the mass matrix M, (..., n, n) [kg m^2, kg m, kg]."""
        return self.equations_at(q).mass

    def gravity(self, q: Tensor) -> Tensor:
        """Return the gravity torque dV/dq, (..., n) [Nm, N]."""
        return self.nonlinear_effects(q, torch.zeros_like(q))

    def nonlinear_effects(self, q: Tensor, qd: Tensor) -> Tensor:
        """Return Coriolis, centrifugal and gravity torque, (..., n) [Nm, N]."""
        chain, momenta = self._bodies(q)
        return applied(momenta, self.chain.accelerations(chain, qd))

    def _bodies(self, q: Tensor) -> tuple[ChainConfiguration, Tensor]:
        """Return the configuration cache at q, (..., n) [rad, m], and d momenta / d qd of the bodies.

        The momentum of each of the B bodies is the matrix T' J, (3, 4), with the body's pseudo-inertia J, (4, 4), and
        the time derivative T', (3, 4), of its homogeneous transform without the constant last row. The 12 B entries of
        the momenta of all bodies are linear in qd; their derivatives with respect to qd are (..., n, 12 B).
        """
        # The kinetic energy of a body is 1/2 tr(T' J T'^T), with T' = dT/dt. The pseudo-inertia J itself is used,
        # without its Cholesky factors, so J may be physically inconsistent. `chain.forward` returns the transforms T
        # times four given points; the columns of the identity as points give T itself.
        chain = self.chain.forward(q, torch.eye(len(self.inertia)).to(q))
        jacobian = torch.unflatten(self.chain.ratios.mT @ chain.jacobian, -1, (3, -1))
        return chain, (jacobian @ self.inertia).flatten(-2)

    def friction_torque(self, q: Tensor, qd: Tensor, z: Tensor | None = None) -> Tensor:
        """Return the sum of friction torque and torque offset, (..., n) [Nm, N], at velocities qd, (..., n).

        z: friction state, (..., n, K) [rad, m]; None: friction depends only on qd. q has no effect.
        """
        past = z.numpy() if z is not None and self.elements else None
        return torch.from_numpy(self.friction(qd.numpy(), past))

    def forward_dynamics(self, q: Tensor, qd: Tensor, tau: Tensor, z: Tensor | None = None) -> Tensor:
        """Return the accelerations qdd, (..., n) [rad/s^2, m/s^2], under the inputs tau, (..., n).

        z: friction state, (..., n, K) [rad, m]; None: friction depends only on qd.
        """
        equations = self.equations_at(q)
        # `solve` broadcasts the batch dimensions of M and tau only if the force is a matrix with one column.
        force = equations.force(qd, tau, z).unsqueeze(-1)
        qdd: Tensor = torch.linalg.solve(equations.mass, force)
        return qdd.squeeze(-1)

    def inverse_dynamics(self, q: Tensor, qd: Tensor, qdd: Tensor, z: Tensor | None = None) -> Tensor:
        """Return the inputs tau, (..., n), that give the accelerations qdd, (..., n).

        A passive joint has no input: its element is the torque that a motor at the joint would need. z: friction state,
        (..., n, K) [rad, m]; None: friction depends only on qd.
        """
        passive = (self.inputs == 0).all(dim=1).double()
        # The row of a passive joint in G is zero, which makes G singular. It is replaced by the row of the identity.
        inverse: Tensor = torch.linalg.inv(self.inputs + torch.diag(passive))
        return self.joint_torque(q, qd, qdd, z) @ inverse.mT

    def joint_torque(self, q: Tensor, qd: Tensor, qdd: Tensor, z: Tensor | None = None) -> Tensor:
        """Return the torques of all joints, passive ones included, (..., n) [Nm, N], that give the accelerations qdd.

        z: friction state, (..., n, K) [rad, m]; None: friction depends only on qd.
        """
        equations = self.equations_at(q)
        return applied(equations.mass, qdd) - equations.force(qd, torch.zeros_like(qdd), z)

    def equations_at(self, q: Tensor) -> MotionEquations:
        """Return the equations of motion M qdd = force at positions q, (T, n) [rad, m]."""
        chain, momenta = self._bodies(q)

        def force(qd: Tensor, tau: Tensor, z: Tensor | None) -> Tensor:
            """Return the force M qdd, (T, n) [Nm, N], at velocities qd, inputs tau and friction state z."""
            bias = applied(momenta, self.chain.accelerations(chain, qd))
            return tau @ self.inputs.mT - bias - self.friction_torque(q, qd, z)

        # `rotors` is the contribution to M of the kinetic energy 1/2 (C qd)^T diag(armature) C qd of the rotors.
        rotors = self.motors.mT @ torch.diag(self.armature) @ self.motors
        mass = momenta @ chain.jacobian.mT @ self.chain.ratios + rotors
        return MotionEquations(mass, force, partial(self.friction_torque, q))

    def memory(self, qd: Tensor) -> Tensor:
        """Return the friction state z, (..., n, K) [rad, m], after a long motion at joint velocities qd, (..., n)."""
        return (qd @ self.motors.mT.to(qd)).sign().unsqueeze(-1) * self.bristle_reach

    def memory_after(self, z: Tensor, displacement: Tensor) -> Tensor:
        """Return the friction state, (..., n, K) [rad, m], after a displacement of the joints, (..., n) [rad, m].

        z is the friction state before the displacement, which has no reversals.
        """
        moved = displacement @ self.motors.mT.to(displacement)
        return moved_bristles(z, moved.unsqueeze(-1), self.bristle_reach)


def identified_dynamics(
    arm: Chain, friction: FrictionModel, parameters: np.ndarray, drives: Drives
) -> RegressorDynamics:
    """Return the dynamics of an arm with the parameters that a least-squares identification has found.

    Args:
        arm: arm of B bodies and n coordinates.
        friction: effects of friction and armature, E in all.
        parameters: (10 B + E n,): inertial parameters, then the coefficients of each effect, in the order of
            ``friction.effects``.
        drives: input matrix (n, n), and matrix (n, n) from joint velocities to motor velocities.
    """
    n, inertial = len(arm.coordinates), 10 * len(arm.bodies)
    constants = parameters[inertial:].reshape(-1, n)
    reach = reach_of(arm.joint_types).values if friction.memory else None

    def torque(qd: np.ndarray, z: np.ndarray | None) -> np.ndarray:
        """Return the friction torque, (..., n) [Nm, N], at velocities qd, (..., n), for a friction state z.

        z: deflections of K bristles per drive, (..., n, K) [rad, m]; None: friction depends only on qd.
        """
        deflection = None if z is None or reach is None else z / reach
        return friction.torque(constants, qd, deflection, drives.speeds)

    return RegressorDynamics(arm, parameters[:inertial], constants[0], torque, drives, reach)
