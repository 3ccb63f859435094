"""What each joint adds by itself, by its position alone: springs, cables, gear ripple, friction that varies."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from spelgen.runtime.joints import Joints, vector

SPLINES = 34  # over the range of a joint
HARMONICS = 64  # of a turn of the joint, and the first two of a turn of the motor: teeth and poles come again


def ripple_frequencies(joints: Joints) -> Tensor:
    """How often in a turn of the joint a ripple may come again, (n, HARMONICS + 2)."""
    few = tuple(range(1, HARMONICS + 3))
    rows = [(*few[:-2], gear, 2 * gear) if gear > HARMONICS else few for gear in joints.gear]
    return torch.tensor(rows, dtype=torch.float64)


class JointFunctions(nn.Module):
    """By joint a torque t(q) = dV/dq, its energy V(q), and a factor on friction, from q of that joint alone.

    t is a sum of cubic B-splines over the joint's range and, of a revolute joint, of harmonics of its
    turns and of its motor's; the factor is the exponential of such a spline. Splines vanish where the
    range ends, so that nothing is added where nothing was seen. Weights are zero at first; torques are
    in units of usual friction.
    """

    scale: Tensor
    spacing: Tensor
    middles: Tensor
    revolute: Tensor
    frequencies: Tensor

    def __init__(self, joints: Joints) -> None:
        super().__init__()
        n = joints.n
        self.prismatic = not all(joints.revolute)
        spacing = 2 * vector(joints.reach).unsqueeze(-1) / (SPLINES - 3)
        knots = torch.arange(SPLINES).double() - (SPLINES - 1) / 2
        self.register_buffer("scale", vector(joints.friction))
        self.register_buffer("spacing", spacing)
        self.register_buffer("middles", vector(joints.center).unsqueeze(-1) + spacing * knots)
        self.register_buffer("revolute", vector(float(each) for each in joints.revolute).unsqueeze(-1))
        self.register_buffer("frequencies", ripple_frequencies(joints))
        self.raw_torque_splines = nn.Parameter(torch.zeros(n, SPLINES, dtype=torch.float64))
        self.raw_torque_ripple = nn.Parameter(torch.zeros(n, 2 * (HARMONICS + 2), dtype=torch.float64))
        self.raw_friction_splines = nn.Parameter(torch.zeros(n, SPLINES, dtype=torch.float64))

    def splines(self, q: Tensor) -> Tensor:
        """The cubic B-splines at q, (..., n, SPLINES), each 2/3 high."""
        wide = (2 - self._places(q).abs()).relu()
        return torch.sub(wide**3, (wide - 1).relu() ** 3, alpha=4) / 6

    def ripple(self, q: Tensor) -> Tensor:
        """Cosines, then sines of frequency times q, (..., n, 2 HARMONICS + 4); zero for a prismatic joint."""
        phase = q.unsqueeze(-1) * self.frequencies
        both = torch.cat([phase.cos(), phase.sin()], dim=-1)
        return both * self.revolute if self.prismatic else both

    def torque(self, q: Tensor, splines: Tensor) -> Tensor:
        """dV/dq, (..., n) [Nm, N], where the splines are these."""
        smooth = (splines * self.raw_torque_splines).sum(dim=-1)
        return self.scale * (smooth + (self.ripple(q) * self.raw_torque_ripple).sum(dim=-1))

    def energy(self, q: Tensor) -> Tensor:
        """V, (...) [J]; of what ends where the range does, half on either side."""
        place = self._places(q)
        away = place.abs()
        part = 0.5 - (2 - away).relu() ** 4 / 24 + (1 - away).relu() ** 4 / 6
        smooth = (self.spacing * place.sign() * part * self.raw_torque_splines).sum(dim=-1)
        by_cos, by_sin = (self.ripple(q) / self.frequencies.repeat(1, 2)).chunk(2, dim=-1)
        turned = torch.cat([by_sin, -by_cos], dim=-1)
        return (self.scale * (smooth + (turned * self.raw_torque_ripple).sum(dim=-1))).sum(dim=-1)

    def friction_factor(self, splines: Tensor) -> Tensor:
        """How much more friction there is than elsewhere, (..., n), positive, where the splines are these."""
        return (splines * self.raw_friction_splines).sum(dim=-1).exp()

    def _places(self, q: Tensor) -> Tensor:
        """How far q is from each spline's middle, in spacings, (..., n, SPLINES)."""
        return (q.unsqueeze(-1) - self.middles) / self.spacing
