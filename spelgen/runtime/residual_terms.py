"""Residual terms: functions of single joints, and networks of several joints, in addition to rigid bodies."""

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

# Number of B-splines over the range of a joint.
SPLINES = 34
# Harmonics of a revolution of the joint; two more belong to a revolution of the motor (teeth and poles).
HARMONICS = 64
# Bound of the logarithm of the friction factor: the factor stays between 0.1 and 10.
LARGEST = math.log(10.0)


class ResidualParameters(NamedTuple):
    """All that depends on the parameters only."""

    splines: Tensor  # coefficients of the torque [Nm, N] and of the friction factor, (n, SPLINES, 2)
    ripple: Tensor  # amplitudes [Nm], (n, 2 HARMONICS + 4)
    constant: Tensor  # contribution of the constants to M, (n n,)
    functions: Tensor  # largest contribution of each function to M, (functions, n n)
    mass: Layers | None
    potential: Layers | None


class ResidualConfiguration(NamedTuple):
    """All that depends on q only."""

    q: Tensor
    encoded: Tensor
    torque: Tensor  # dV/dq of the functions of single joints, (..., n) [Nm, N]
    friction: Tensor  # the factor on friction, (..., n)
    mass: Tensor  # R(q), (..., n, n)
    slope: Tensor | None  # derivative of the functions of R with respect to the outputs of the network
    intermediates: Intermediates  # of the derivatives of these outputs
    parameters: ResidualParameters


class ResidualTerms(nn.Module):
    """A residual R(q) of M, terms of V, and a factor on friction: zero, zero and one for zero parameters.

    For each joint: a torque dV/dq, the sum of cubic B-splines over its range and, if it is revolute, of
    harmonics of a revolution of the joint and of its motor, in units of typical friction; and a factor on
    friction, the exponential of such a spline, between 0.1 and 10. Splines are zero at the ends of the range.

    R is ``entries(*functions, *constants)``; a network ``potential`` in units of ``potential_scale`` [J] is
    added to V. Each function is a bound times the tanh of an output of ``network``, each constant a bound
    times the tanh of a parameter: the ``bounds`` make armature + R positive definite for all q and all
    parameters.
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
        # The range has SPLINES - 3 intervals; the middles of the outermost splines are one spacing beyond
        # it.
        spacing = 2 * vector(joint.half_range for joint in joints).unsqueeze(-1) / (SPLINES - 3)
        knots = torch.arange(SPLINES).double() - (SPLINES - 1) / 2
        self.spacing = nn.Buffer(spacing)
        center = vector(joint.center for joint in joints).unsqueeze(-1)
        self.middles = nn.Buffer(center + spacing * knots)
        self.unit = nn.Buffer(vector(joint.friction for joint in joints).unsqueeze(-1))
        self.revolute = nn.Buffer(vector(joint.joint_type == "revolute" for joint in joints).unsqueeze(-1))
        # periods of the ripple per revolution of the joint, (n, HARMONICS + 2)
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
        # one divided by the coefficient of each function and constant in an entry; no bound if it is zero
        self.inverse = nn.Buffer(torch.where(size > 0, 1 / size, 1e30))
        # at most 90 % of the armature may be subtracted
        self.part = 0.9 / float((size > 0).sum(dim=(0, 2)).max())  # divided among all terms in a row of M
        self.raw_constants = nn.Parameter(torch.zeros(constants, dtype=torch.float64))

    def _by_entry(self, sizes: Tensor) -> Tensor:
        """Return the contribution of each function and constant to M, (functions + constants, n, n)."""
        rows = torch.diag(sizes).unbind()
        return self.entries(*rows)

    def bounds(self, armature: Tensor) -> Tensor:
        """Return the bounds of functions and constants, (functions + constants,), for an armature (n, n).

        armature - diag(d) is positive semi-definite for d = 1 / (row sums of |armature^-1|), and so is
        diag(d) - R if no row of |R| / sqrt(d d^T) has a sum above one: both by diagonal dominance.
        """
        root = torch.linalg.inv(armature).abs().sum(dim=-1).rsqrt()
        smallest: Tensor = (root.unsqueeze(-1) * root * self.inverse).amin(dim=(-2, -1))
        return self.part * smallest

    def friction_logarithms(self) -> Tensor:
        """Return the spline coefficients of the logarithm of the friction factor, (n, SPLINES)."""
        return LARGEST * (self.raw_friction_splines / LARGEST).tanh()

    def prepare(self, armature: Tensor) -> ResidualParameters:
        """Return the parameter cache, for an armature matrix (n, n)."""
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
        """Return all that depends on q, (..., n), only."""
        encoded = self.encoding.forward(q)
        splines = torch.einsum("...ik,ikm->...im", self.splines(q), parameters.splines)
        # Both kinds of splines have the same basis: one product for torque and friction factor.
        smooth, friction = splines.unbind(-1)
        torque = smooth + (self.waves(q) * parameters.ripple).sum(dim=-1)
        mass, slope, intermediates = parameters.constant.expand(*q.shape[:-1], -1), None, None
        if self.mass is not None and parameters.mass is not None:
            y, intermediates = self.mass.forward(encoded, parameters.mass)
            # Bounded outputs keep M + R positive definite, see ``bounds``.
            output = y.tanh()
            mass = F.linear(output, parameters.functions.mT, parameters.constant)
            slope = 1 - output * output
        mass = mass.reshape(*q.shape, self.n)
        friction = friction.exp()
        return ResidualConfiguration(q, encoded, torque, friction, mass, slope, intermediates, parameters)

    def energy(self, cache: ResidualConfiguration) -> Tensor:
        """Return the residual of V, (...) [J]; the energy of each spline is zero in its middle."""
        distance = self._distances(cache.q)
        size = distance.abs()
        # integral of the B-spline from its middle
        step = 0.5 - (2 - size).relu() ** 4 / 24 + (1 - size).relu() ** 4 / 6
        smooth = (self.spacing * distance.sign() * step * cache.parameters.splines[..., 0]).sum(dim=-1)
        # The integral of cos(f q) is sin(f q) / f, of sin(f q) it is -cos(f q) / f.
        by_cos, by_sin = (self.waves(cache.q) / self.frequencies.repeat(1, 2)).chunk(2, dim=-1)
        ripple = (torch.cat([by_sin, -by_cos], dim=-1) * cache.parameters.ripple).sum(dim=-1)
        energy = (smooth + ripple).sum(dim=-1)
        if self.potential is not None and cache.parameters.potential is not None:
            energy = energy + self.potential.forward(cache.encoded, cache.parameters.potential)[0].squeeze(-1)
        return energy

    def gradient(self, cache: ResidualConfiguration, qd: Tensor) -> Tensor:
        """Return d/dq of the residual of 1/2 qd^T M(q) qd - V(q), (..., n)."""
        by_encoded = torch.zeros_like(cache.encoded)
        if self.mass is not None and cache.slope is not None:
            # Cotangent of R, 1/2 qd qd^T, through the linear map, tanh and the network.
            kinetic = 0.5 * (qd.unsqueeze(-1) * qd.unsqueeze(-2)).flatten(-2) @ cache.parameters.functions.mT
            by_encoded = self.mass.vjp(cache.intermediates, cache.slope * kinetic)
        if self.potential is not None and cache.parameters.potential is not None:
            intermediates = self.potential.forward(cache.encoded, cache.parameters.potential)[1]
            by_encoded = by_encoded - self.potential.vjp(intermediates, qd.new_ones(1))
        return self.encoding.vjp(cache.encoded, by_encoded) - cache.torque

    def nonlinear(self, cache: ResidualConfiguration, qd: Tensor) -> Tensor:
        """Return dR/dt qd - ``gradient``, (..., n)."""
        if self.mass is None or cache.slope is None:
            return -self.gradient(cache, qd)
        rate = self.mass.jvp(cache.intermediates, self.encoding.jvp(cache.encoded, qd))
        mass_rate = ((cache.slope * rate) @ cache.parameters.functions).reshape(*qd.shape, self.n)
        return applied(mass_rate, qd) - self.gradient(cache, qd)

    def splines(self, q: Tensor) -> Tensor:
        """Return the cubic B-splines at q, (..., n, SPLINES), each 2/3 high."""
        # ((2 - d)^3 - 4 (1 - d)^3) / 6 with the positive parts: a cubic B-spline of unit spacing.
        wide = (2 - self._distances(q).abs()).relu()
        return torch.sub(wide**3, (wide - 1).relu() ** 3, alpha=4) / 6

    def waves(self, q: Tensor) -> Tensor:
        """Return cosines, then sines of frequency times q, (..., n, 2 HARMONICS + 4)."""
        phase = q.unsqueeze(-1) * self.frequencies
        return torch.cat([phase.cos(), phase.sin()], dim=-1)

    def _distances(self, q: Tensor) -> Tensor:
        """Return the distance of q from the middle of each spline, in spacings, (..., n, SPLINES)."""
        return (q.unsqueeze(-1) - self.middles) / self.spacing


class ResidualDynamics(RigidBodyDynamics):
    """Rigid bodies with residual terms in M, V and friction; ``residuals`` is None if they were removed."""

    residuals: ResidualTerms | None

    def __init__(self, *, residuals: ResidualTerms, **rigid: Any) -> None:
        super().__init__(**rigid)
        self.residuals = residuals

    def prepare(self) -> RigidParameters:
        """Return the parameter cache; valid until a parameter changes."""
        prepared = super().prepare()
        if self.residuals is None:
            return prepared
        return prepared._replace(residual=self.residuals.prepare(prepared.armature))

    def configuration(self, q: Tensor, prepared: RigidParameters) -> RigidConfiguration:
        """Return all that depends on q, (..., n), only."""
        cache = super().configuration(q, prepared)
        if self.residuals is None:
            return cache
        residual = self.residuals.at(q, prepared.residual)
        return cache._replace(mass=cache.mass + residual.mass, varied=residual.friction, residual=residual)

    def potential_energy(self, q: Tensor | RigidConfiguration, z: Tensor | None = None) -> Tensor:
        """Return V(q) and the elastic energy of the bristles, (...) [J]."""
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
