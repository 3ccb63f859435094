"""What each joint adds by itself, by its position alone: springs, cables, gear ripple, friction that varies."""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from spelgen.runtime.joints import Joints, vector

SPLINES = 34  # over the range of a joint
HARMONICS = 64  # of a turn of the joint, and the first two of a turn of the motor: teeth and poles come again
FINE = 5  # sines are dear: the k-th harmonic is made of the |b|-th, b from -FINE to FINE,
COARSE = 6  # and of the (2 FINE + 1) a-th, a up to COARSE, where k = (2 FINE + 1) a + b
LARGEST = math.log(10.0)  # logarithm of friction's factor: it stays between a tenth and ten times


class JointFunctionWeights(NamedTuple):
    """What depends on the weights alone."""

    splines: Tensor  # of the torque [Nm, N] and of friction, by cubes, (n, SPLINES, 2)
    ripple: Tensor  # of products of fine and coarse waves [Nm], (n, 2 FINE + 2, 2 COARSE + 6)


def ripple_frequencies(joints: Joints) -> Tensor:
    """How often in a turn of the joint a ripple may come again, (n, HARMONICS + 2)."""
    harmonics = tuple(range(1, HARMONICS + 3))
    rows = [(*harmonics[:-2], gear, 2 * gear) if gear > HARMONICS else harmonics for gear in joints.gear]
    return torch.tensor(rows, dtype=torch.float64)


def _products(cosines: Tensor, sines: Tensor) -> Tensor:
    """By which products of fine and coarse waves harmonics are made, (n, 2 FINE + 2, 2 COARSE + 6)."""
    pads = FINE + 1, (2 * FINE + 1) * COARSE + FINE - HARMONICS
    above, below, motor = [], [], []
    for harmonics in (cosines, sines):
        regular, motor_harmonics = harmonics.tensor_split((HARMONICS,), dim=1)
        rows = F.pad(regular, pads).reshape(-1, COARSE + 1, 2 * FINE + 1).mT  # (n, b + FINE, a)
        above.append(rows[:, FINE:])
        below.append(F.pad(rows[:, :FINE].flip(1), (0, 0, 1, 0)))
        motor.append(F.pad(motor_harmonics.unsqueeze(1), (0, 0, 0, FINE)))
    by_cos = above[0] + below[0], motor[0], above[1] + below[1], motor[1]
    by_sin = above[1] - below[1], 0 * motor[0], below[0] - above[0], 0 * motor[1]
    return torch.cat([torch.cat(by_cos, dim=2), torch.cat(by_sin, dim=2)], dim=1)


def _by_joint(rows: Tensor, matrices: Tensor) -> Tensor:
    """Each joint's row, (..., n, k), times its own matrix, (n, k, m)."""
    if rows.dim() == 2:  # fewer steps, which is what one state costs
        return (rows.unsqueeze(-2) @ matrices).squeeze(-2)
    return torch.einsum("...ik,ikm->...im", rows, matrices)


class JointFunctions(nn.Module):
    """By joint a torque t(q) = dV/dq, its energy V(q), and a factor on friction, from q of that joint alone.

    t is a sum of cubic B-splines over the joint's range and, of a revolute joint, of harmonics of its
    turns and of its motor's; the factor is the exponential of such a spline, between a tenth and ten for
    all weights. Splines vanish where the range ends, so that nothing is added where nothing was seen.
    Weights are zero at first; torques are in units of usual friction.
    """

    kinds = (
        ("raw_torque_splines", "torque_splines", "Nm, N"),
        ("raw_torque_ripple", "torque_ripple", "Nm"),
        ("raw_friction_splines", "friction_splines", "1"),
    )

    def __init__(self, joints: Joints) -> None:
        super().__init__()
        n = joints.n
        self.prismatic = not all(joints.revolute)
        spacing = 2 * vector(joints.reach).unsqueeze(-1) / (SPLINES - 3)
        knots = torch.arange(SPLINES).double() - (SPLINES - 1) / 2
        self.scale = nn.Buffer(vector(joints.friction))
        self.spacing = nn.Buffer(spacing)
        self.middles = nn.Buffer(vector(joints.center).unsqueeze(-1) + spacing * knots)
        self.revolute = nn.Buffer(vector(float(revolute) for revolute in joints.revolute).unsqueeze(-1))
        frequencies = ripple_frequencies(joints)
        fine, coarse = torch.arange(FINE + 1.0), (2 * FINE + 1) * torch.arange(COARSE + 1.0)
        fine, coarse = fine.double().expand(n, -1), coarse.double().expand(n, -1)
        coarse = torch.cat([coarse, frequencies[:, HARMONICS:]], dim=1)
        self.frequencies = nn.Buffer(frequencies)
        # how often fine ones, then coarse ones and the motor's, come again in a turn
        self.waves = nn.Buffer(torch.cat([fine, fine, coarse, coarse], dim=1))
        ahead = [torch.full_like(half[0], x) for half in (fine, coarse) for x in (math.pi / 2, 0.0)]
        self.quarter = nn.Buffer(torch.cat(ahead))  # by how much cosines are ahead of sines
        self.raw_torque_splines = nn.Parameter(torch.zeros(n, SPLINES, dtype=torch.float64))
        self.raw_torque_ripple = nn.Parameter(torch.zeros(n, 2 * (HARMONICS + 2), dtype=torch.float64))
        self.raw_friction_splines = nn.Parameter(torch.zeros(n, SPLINES, dtype=torch.float64))

    def prepare(self) -> JointFunctionWeights:
        """All that depends on the weights alone."""
        scale = self.scale.unsqueeze(-1)
        splines = torch.stack([scale * self.raw_torque_splines, self.friction_logarithms()], dim=-1) / 6
        cosines, sines = (scale * self.revolute * self.raw_torque_ripple).chunk(2, dim=1)
        return JointFunctionWeights(splines, _products(cosines, sines))

    def forward(self, q: Tensor, weights: JointFunctionWeights) -> tuple[Tensor, Tensor]:
        """dV/dq [Nm, N], and how much more friction there is than elsewhere, positive; (..., n) both."""
        smooth, friction = _by_joint(self._cubes(q), weights.splines).unbind(-1)
        waves = torch.addcmul(self.quarter, q.unsqueeze(-1), self.waves).sin()
        fine, coarse = waves.tensor_split((2 * FINE + 2,), dim=-1)
        ripple = (_by_joint(fine, weights.ripple) * coarse).sum(dim=-1)
        return smooth + ripple, friction.exp()

    def friction_logarithms(self) -> Tensor:
        """Weights of the splines whose sum is the logarithm of friction's factor, (n, SPLINES)."""
        return LARGEST * (self.raw_friction_splines / LARGEST).tanh()

    def splines(self, q: Tensor) -> Tensor:
        """The cubic B-splines at q, (..., n, SPLINES), each 2/3 high."""
        return self._cubes(q) / 6

    def ripple(self, q: Tensor) -> Tensor:
        """Cosines, then sines of frequency times q, (..., n, 2 HARMONICS + 4); zero for a prismatic joint."""
        phase = q.unsqueeze(-1) * self.frequencies
        waves = torch.cat([phase.cos(), phase.sin()], dim=-1)
        return waves * self.revolute if self.prismatic else waves

    def energy(self, q: Tensor) -> Tensor:
        """V, (...) [J]; of what ends where the range does, half on either side."""
        distance = self._places(q)
        away = distance.abs()
        step = 0.5 - (2 - away).relu() ** 4 / 24 + (1 - away).relu() ** 4 / 6
        smooth = (self.spacing * distance.sign() * step * self.raw_torque_splines).sum(dim=-1)
        by_cos, by_sin = (self.ripple(q) / self.frequencies.repeat(1, 2)).chunk(2, dim=-1)
        turned = torch.cat([by_sin, -by_cos], dim=-1)
        return (self.scale * (smooth + (turned * self.raw_torque_ripple).sum(dim=-1))).sum(dim=-1)

    def _cubes(self, q: Tensor) -> Tensor:
        """Six times the splines."""
        wide = (2 - self._places(q).abs()).relu()
        return torch.sub(wide**3, (wide - 1).relu() ** 3, alpha=4)

    def _places(self, q: Tensor) -> Tensor:
        """How far q is from each spline's middle, in spacings, (..., n, SPLINES)."""
        return (q / self.spacing.squeeze(-1)).unsqueeze(-1) - self.middles / self.spacing
