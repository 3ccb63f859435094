"""Which weights of a model logs of commanded positions move, how far they may be from where they start, and one flat
vector of all of them.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import torch
from torch.func import functional_call, jacfwd

DEAD_ZONE = "servo.dead_zone"
FRICTION = "friction.raw_"
COULOMB = FRICTION + "coulomb"
STRIBECK = FRICTION + "stribeck"
STRIBECK_VELOCITY = FRICTION + "stribeck_velocity"
BODIES = "bodies.raw"
BODY_DEVIATION = 0.3  # of the bodies' weights, which is some 60 % in mass
DIRECTIONS = 6  # of the bodies' weights, those that move gravity most
FAINT = 1e-3  # of the strongest direction: weaker ones are left as they are
DELAY_DEVIATION = 0.1  # s


@dataclass(frozen=True)
class JointWeight:
    """A parameter of which each joint has its own row, and the standard deviation of its Gaussian prior.

    absent: its value at joints that do not have the law it belongs to; None where all have it.
    """

    name: str
    deviation: float
    absent: float | None = None


JOINT_WEIGHTS = (
    JointWeight("servo.raw_kp", 3.0),
    JointWeight("servo.raw_kd", 2.0),
    JointWeight("rotors.raw", 2.0),
    JointWeight("raw_offset", 2.0),
    JointWeight(COULOMB, 2.0),
    JointWeight(STRIBECK, 2.0, absent=-12.0),
    JointWeight(STRIBECK_VELOCITY, 1.0, absent=0.0),
    JointWeight(FRICTION + "load_dependence", 2.0),
    JointWeight(FRICTION + "bristle_fractions", 2.0),
    JointWeight(DEAD_ZONE, 0.02, absent=0.0),  # itself [rad, m], while all others are logarithms
)
RESTS = 1e-9  # deviation of what is not fitted


@dataclass(frozen=True, eq=False)
class Point:
    """Weights of joints (p, n), along directions of bodies (r,), and the delay [s].

    present: (p, n) whether a joint has the law that a weight belongs to; where not, the weight rests.
    """

    joints: torch.Tensor
    bodies: torch.Tensor
    delay: float
    present: torch.Tensor

    def moved(self, step: torch.Tensor) -> Point:
        """One step on; no command is early."""
        joints, bodies, delay = step.split([self.joints.numel(), len(self.bodies), 1])
        later = max(0.0, self.delay + float(delay))
        changed = self.joints + joints.view_as(self.joints) * self.present
        return replace(self, joints=changed, bodies=self.bodies + bodies, delay=later)

    @property
    def flat(self) -> torch.Tensor:
        """All in one, (p n + r + 1,)."""
        delay = torch.tensor([self.delay], dtype=torch.float64)
        return torch.cat([self.joints.flatten(), self.bodies, delay])


class ServoWeights:
    """The weights of a model, to and fro."""

    def __init__(self, model: Any) -> None:
        self.model = model
        everything = {**dict(model.named_parameters()), **dict(model.named_buffers())}
        self.parameters = {each.name: everything[each.name] for each in JOINT_WEIGHTS}
        rows = [
            (each, k)
            for each in JOINT_WEIGHTS
            for k in range(self.parameters[each.name][:1].numel())  # of one joint
        ]
        self.names = [(each.name, k) for each, k in rows]
        self._deviation = torch.tensor([each.deviation for each, _ in rows]).double()
        self._absent = torch.tensor([each.absent or 0.0 for each, _ in rows]).double()
        always = torch.tensor([each.absent is None for each, _ in rows])
        self.present = always.unsqueeze(-1).expand(-1, model.n)  # (p, n), at the start

    def row(self, name: str) -> int:
        """Where a weight stands in (p, n)."""
        return self.names.index((name, 0))

    def read(self) -> torch.Tensor:
        """Of joints, as the model has them, (p, n); 0 of laws that none has yet, which is where these start."""
        found = torch.cat([x.detach().reshape(self.model.n, -1).mT for x in self.parameters.values()])
        return torch.where(self.present, found, 0.0)

    def named(self, joints: torch.Tensor, present: torch.Tensor) -> dict[str, torch.Tensor]:
        """Weights by name, each (P, 1, n) or (P, 1, n, K), of (P, p, n), of which joints have these laws (p, n)."""
        shapes = [x[:1].numel() for x in self.parameters.values()]
        joints = torch.where(present, joints, self._absent.unsqueeze(-1))
        parts = joints.unsqueeze(1).mT.split(shapes, dim=-1)  # (P, 1, n, K)
        return {
            name: part if x.dim() > 1 else part[..., 0]
            for (name, x), part in zip(self.parameters.items(), parts, strict=True)
        }

    def write(self, point: Point) -> None:
        """Put those of joints into the model."""
        with torch.no_grad():
            for name, rows in self.named(point.joints.unsqueeze(0), point.present).items():
                self.parameters[name].copy_(rows[0, 0])

    def precision(self, point: Point) -> torch.Tensor:
        """Of the prior, as `Point.flat`."""
        deviation = torch.where(point.present, self._deviation.unsqueeze(-1), RESTS)
        shared = torch.tensor([1.0] * len(point.bodies) + [DELAY_DEVIATION]).double()
        return torch.cat([deviation.flatten(), shared]) ** -2

    def with_all(self, point: Point, *names: str) -> Point:
        """The point, of which each joint has these weights."""
        present = point.present.clone()
        present[[self.row(x) for x in names]] = True
        return replace(point, present=present)


def body_directions(model: Any, q: torch.Tensor) -> torch.Tensor:
    """Directions of the bodies' weights that move gravity at q (M, n) most, (10 B, r), a standard deviation long."""
    still = torch.zeros_like(q)
    with torch.no_grad():
        gravity = model.regressor(q, still, still) @ inertial_slopes(model)
    _, sizes, turned = torch.linalg.svd(gravity.flatten(0, 1), full_matrices=False)
    felt = int((sizes > FAINT * sizes[0].clamp(min=1e-12)).sum()) if len(sizes) else 0
    return BODY_DEVIATION * turned[: min(felt, DIRECTIONS)].mT


def inertial_slopes(model: Any) -> torch.Tensor:
    """Of the ten parameters of all bodies by their weights, (10 B, 10 B)."""
    bodies, raw = model.bodies, model.get_parameter(BODIES).detach()

    def ten(flat: torch.Tensor) -> torch.Tensor:
        found: torch.Tensor = functional_call(bodies, {"raw": flat.view_as(raw)}, ()).flatten()
        return found

    slopes: torch.Tensor = jacfwd(ten)(raw.flatten())
    return slopes.detach()
