"""Residual terms that are added to rigid bodies.

The terms are functions of the position of one joint, and networks that depend on several positions.
"""

import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from spelgen.runtime.networks import JointEncoding, MaskedNetwork
from spelgen.runtime.parts import Entries, Intermediates, Layers
from spelgen.runtime.port_hamiltonian import applied
from spelgen.runtime.rigid_body_dynamics import RigidBodyDynamics, RigidConfiguration, RigidParameters
from spelgen.runtime.rows import Joint, vector

# Number of cubic B-splines over the range of a joint.
SPLINES = 34
# Number of ripple harmonics per revolution of the joint. For a gear ratio above this number, there are also
# the first two harmonics of the motor's revolution, which represent gear teeth and motor poles.
HARMONICS = 64
# Largest magnitude of the logarithm of the friction factor: the factor is between 0.1 and 10.
LARGEST = math.log(10.0)


class ResidualParameters(NamedTuple):
    """Parameter cache of ``ResidualTerms``: quantities that depend on trained parameters only."""

    splines: Tensor  # coefficients of torque [Nm, N] and of log friction factor, (n, SPLINES, 2)
    ripple: Tensor  # amplitudes of cosines, then sines [Nm], (n, 2 HARMONICS + 4)
    constant: Tensor  # part of R that does not depend on q, flattened, (n n,)
    functions: Tensor  # matrix by which each tanh output is multiplied in R, (functions, n n)
    mass: Layers | None
    potential: Layers | None


class ResidualConfiguration(NamedTuple):
    """Configuration cache of ``ResidualTerms``: quantities at positions q, (..., n) [rad, m]."""

    q: Tensor
    encoded: Tensor  # encoded positions, the inputs of the networks, see ``JointEncoding``
    torque: Tensor  # dV/dq due to functions of single joints, (..., n) [Nm, N]
    friction: Tensor  # factor on friction, (..., n)
    mass: Tensor  # R(q), the residual term of M, (..., n, n)
    slope: Tensor | None  # d tanh(y) / dy for the outputs y of R's network, (..., functions)
    intermediates: Intermediates  # intermediate values of R's network, for derivatives
    parameters: ResidualParameters


class ResidualTerms(nn.Module):
    """Residual terms: R(q) is added to M, terms are added to V, and friction is multiplied by a factor.

    Torque: dV/dq of each joint has a term that depends on the joint's position only, a sum of cubic B-splines
    over the range of the joint. A revolute joint has in addition harmonics of its rotation, and of its
    motor's rotation. Friction: the factor of a joint is the exponential of another sum of splines, between
    0.1 and 10. The splines fall to zero within three knot spacings beyond the range.

    Mass: R is ``entries(*functions, *constants)``, with ``entries`` a function in the emitted module. A
    function is a bound times the tanh of an output of ``network``; a constant is a bound times the tanh of a
    parameter. The ``bounds`` make armature + R positive definite for all q and all parameters. Potential:
    ``potential_scale`` [J] times the output of the network ``potential`` is added to V.

    If all parameters are zero, R and the terms of V are zero, and the factor of friction is one.
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
        # The range is divided into SPLINES - 3 intervals of length `spacing`. A spline has its middle at each
        # end of an interval, and one interval beyond each end of the range.
        spacing = 2 * vector(joint.half_range for joint in joints).unsqueeze(-1) / (SPLINES - 3)
        knots = torch.arange(SPLINES).double() - (SPLINES - 1) / 2
        self.spacing = nn.Buffer(spacing)
        center = vector(joint.center for joint in joints).unsqueeze(-1)
        self.middles = nn.Buffer(center + spacing * knots)
        self.unit = nn.Buffer(vector(joint.friction for joint in joints).unsqueeze(-1))
        self.revolute = nn.Buffer(vector(joint.joint_type == "revolute" for joint in joints).unsqueeze(-1))
        # Number of ripple periods per revolution of the joint, (n, HARMONICS + 2).
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
        # 1 / |coefficient| of each function and constant in each entry of M, (functions + constants, n, n).
        # It is 1e30 for a zero coefficient, so that the minimum in `bounds` ignores this entry.
        self.inverse = nn.Buffer(torch.where(size > 0, 1 / size, 1e30))
        # R may reduce the armature by at most 90 %. The bound of each term is an equal share of this: 0.9
        # divided by the largest number of functions and constants in one row of M.
        self.part = 0.9 / float((size > 0).sum(dim=(0, 2)).max())
        self.raw_constants = nn.Parameter(torch.zeros(constants, dtype=torch.float64))

    def _by_entry(self, sizes: Tensor) -> Tensor:
        """Return the contribution to M, (functions + constants, n, n), of each function and constant.

        sizes: values of the functions and constants, (functions + constants,).
        """
        rows = torch.diag(sizes).unbind()
        return self.entries(*rows)

    def bounds(self, armature: Tensor) -> Tensor:
        """Return the largest magnitudes of the functions and constants in R, (functions + constants,).

        armature: matrix A, (n, n). With these bounds, A + R is positive definite, since it is the sum of A -
        diag(d) and diag(d) + R, with d = 1 / (row sums of |A^-1|). The first is positive semi-definite. The
        second is positive definite if all row sums of |R| / sqrt(d d^T) are less than one. Both statements
        follow from diagonal dominance.
        """
        root = torch.linalg.inv(armature).abs().sum(dim=-1).rsqrt()
        smallest: Tensor = (root.unsqueeze(-1) * root * self.inverse).amin(dim=(-2, -1))
        return self.part * smallest

    def friction_logarithms(self) -> Tensor:
        """Return the spline coefficients of the friction factor's logarithm, (n, SPLINES)."""
        return LARGEST * (self.raw_friction_splines / LARGEST).tanh()

    def prepare(self, armature: Tensor) -> ResidualParameters:
        """Return the parameter cache: quantities that depend on parameters only; armature: matrix, (n, n)."""
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
        """Return the quantities that depend on q only (configuration cache); q: (..., n) [rad, m]."""
        encoded = self.encoding.forward(q)
        splines = torch.einsum("...ik,ikm->...im", self.splines(q), parameters.splines)
        # Torque and friction factor have the same splines: both sums are one product.
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
        """Return the residual terms of V, (...) [J].

        The energy of a B-spline is the integral of its torque from the middle of the spline to q.
        """
        distance = self._distances(cache.q)
        size = distance.abs()
        # Integral of a B-spline of unit spacing from its middle to the distance `size`.
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
        """Return d/dq of the residual terms of 1/2 qd^T M(q) qd - V(q), (..., n) [Nm, N]."""
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
        """Return the contribution to ``nonlinear_effects``: dR/dt qd - ``gradient``, (..., n) [Nm, N]."""
        if self.mass is None or cache.slope is None:
            return -self.gradient(cache, qd)
        rate = self.mass.jvp(cache.intermediates, self.encoding.jvp(cache.encoded, qd))
        mass_rate = ((cache.slope * rate) @ cache.parameters.functions).reshape(*qd.shape, self.n)
        return applied(mass_rate, qd) - self.gradient(cache, qd)

    def splines(self, q: Tensor) -> Tensor:
        """Return the values of the cubic B-splines at q, (..., n, SPLINES); their maximum is 2/3."""
        # At the distance d >= 0 from its middle, a cubic B-spline of unit spacing is (max(2 - d, 0)^3 - 4
        # max(1 - d, 0)^3) / 6.
        wide = (2 - self._distances(q).abs()).relu()
        return torch.sub(wide**3, (wide - 1).relu() ** 3, alpha=4) / 6

    def waves(self, q: Tensor) -> Tensor:
        """Return cos(f q) for all frequencies f, then sin(f q), (..., n, 2 HARMONICS + 4)."""
        phase = q.unsqueeze(-1) * self.frequencies
        return torch.cat([phase.cos(), phase.sin()], dim=-1)

    def _distances(self, q: Tensor) -> Tensor:
        """Return q minus the middle of each spline (signed), in knot spacings, (..., n, SPLINES)."""
        return (q.unsqueeze(-1) - self.middles) / self.spacing


class ResidualDynamics(RigidBodyDynamics):
    """Rigid bodies with residual terms in M, V and friction; ``residuals`` is None after their removal."""

    residuals: ResidualTerms | None

    def __init__(self, *, residuals: ResidualTerms, **rigid: Any) -> None:
        super().__init__(**rigid)
        self.residuals = residuals

    def prepare(self) -> RigidParameters:
        """Return the parameter cache, which is valid until a parameter changes."""
        prepared = super().prepare()
        if self.residuals is None:
            return prepared
        return prepared._replace(residual=self.residuals.prepare(prepared.armature))

    def configuration(self, q: Tensor, prepared: RigidParameters) -> RigidConfiguration:
        """Return the configuration cache at q, (..., n) [rad, m]; M in the cache includes the residual R."""
        cache = super().configuration(q, prepared)
        if self.residuals is None:
            return cache
        residual = self.residuals.at(q, prepared.residual)
        return cache._replace(mass=cache.mass + residual.mass, varied=residual.friction, residual=residual)

    def potential_energy(self, q: Tensor | RigidConfiguration, z: Tensor | None = None) -> Tensor:
        """Return the sum of V(q) and the elastic energy of the bristles, (...) [J]."""
        cache: RigidConfiguration = self.at(q)
        energy = super().potential_energy(cache, z)
        return energy if self.residuals is None else energy + self.residuals.energy(cache.residual)

    def gravity(self, q: Tensor | RigidConfiguration) -> Tensor:
        """Return dV/dq, (..., n) [Nm, N]."""
        cache: RigidConfiguration = self.at(q)
        if self.residuals is None:
            return cache.gravity
        return cache.gravity - self.residuals.gradient(cache.residual, 0 * cache.gravity)

    def lagrangian_gradient(self, q: Tensor | RigidConfiguration, qd: Tensor) -> Tensor:
        """Return d/dq of 1/2 qd^T M(q) qd - V(q), (..., n)."""
        cache: RigidConfiguration = self.at(q, qd)
        gradient = super().lagrangian_gradient(cache, qd)
        return gradient if self.residuals is None else gradient + self.residuals.gradient(cache.residual, qd)

    def nonlinear_effects(self, q: Tensor | RigidConfiguration, qd: Tensor) -> Tensor:
        """Return Coriolis, centrifugal and gravity torque, (..., n)."""
        cache: RigidConfiguration = self.at(q, qd)
        torque = super().nonlinear_effects(cache, qd)
        return torque if self.residuals is None else torque + self.residuals.nonlinear(cache.residual, qd)
