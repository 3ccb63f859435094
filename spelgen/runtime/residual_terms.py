"""What logs show beside rigid bodies: functions of single joints, and networks of several."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from spelgen.runtime.encoding import JointEncoding
from spelgen.runtime.joints import Joints, vector
from spelgen.runtime.parts import Intermediates, Layers, Layout, Network
from spelgen.runtime.port_hamiltonian import applied

SPLINES = 34  # over the range of a joint
HARMONICS = 64  # of a turn of the joint, and the first two of a turn of the motor: teeth and poles come again
LARGEST = math.log(10.0)  # logarithm of friction's factor: it stays between a tenth and ten times
PART = 0.9  # of the drives' inertia, which the residual may take away at most
NEVER = 1e30  # how large a function may be by an entry where it does not stand


class ResidualWeights(NamedTuple):
    """What depends on the weights alone."""

    splines: Tensor  # of the torque [Nm, N] and of friction, by cubes, (n, SPLINES, 2)
    ripple: Tensor  # amplitudes [Nm], (n, 2 HARMONICS + 4)
    constant: Tensor  # what the constants add to M, (n n,)
    functions: Tensor  # what each function adds to M at its largest, (functions, n n)
    mass: Layers | None
    potential: Layers | None


class ResidualPose(NamedTuple):
    """What the terms are at a position."""

    q: Tensor
    encoded: Tensor
    torque: Tensor  # dV/dq of the joints' own functions, (..., n) [Nm, N]
    friction: Tensor  # the factor on friction, (..., n)
    mass: Tensor  # R(q), (..., n, n)
    slope: Tensor | None  # of R's functions by the network's outputs
    intermediates: Intermediates  # what derivatives of these outputs need
    weights: ResidualWeights


class ResidualTerms(nn.Module):
    """R(q) in M, terms of V, and a factor on friction; zero, and one, while the weights are zero.

    Of each joint alone: a torque dV/dq, a sum of cubic B-splines over its range and, if it is revolute, of
    harmonics of its turns and of its motor's, ``gear`` times as many, in units of usual friction; and the
    factor, the exponential of such a spline, between a tenth and ten. Splines vanish where the range ends.

    R has functions and constants, where ``entries`` has them, and a network ``potential`` in units of
    ``scale`` [J] adds to V. Each function is its bound times the tanh of a network's output, each constant
    of a weight: ``bounds`` are such that armature + R is positive definite for all q and all weights.
    """

    kinds = (
        ("raw_torque_splines", "torque_splines", "Nm, N"),
        ("raw_torque_ripple", "torque_ripple", "Nm"),
        ("raw_friction_splines", "friction_splines", "1"),
        ("raw_constants", "mass_residuals", "kg m^2, kg m, kg"),
    )

    def __init__(
        self,
        joints: Joints,
        gear: Sequence[float],
        entries: Layout,
        functions: int,
        constants: int,
        network: Network | None,
        potential: Network | None,
        scale: float,
    ) -> None:
        super().__init__()
        n = len(joints.speed)
        zeros = torch.zeros(n, SPLINES, dtype=torch.float64)
        self.encoding = JointEncoding(joints)
        spacing = 2 * vector(joints.reach).unsqueeze(-1) / (SPLINES - 3)
        knots = torch.arange(SPLINES).double() - (SPLINES - 1) / 2
        self.spacing = nn.Buffer(spacing)
        self.middles = nn.Buffer(vector(joints.center).unsqueeze(-1) + spacing * knots)
        self.unit = nn.Buffer(vector(joints.friction).unsqueeze(-1))
        self.revolute = nn.Buffer(vector(float(revolute) for revolute in joints.revolute).unsqueeze(-1))
        # how often in a turn of the joint a ripple may come again, (n, HARMONICS + 2)
        frequencies = torch.arange(1.0, HARMONICS + 3).double().repeat(n, 1)
        for joint, ratio in enumerate(gear):
            if ratio > HARMONICS:
                frequencies[joint, HARMONICS:] = vector((ratio, 2 * ratio))
        self.frequencies = nn.Buffer(frequencies)
        self.raw_torque_splines = nn.Parameter(zeros.clone())
        self.raw_torque_ripple = nn.Parameter(torch.zeros(n, 2 * (HARMONICS + 2), dtype=torch.float64))
        self.raw_friction_splines = nn.Parameter(zeros)
        self.n, self.functions, self.entries = n, functions, entries
        self.mass, self.potential = network, potential
        self.scale = nn.Buffer(torch.full((1, 1), scale, dtype=torch.float64))
        size = self._by_entry(torch.ones(functions + constants, dtype=torch.float64)).abs()
        # one by the size of each function and constant in an entry, NEVER where it has none
        self.inverse = nn.Buffer(torch.where(size > 0, 1 / size, NEVER))
        self.part = PART / float((size > 0).sum(dim=(0, 2)).max())  # of all that meet in a row of M
        self.raw_constants = nn.Parameter(torch.zeros(constants, dtype=torch.float64))

    def _by_entry(self, sizes: Tensor) -> Tensor:
        """Return what functions and constants of these sizes add to M, (functions + constants, n, n)."""
        rows = torch.diag(sizes).unbind()
        return self.entries(rows[: self.functions], rows[self.functions :])

    def bounds(self, armature: Tensor) -> Tensor:
        """Return how large each function and constant may be, beside an armature matrix, (n, n).

        armature - diag(d) is positive semi-definite for d = 1 / (row sums of |armature^-1|), and so is
        diag(d) - R where no row of |R| / sqrt(d d^T) adds up to more than one: by diagonal dominance both.
        """
        root = torch.linalg.inv(armature).abs().sum(dim=-1).rsqrt()
        smallest: Tensor = (root.unsqueeze(-1) * root * self.inverse).amin(dim=(-2, -1))
        return self.part * smallest

    def friction_logarithms(self) -> Tensor:
        """Return weights of the splines whose sum is the logarithm of friction's factor, (n, SPLINES)."""
        return LARGEST * (self.raw_friction_splines / LARGEST).tanh()

    def prepare(self, armature: Tensor) -> ResidualWeights:
        """Return all that depends on the weights alone, beside an armature matrix, (n, n)."""
        splines = [self.unit * self.raw_torque_splines, self.friction_logarithms()]
        rows = self._by_entry(self.bounds(armature)).flatten(1)
        functions, constants = rows.tensor_split((self.functions,))
        mass = potential = None
        if self.mass is not None:
            identity = torch.eye(self.functions, dtype=rows.dtype, device=rows.device)
            mass = self.mass.prepare(identity, rows.new_zeros(self.functions))
        if self.potential is not None:
            potential = self.potential.prepare(self.scale, 0 * self.scale[0])
        return ResidualWeights(
            splines=torch.stack(splines, dim=-1),
            ripple=self.unit * self.revolute * self.raw_torque_ripple,
            constant=self.raw_constants.tanh() @ constants,
            functions=functions,
            mass=mass,
            potential=potential,
        )

    def at(self, q: Tensor, weights: ResidualWeights) -> ResidualPose:
        """Return what the terms are at q."""
        encoded = self.encoding.forward(q)
        splines = torch.einsum("...ik,ikm->...im", self.splines(q), weights.splines)
        smooth, friction = splines.unbind(-1)
        torque = smooth + (self.waves(q) * weights.ripple).sum(dim=-1)
        mass, slope, intermediates = weights.constant.expand(*q.shape[:-1], -1), None, None
        if self.mass is not None and weights.mass is not None:
            y, intermediates = self.mass.forward(encoded, weights.mass)
            height = y.tanh()
            mass, slope = F.linear(height, weights.functions.mT, weights.constant), 1 - height * height
        mass = mass.reshape(*q.shape, self.n)
        return ResidualPose(q, encoded, torque, friction.exp(), mass, slope, intermediates, weights)

    def energy(self, pose: ResidualPose) -> Tensor:
        """Return what is added to V, (...) [J]; a spline's part is zero in its middle."""
        distance = self._places(pose.q)
        away = distance.abs()
        step = 0.5 - (2 - away).relu() ** 4 / 24 + (1 - away).relu() ** 4 / 6
        smooth = (self.spacing * distance.sign() * step * pose.weights.splines[..., 0]).sum(dim=-1)
        by_cos, by_sin = (self.waves(pose.q) / self.frequencies.repeat(1, 2)).chunk(2, dim=-1)
        ripple = (torch.cat([by_sin, -by_cos], dim=-1) * pose.weights.ripple).sum(dim=-1)
        energy = (smooth + ripple).sum(dim=-1)
        if self.potential is not None and pose.weights.potential is not None:
            energy = energy + self.potential.forward(pose.encoded, pose.weights.potential)[0].squeeze(-1)
        return energy

    def gradient(self, pose: ResidualPose, qd: Tensor) -> Tensor:
        """Return d/dq of what is added to 1/2 qd^T M(q) qd - V(q), (..., n)."""
        by_encoded = torch.zeros_like(pose.encoded)
        if self.mass is not None and pose.slope is not None:
            kinetic = 0.5 * (qd.unsqueeze(-1) * qd.unsqueeze(-2)).flatten(-2) @ pose.weights.functions.mT
            by_encoded = self.mass.vjp(pose.intermediates, pose.slope * kinetic)
        if self.potential is not None and pose.weights.potential is not None:
            intermediates = self.potential.forward(pose.encoded, pose.weights.potential)[1]
            by_encoded = by_encoded - self.potential.vjp(intermediates, qd.new_ones(1))
        return self.encoding.vjp(pose.encoded, by_encoded) - pose.torque

    def nonlinear(self, pose: ResidualPose, qd: Tensor) -> Tensor:
        """Return dR/dt qd less ``gradient``, (..., n)."""
        if self.mass is None or pose.slope is None:
            return -self.gradient(pose, qd)
        rate = self.mass.jvp(pose.intermediates, self.encoding.jvp(pose.encoded, qd))
        mass_rate = ((pose.slope * rate) @ pose.weights.functions).reshape(*qd.shape, self.n)
        return applied(mass_rate, qd) - self.gradient(pose, qd)

    def splines(self, q: Tensor) -> Tensor:
        """Return the cubic B-splines at q, (..., n, SPLINES), each 2/3 high."""
        wide = (2 - self._places(q).abs()).relu()
        return torch.sub(wide**3, (wide - 1).relu() ** 3, alpha=4) / 6

    def waves(self, q: Tensor) -> Tensor:
        """Return cosines, then sines of frequency times q, (..., n, 2 HARMONICS + 4)."""
        phase = q.unsqueeze(-1) * self.frequencies
        return torch.cat([phase.cos(), phase.sin()], dim=-1)

    def _places(self, q: Tensor) -> Tensor:
        """Return how far q is from each spline's middle, in spacings, (..., n, SPLINES)."""
        return (q.unsqueeze(-1) - self.middles) / self.spacing
