"""Residual terms: corrections that are added to M(q), V(q) and friction of a rigid-body model.

Splines and harmonics of one joint's position add torques to dV/dq and change friction. Networks that depend
on the positions of several joints add terms to M(q) and V(q).
"""

import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from spelgen.runtime.networks import JointEncoding, MaskedNetwork
from spelgen.runtime.parts import Entries, Intermediates, Layers, applied
from spelgen.runtime.rigid_body_dynamics import RigidBodyDynamics, RigidConfiguration, RigidParameters
from spelgen.runtime.rows import Joint, vector

# Number of cubic B-splines over the range of a joint, for its torque term and its friction factor.
SPLINES = 34
# The torque ripple of each joint has HARMONICS + 2 harmonics. With a gear ratio above HARMONICS, they are
# the harmonics 1 to HARMONICS of the joint's revolution, and the harmonics 1 and 2 of the motor's
# revolution, which represent errors of gear and motor. With a smaller gear ratio, they are the harmonics
# 1 to HARMONICS + 2 of the joint's revolution.
HARMONICS = 64
# Largest magnitude of the logarithm of the friction factor, so that the factor is between 0.1 and 10.
LARGEST = math.log(10.0)


class ResidualParameters(NamedTuple):
    """Parameter cache of ``ResidualTerms``: quantities that depend on trained parameters only."""

    splines: Tensor  # spline coefficients of torque [Nm, N] and of log friction factor, (n, SPLINES, 2)
    ripple: Tensor  # amplitudes of HARMONICS + 2 cosines, then of the sines [Nm], (n, 2 (HARMONICS + 2))
    constant: Tensor  # constant part of the residual R of M, flattened, (n n,)
    functions: Tensor  # flattened matrices dR / d tanh(output) of R's network, (functions, n n)
    mass: Layers | None
    potential: Layers | None


class ResidualConfiguration(NamedTuple):
    """Configuration cache of ``ResidualTerms``: quantities at positions q, (..., n) [rad, m]."""

    q: Tensor
    encoded: Tensor  # encoding of q, the input of the networks, (..., 2 n), see ``JointEncoding``
    torque: Tensor  # dV/dq of splines and harmonics, each of one joint, (..., n) [Nm, N]
    friction: Tensor  # factor by which the friction of each joint is multiplied, (..., n)
    mass: Tensor  # R(q), the residual term of M, (..., n, n)
    slope: Tensor | None  # d tanh(y) / dy for the outputs y of the network of R, (..., functions)
    intermediates: Intermediates  # intermediate values of R's network, for derivatives
    parameters: ResidualParameters


class ResidualTerms(nn.Module):
    """Residual terms of a rigid-body model: R(q) is added to M, terms to V, and friction gets a factor.

    Torque: a term that depends on the joint's own position only is added to dV/dq of each joint: a sum of
    cubic B-splines over the range of the joint and, for a revolute joint, harmonics of its rotation and of
    its motor's rotation (torque ripple).

    Friction: the friction of a joint is multiplied by a factor between 0.1 and 10, the exponential of another
    sum of splines in the joint's position. The splines fall to zero within three knot spacings beyond the
    range.

    Mass: R is linear in learned functions of q and in trained constants: ``entries(*functions, *constants)``,
    where ``entries`` places them in the matrix according to the structure of the arm's M. A function is a
    bound times the tanh of an output of ``network``; a constant is a bound times the tanh of a trained
    parameter. The ``bounds`` make armature + R positive definite for all q and all parameters.

    Potential: ``potential_scale`` [J] times the output of the network ``potential`` is added to V.

    If all trained parameters are zero, R and the terms of V are zero, and the friction factor is one.
    """

    parameter_groups = (
        ("raw_torque_splines", "torque_splines", "Nm, N"),
        ("raw_torque_ripple", "torque_ripple", "Nm"),
        ("raw_friction_splines", "friction_splines", "1"),
        ("raw_constants", "mass_residuals", "kg m^2, kg m, kg"),
    )

    def __init__(
        self,
        joints: Sequence[Joint],
        entries: Entries,
        *,
        functions: int,
        constants: int,
        network: MaskedNetwork | None = None,
        potential: MaskedNetwork | None = None,
        potential_scale: float = 1.0,
    ) -> None:
        super().__init__()
        n = len(joints)
        zeros = torch.zeros(n, SPLINES, dtype=torch.float64)
        self.encoding = JointEncoding(joints)
        # The range of a joint is divided into SPLINES - 3 intervals of length `spacing`. The splines have
        # their middles at the ends of the intervals, and one interval beyond each end of the range.
        spacing = 2 * vector(joint.half_range for joint in joints).unsqueeze(-1) / (SPLINES - 3)
        knots = torch.arange(SPLINES).double() - (SPLINES - 1) / 2
        self.spacing = nn.Buffer(spacing)
        center = vector(joint.center for joint in joints).unsqueeze(-1)
        self.middles = nn.Buffer(center + spacing * knots)
        self.unit = nn.Buffer(vector(joint.friction for joint in joints).unsqueeze(-1))
        self.revolute = nn.Buffer(vector(joint.joint_type == "revolute" for joint in joints).unsqueeze(-1))
        # `frequencies`: numbers of ripple periods per revolution of the joint, (n, HARMONICS + 2): 1, 2,
        # ..., HARMONICS + 2. If the gear ratio ``gear`` of a joint exceeds HARMONICS, the last two are
        # gear and 2 gear: one and two periods per revolution of the motor.
        frequencies = torch.arange(1.0, HARMONICS + 3).double().repeat(n, 1)
        for index, joint in enumerate(joints):
            if joint.gear > HARMONICS:
                frequencies[index, HARMONICS:] = vector((joint.gear, 2 * joint.gear))
        self.frequencies = nn.Buffer(frequencies)
        self.raw_torque_splines = nn.Parameter(zeros.clone())
        self.raw_torque_ripple = nn.Parameter(torch.zeros(n, 2 * (HARMONICS + 2), dtype=torch.float64))
        self.raw_friction_splines = nn.Parameter(zeros)
        self.n, self.functions, self.entries = n, functions, entries
        self.mass, self.potential = network, potential
        self.scale = nn.Buffer(torch.full((1, 1), potential_scale, dtype=torch.float64))
        size = self._by_entry(torch.ones(functions + constants, dtype=torch.float64)).abs()
        # R is the residual part of M: each entry is a sum of functions and constants times coefficients.
        # `inverse`, (functions + constants, n, n): 1 / |coefficient| of each function and constant in
        # each entry. `bounds` bounds a function or constant by a minimum over the entries; 1e30 for a
        # coefficient of zero has no influence on the minimum.
        self.inverse = nn.Buffer(torch.where(size > 0, 1 / size, 1e30))
        # R may reduce the armature by at most 90 %, so that armature + R is positive definite. A term of
        # R is a function or constant times its coefficient. The terms in a row of R add up, so each may
        # reduce the armature by the fraction `part` only: 0.9 divided by the largest number of terms in a
        # row.
        self.part = 0.9 / float((size > 0).sum(dim=(0, 2)).max())
        self.raw_constants = nn.Parameter(torch.zeros(constants, dtype=torch.float64))

    def _by_entry(self, sizes: Tensor) -> Tensor:
        """Return the part of R (added to M) due to each of its F functions and constants, (F, n, n).

        sizes: values of the functions, then of the constants, (F,) [kg m^2, kg m, kg].
        """
        rows = torch.diag(sizes).unbind()
        return self.entries(*rows)

    def bounds(self, armature: Tensor) -> Tensor:
        """Return bounds of the functions and constants in R, (functions + constants,), with A + R > 0.

        R is the residual term of M: R_ij = sum_k c_ijk x_k, with the functions and constants x_k and
        their coefficients c_ijk. A + R is positive definite if no |x_k| exceeds its bound

            |x_k| <= part * min_ij sqrt(d_i d_j) / |c_ijk|,    1 / d_i = sum_j |A^-1|_ij,

        where ``part`` = 0.9 / (largest number of terms in a row of R).

        Proof: A + R = (A - D) + (D + R) with D = diag(d). D^-1 - A^-1 is diagonally dominant, so D^-1 >=
        A^-1 and A - D >= 0. The bounds give sum_j |R_ij| / sqrt(d_i d_j) <= 0.9 for each row i: D^(-1/2)
        (D + R) D^(-1/2), which is the identity plus a matrix with these row sums, is strictly diagonally
        dominant, and D + R > 0.

        Args:
            armature: matrix A, (n, n): rotor inertia on the joint side.
        """
        root = torch.linalg.inv(armature).abs().sum(dim=-1).rsqrt()
        smallest: Tensor = (root.unsqueeze(-1) * root * self.inverse).amin(dim=(-2, -1))
        return self.part * smallest

    def friction_logarithms(self) -> Tensor:
        """Return spline coefficients, (n, SPLINES), of the log of the position-dependent friction factor."""
        return LARGEST * (self.raw_friction_splines / LARGEST).tanh()

    def prepare(self, armature: Tensor) -> ResidualParameters:
        """Return the parameter cache: quantities that depend on trained parameters only.

        armature: rotor inertia on the joint side, (n, n). The functions and constants in R, the residual
        part of M, get upper bounds that make armature + R positive definite (see ``bounds``).
        """
        splines = [self.unit * self.raw_torque_splines, self.friction_logarithms()]
        rows = self._by_entry(self.bounds(armature)).flatten(1)
        functions, constants = rows.tensor_split((self.functions,))
        mass = potential = None
        if self.mass is not None:
            identity = torch.eye(self.functions, dtype=rows.dtype, device=rows.device)
            mass = self.mass.prepare(identity, rows.new_zeros(self.functions))
        if self.potential is not None:
            potential = self.potential.prepare(self.scale, 0 * self.scale[0])
        return ResidualParameters(
            splines=torch.stack(splines, dim=-1),
            ripple=self.unit * self.revolute * self.raw_torque_ripple,
            constant=self.raw_constants.tanh() @ constants,
            functions=functions,
            mass=mass,
            potential=potential,
        )

    def at(self, q: Tensor, parameters: ResidualParameters) -> ResidualConfiguration:
        """Return the configuration cache: the residual terms' values at positions q, (..., n) [rad, m].

        parameters: parameter cache from ``prepare``.
        """
        encoded = self.encoding.forward(q)
        splines = torch.einsum("...ik,ikm->...im", self.splines(q), parameters.splines)
        # The torque term and the log friction factor are sums of the same splines: one product gives both.
        smooth, friction = splines.unbind(-1)
        torque = smooth + (self.waves(q) * parameters.ripple).sum(dim=-1)
        mass, slope, intermediates = parameters.constant.expand(*q.shape[:-1], -1), None, None
        if self.mass is not None and parameters.mass is not None:
            y, intermediates = self.mass.forward(encoded, parameters.mass)
            # tanh bounds the outputs, so that armature + R is positive definite, see ``bounds``.
            output = y.tanh()
            mass = F.linear(output, parameters.functions.mT, parameters.constant)
            slope = 1 - output * output
        mass = mass.reshape(*q.shape, self.n)
        friction = friction.exp()
        return ResidualConfiguration(q, encoded, torque, friction, mass, slope, intermediates, parameters)

    def energy(self, cache: ResidualConfiguration) -> Tensor:
        """Return the sum of the residual terms of the potential energy V, (...) [J].

        cache: configuration cache at q. The energy of a B-spline is the integral of its torque from the
        middle of the spline to q.
        """
        distance = self._distances(cache.q)
        size = distance.abs()
        # `step`: integral of a cubic B-spline of unit knot spacing from its middle to the distance `size`.
        step = 0.5 - (2 - size).relu() ** 4 / 24 + (1 - size).relu() ** 4 / 6
        smooth = (self.spacing * distance.sign() * step * cache.parameters.splines[..., 0]).sum(dim=-1)
        # The integral of cos(f q) is sin(f q) / f, the integral of sin(f q) is -cos(f q) / f.
        by_cos, by_sin = (self.waves(cache.q) / self.frequencies.repeat(1, 2)).chunk(2, dim=-1)
        ripple = (torch.cat([by_sin, -by_cos], dim=-1) * cache.parameters.ripple).sum(dim=-1)
        energy = (smooth + ripple).sum(dim=-1)
        if self.potential is not None and cache.parameters.potential is not None:
            energy = energy + self.potential.forward(cache.encoded, cache.parameters.potential)[0].squeeze(-1)
        return energy

    def gradient(self, cache: ResidualConfiguration, qd: Tensor) -> Tensor:
        """Return d/dq of the residual terms of 1/2 qd^T M(q) qd - V(q), (..., n) [Nm, N].

        cache: configuration cache at q. qd: velocities, (..., n) [rad/s, m/s].
        """
        by_encoded = torch.zeros_like(cache.encoded)
        if self.mass is not None and cache.slope is not None:
            # Reverse mode for 1/2 qd^T R qd: its gradient with respect to R is 1/2 qd qd^T, which is
            # multiplied by the Jacobians of the linear map, of tanh and of the network.
            kinetic = 0.5 * (qd.unsqueeze(-1) * qd.unsqueeze(-2)).flatten(-2) @ cache.parameters.functions.mT
            by_encoded = self.mass.vjp(cache.intermediates, cache.slope * kinetic)
        if self.potential is not None and cache.parameters.potential is not None:
            intermediates = self.potential.forward(cache.encoded, cache.parameters.potential)[1]
            by_encoded = by_encoded - self.potential.vjp(intermediates, qd.new_ones(1))
        return self.encoding.vjp(cache.encoded, by_encoded) - cache.torque

    def nonlinear(self, cache: ResidualConfiguration, qd: Tensor) -> Tensor:
        """Return the contribution of residual terms to Coriolis, centrifugal and gravity torque, (..., n).

        It is dR/dt qd - g [Nm, N]. R is the residual term of M, and g, from ``gradient``, is d/dq of the
        residual terms of 1/2 qd^T M qd - V. cache: configuration cache at q. qd: velocities, (..., n).
        """
        if self.mass is None or cache.slope is None:
            return -self.gradient(cache, qd)
        rate = self.mass.jvp(cache.intermediates, self.encoding.jvp(cache.encoded, qd))
        mass_rate = ((cache.slope * rate) @ cache.parameters.functions).reshape(*qd.shape, self.n)
        return applied(mass_rate, qd) - self.gradient(cache, qd)

    def splines(self, q: Tensor) -> Tensor:
        """Return the values of the cubic B-splines of each joint at q, (..., n, SPLINES), at most 2/3."""
        # At the distance d >= 0 from its middle, a cubic B-spline of unit spacing is (max(2 - d, 0)^3 - 4
        # max(1 - d, 0)^3) / 6.
        wide = (2 - self._distances(q).abs()).relu()
        return torch.sub(wide**3, (wide - 1).relu() ** 3, alpha=4) / 6

    def waves(self, q: Tensor) -> Tensor:
        """Return cos(f q) for all ripple frequencies f of each joint, then sin(f q).

        The shape is (..., n, 2 HARMONICS + 4). f is the number of periods per revolution of the joint: 1, 2,
        ..., HARMONICS + 2. If the gear ratio exceeds HARMONICS, the last two are the gear ratio and twice the
        gear ratio. A weighted sum of these functions is the torque ripple of a joint.
        """
        phase = q.unsqueeze(-1) * self.frequencies
        return torch.cat([phase.cos(), phase.sin()], dim=-1)

    def _distances(self, q: Tensor) -> Tensor:
        """Return q minus the middle of each spline (signed), in knot spacings, (..., n, SPLINES)."""
        return (q.unsqueeze(-1) - self.middles) / self.spacing


class ResidualDynamics(RigidBodyDynamics):
    """Rigid-body model with residual terms in M, V and friction.

    residuals: the residual terms. None after a fit has removed them: the model is then rigid bodies only.
    """

    residuals: ResidualTerms | None

    def __init__(self, *, residuals: ResidualTerms, **rigid: Any) -> None:
        super().__init__(**rigid)
        self.residuals = residuals

    def prepare(self) -> RigidParameters:
        """Return the parameter cache of rigid bodies, friction and residual terms.

        It depends on the trained parameters only, and is valid until a parameter changes.
        """
        prepared = super().prepare()
        if self.residuals is None:
            return prepared
        return prepared._replace(residual=self.residuals.prepare(prepared.armature))

    def configuration(self, q: Tensor, prepared: RigidParameters) -> RigidConfiguration:
        """Return the configuration cache at q, (..., n) [rad, m], in which M includes the residual R(q).

        prepared: cache from ``prepare``.
        """
        cache = super().configuration(q, prepared)
        if self.residuals is None:
            return cache
        residual = self.residuals.at(q, prepared.residual)
        return cache._replace(mass=cache.mass + residual.mass, varied=residual.friction, residual=residual)

    def potential_energy(self, q: Tensor | RigidConfiguration, z: Tensor | None = None) -> Tensor:
        """Return V(q) with residual terms, plus the elastic energy of the bristles at z, (...) [J].

        z: friction state, (..., n, K) [rad, m]; None: V(q) only.
        """
        cache: RigidConfiguration = self.at(q)
        energy = super().potential_energy(cache, z)
        return energy if self.residuals is None else energy + self.residuals.energy(cache.residual)

    def gravity(self, q: Tensor | RigidConfiguration) -> Tensor:
        """Return dV/dq, (..., n) [Nm, N]: the sum of the gravity torque and of the residual terms' torque."""
        cache: RigidConfiguration = self.at(q)
        if self.residuals is None:
            return cache.gravity
        return cache.gravity - self.residuals.gradient(cache.residual, 0 * cache.gravity)

    def lagrangian_gradient(self, q: Tensor | RigidConfiguration, qd: Tensor) -> Tensor:
        """Return the gradient of 1/2 qd^T M(q) qd - V(q) with respect to q, (..., n) [Nm, N].

        M and V include the residual terms. qd: velocities, (..., n) [rad/s, m/s].
        """
        cache: RigidConfiguration = self.at(q, qd)
        gradient = super().lagrangian_gradient(cache, qd)
        return gradient if self.residuals is None else gradient + self.residuals.gradient(cache.residual, qd)

    def nonlinear_effects(self, q: Tensor | RigidConfiguration, qd: Tensor) -> Tensor:
        """Return Coriolis, centrifugal and gravity torque with residual terms, (..., n) [Nm, N]."""
        cache: RigidConfiguration = self.at(q, qd)
        torque = super().nonlinear_effects(cache, qd)
        return torque if self.residuals is None else torque + self.residuals.nonlinear(cache.residual, qd)
