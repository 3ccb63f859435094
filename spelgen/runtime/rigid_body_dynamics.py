"""Port-Hamiltonian model of an arm of rigid bodies with friction, for the presets closed-form and hybrid."""

from collections.abc import Sequence
from typing import Literal, NamedTuple

import torch
from torch import Tensor, nn

from spelgen.runtime.body_chain import ChainConfiguration, InertialParameters, chain_of_links
from spelgen.runtime.friction_laws import FrictionConstants, FrictionLaws, turning
from spelgen.runtime.motors import MotorInputs, PositionServo
from spelgen.runtime.parts import Configuration, Parameters, Row, Rows, applied
from spelgen.runtime.port_hamiltonian import PortHamiltonian
from spelgen.runtime.rows import Joint, Link, vector


class RigidParameters(NamedTuple):
    """Parameter cache of ``RigidBodyDynamics``: quantities that depend on trained parameters only."""

    points: Tensor  # block diagonal, (4 B, 4 B): a block Q per body, with its pseudo-inertia Q Q^T
    armature: Tensor  # rotor inertia on the joint side, added to M, (n, n)
    friction: FrictionConstants
    residual: Parameters = None  # parameter cache of the residual terms


class RigidConfiguration(NamedTuple):
    """Configuration cache of ``RigidBodyDynamics``: quantities at positions q, (..., n) [rad, m]."""

    chain: ChainConfiguration
    mass: Tensor  # M(q), (..., n, n)
    gravity: Tensor  # dV/dq of the rigid bodies, (..., n) [Nm, N]
    prepared: RigidParameters
    varied: Tensor | float = 1.0  # friction factor of the residual terms, (..., n); 1 without them
    residual: Configuration = None  # configuration cache of the residual terms


class RigidBodyDynamics(PortHamiltonian):
    """Rigid-body model with trained inertial parameters, armature, friction and torque offsets.

    The friction state z, (..., n, K) [rad, m], has the displacements of K bristles per motor, whose elastic
    energy is part of H. Without z, dry friction depends on velocity only.

    Args:
        joints: joints of the arm, in the order of q.
        links: rigid bodies with their initial inertial parameters.
        gravity: gravitational acceleration in the base frame, (3,) [m/s^2].
        friction: friction of all joints, or of all motors if ``motor_speeds`` is given.
        inputs: input matrix G; None: each input drives its own joint.
        motor_speeds: rows of the matrix C, (n, n), for which C qd are the motor speeds; friction, z and
            armature then belong to the motors. None: every motor drives its own joint.
        servo: position servos; None: inputs are torques.
    """

    parameter_groups = (
        ("raw_armature", "armature", "kg m^2, kg"),
        ("raw_offset", "offset", "Nm, N"),
        ("raw_friction_compensation", "friction_compensation", "Nm s/rad, N s/m"),
    )

    motors: Tensor | None
    loads: Tensor | None

    def __init__(
        self,
        *,
        joints: Sequence[Joint],
        links: Sequence[Link],
        gravity: Row,  # gravitational acceleration in the base frame [m/s^2]
        friction: FrictionLaws,
        inputs: MotorInputs | None = None,
        motor_speeds: Rows | None = None,
        servo: PositionServo | None = None,
    ) -> None:
        super().__init__(joints, inputs)
        self.chain, self.bodies = chain_of_links(joints, links, gravity), InertialParameters(links)
        self.friction, self.servo = friction, servo
        self.elements = friction.reach.shape[1]
        self.nominal_armature = nn.Buffer(vector(joint.armature for joint in joints))
        # `actuated`: 1 for an input that drives a joint, else 0 (passive joints have no motor), (n,).
        self.actuated = nn.Buffer(self.input_matrix(self.nominal_armature).any(dim=0).double())
        # `raw_armature`: logarithm of armature / nominal armature, (n,).
        self.raw_armature = nn.Parameter(torch.zeros_like(self.actuated))
        # `raw_offset`: offset of the measured torque, in units of typical friction, (n,).
        self.raw_offset = nn.Parameter(torch.zeros_like(self.actuated))
        # Coefficient of the drives' friction compensation, in units of typical friction / typical speed.
        # It is a buffer, not a parameter: training must not change it; a fit to torques sets it.
        self.raw_friction_compensation = nn.Buffer(torch.zeros_like(self.actuated))
        motors = None if motor_speeds is None else torch.stack([vector(row) for row in motor_speeds])
        # `motors` is C, (n, n), which maps joint speeds to motor speeds. `loads` is C^-1, whose transpose
        # maps joint torques to motor torques.
        self.register_buffer("motors", motors)
        self.register_buffer("loads", None if motors is None else torch.linalg.inv(motors))

    @property
    def input_quantity(self) -> Literal["torque", "position"]:
        """Quantity of the inputs: ``torque``, or ``position`` for commands of position servos."""
        return "torque" if self.servo is None else "position"

    @property
    def inertial_parameters(self) -> Tensor:
        """Inertial parameters (m, m c, Ixx, Ixy, Ixz, Iyy, Iyz, Izz) of each body, (bodies, 10).

        They are in the joint frame of the body [kg, kg m, kg m^2], with the inertia about the frame's origin.
        """
        root = self.bodies.forward()
        row, column = torch.triu_indices(4, 4)
        xx, xy, xz, x, yy, yz, y, zz, z, m = (root @ root.mT)[..., row, column].unbind(dim=-1)
        return torch.stack([m, x, y, z, yy + zz, -xy, -xz, xx + zz, -yz, xx + yy], dim=-1)

    @property
    def armature(self) -> Tensor:
        """Rotor inertia on the joint side, which is added to diag(M), (n,) [kg m^2, kg]."""
        return self.nominal_armature * self.raw_armature.exp()

    @property
    def viscous(self) -> Tensor:
        """Viscous friction coefficient, (n,) [Nm s/rad, N s/m]."""
        return self.friction.prepare().viscous

    @property
    def coulomb(self) -> Tensor:
        """Coulomb friction, (n,) [Nm, N]."""
        return self.friction.prepare().coulomb

    @property
    def torque_offset(self) -> Tensor:
        """Torque offset of the sensors, (n,) [Nm, N]: the measured torque at a true torque of zero."""
        return self.raw_offset * self.friction.nominal * self.actuated

    @property
    def friction_compensation(self) -> Tensor:
        """Coefficient k, (n,) [Nm s/rad, N s/m]: drives apply k qd in addition to the measured torque."""
        return self.raw_friction_compensation * self.friction.nominal / self.friction.speed * self.actuated

    def prepare(self) -> RigidParameters:
        """Return the parameter cache: point masses (see ``BodyChain``), armature and friction constants.

        It depends on the trained parameters only, and is valid until a parameter changes.
        """
        points = torch.ops.aten.block_diag([*self.bodies.forward()])
        armature = torch.diag_embed(self.armature)
        if self.motors is not None:
            armature = self.motors.mT @ armature @ self.motors
        return RigidParameters(points, armature, self.friction.prepare())

    def configuration(self, q: Tensor, prepared: RigidParameters) -> RigidConfiguration:
        """Return the configuration cache at q, (..., n) [rad, m]; prepared: cache from ``prepare``."""
        chain, ratios = self.chain.forward(q, prepared.points), self.chain.ratios
        mass = ratios.mT @ (chain.jacobian @ chain.jacobian.mT) @ ratios + prepared.armature
        return RigidConfiguration(chain, mass, applied(chain.jacobian, chain.weight) @ ratios, prepared)

    def potential_energy(self, q: Tensor | RigidConfiguration, z: Tensor | None = None) -> Tensor:
        """Return the potential energy, (...) [J]: gravity V(q), plus the elastic energy of the bristles.

        V(q) is the sum over the bodies of -m g . c, with mass m, gravity g, and center of mass c in the
        base frame. z: displacements of the bristles, (..., n, K) [rad, m]; None: V(q) only.
        """
        cache: RigidConfiguration = self.at(q)
        energy = (cache.chain.place.flatten(-3) * cache.chain.weight).sum(dim=-1)
        return energy if z is None else energy + cache.prepared.friction.stored_energy(z)

    def gravity(self, q: Tensor | RigidConfiguration) -> Tensor:
        """Return the gravity torque dV/dq, (..., n) [Nm, N]."""
        cache: RigidConfiguration = self.at(q)
        return cache.gravity

    def lagrangian_gradient(self, q: Tensor | RigidConfiguration, qd: Tensor) -> Tensor:
        """Return the gradient of 1/2 qd^T M(q) qd - V(q) with respect to q, (..., n) [Nm, N].

        The armature is a constant part of M and has no effect. qd: velocities, (..., n) [rad/s, m/s].
        """
        cache: RigidConfiguration = self.at(q, qd)
        return self.chain.kinetic_gradient(cache.chain, qd) - cache.gravity

    def nonlinear_effects(self, q: Tensor | RigidConfiguration, qd: Tensor) -> Tensor:
        """Return Coriolis, centrifugal and gravity torque, (..., n) [Nm, N], by d'Alembert's principle."""
        cache: RigidConfiguration = self.at(q, qd)
        return applied(cache.chain.jacobian, self.chain.accelerations(cache.chain, qd)) @ self.chain.ratios

    def _at_motors(self, cache: RigidConfiguration, qd: Tensor) -> tuple[Tensor, Tensor]:
        """Return motor velocities C qd and gravity torques at the motors, C^-T dV/dq, (..., n) each.

        C maps joint velocities to motor velocities. cache: configuration cache at q.
        """
        if self.motors is None or self.loads is None:
            return qd, cache.gravity
        return qd @ self.motors.mT, cache.gravity @ self.loads

    def friction_torque(self, q: Tensor | RigidConfiguration, qd: Tensor, *state: Tensor | None) -> Tensor:
        """Return the friction torque at the joints, C^T f, (..., n) [Nm, N].

        f is the friction of the motors at their velocities C qd; C is the identity without couplings. state:
        friction state z, (..., n, K) [rad, m]; without it, friction depends on velocity only.
        """
        cache: RigidConfiguration = self.at(q, qd)
        torque = cache.varied * cache.prepared.friction.torque(*self._at_motors(cache, qd), *state)
        return torque if self.motors is None else torque @ self.motors

    def dissipation(self, q: Tensor | RigidConfiguration, qd: Tensor) -> Tensor:
        """Return the dissipation matrix D(q, qd), (..., n, n) [Nm s/rad, N s/m].

        D qd is the friction torque without friction state: its dry friction has the sign of the current
        velocity.
        """
        cache: RigidConfiguration = self.at(q, qd)
        friction = cache.prepared.friction
        qd, gravity = self._at_motors(cache, qd)
        dry = friction.dry(qd, gravity) * turning(qd, friction.coulomb_smoothing_velocity)
        matrix = torch.diag_embed(cache.varied * (friction.viscosity(qd) + dry))
        return matrix if self.motors is None else self.motors.mT @ matrix @ self.motors

    def _motor(self, qd: Tensor) -> Tensor:
        """Return motor velocities (or displacements), (..., n), from joint velocities (or displacements)."""
        return qd if self.motors is None else qd @ self.motors.mT

    def memory(self, qd: Tensor) -> Tensor:
        """Return the displacements z of the bristles after a long motion at constant qd.

        z, (..., n, K) [rad, m], for K bristles per motor, is the initial friction state of simulations if
        the past motion is unknown. qd: joint velocities, (..., n) [rad/s, m/s]. z is the break-away
        displacement times tanh(x), with x = motor velocity / smoothing velocity; the motor velocities are
        qd, or C qd for coupled motors. Friction without a state has the factor x / sqrt(1 + x^2) in place
        of tanh(x): the difference is at most 7.4 % of dry friction, at x = 1.6, and vanishes at high
        velocities.
        """
        # z is tanh(qd / smoothing velocity) times the break-away displacement: tanh reaches 1 at a few times
        # the smoothing velocity. The smooth sign of ``FrictionConstants.torque`` reaches 1 slowly: with it, z
        # would start slightly off the break-away displacement, which causes a stiff transient.
        direction = (self._motor(qd) / self.friction.prepare().coulomb_smoothing_velocity).tanh()
        return direction.unsqueeze(-1) * self.friction.reach

    def memory_rate(self, z: Tensor, qd: Tensor) -> Tensor:
        """Return dz/dt of the friction state z, (..., n, K): the motor velocity, or 0 if the bristle slides.

        A bristle slides if it is at its break-away displacement and the velocity would increase the
        displacement. z: (..., n, K) [rad, m]. qd: joint velocities, (..., n) [rad/s, m/s].
        """
        qd = self._motor(qd).unsqueeze(-1)
        return qd * (qd.sign() * z < self.friction.reach)

    def memory_after(self, z: Tensor, displacement: Tensor) -> Tensor:
        """Return the friction state, (..., n, K) [rad, m], after a joint displacement, (..., n) [rad, m].

        z is the friction state before the displacement. The result is exact for a displacement without
        reversals.
        """
        moved = z + self._motor(displacement).unsqueeze(-1)
        return moved.clamp(-self.friction.reach, self.friction.reach)

    def input_force(self, cache: RigidConfiguration, qd: Tensor, tau: Tensor) -> Tensor:
        """Return the generalized force G (tau - b) + k qd of the inputs tau, (..., n) [Nm, N].

        G is the input matrix, b the torque offset of the sensors, k the friction compensation of the drives.
        cache: configuration cache at q.
        """
        return super().input_force(cache, qd, tau - self.torque_offset) + self.friction_compensation * qd
