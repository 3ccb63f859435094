"""What is believed of a closed-form model before it is fitted: how far its weights may be from where they start.

The URDF's bodies are believed link by link. Friction and rotors are guessed from the drives' efforts: such a guess is
mostly wrong by factors that all joints share (torques measured before the gear or after it, one make of gear), so a
joint's own deviation is small beside the common one.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import torch

SPEEDS = ("friction.bend_speed", "friction.fading", "friction.jump")
SIZES = ("friction.viscous", "friction.bend", "friction.coulomb", "friction.stribeck")


@dataclass(frozen=True)
class Belief:
    """Standard deviations of weights, which are logarithms or shares and so have no unit.

    bodies: in the affine-invariant metric, 0.1 is about 20 % in mass. offset: in usual sizes of friction. rotor,
    sizes and speeds of friction: of each joint by itself; shared_*: of all joints together, of one effect
    (``shared_sizes``) or of all friction (``shared_friction``).
    """

    bodies: float = 0.5
    offset: float = 0.1
    gains: float = 0.3
    rotor: float = 0.4
    sizes: float = 1.0
    speeds: float = 0.7
    shared_rotor: float = 3.0
    shared_sizes: float = 1.0
    shared_speeds: float = 1.0
    shared_friction: float = 3.0

    def covariance(self, weights: Mapping[str, torch.Tensor]) -> torch.Tensor:
        """Of the weights with these names and shapes, flattened one after the other."""
        places, count = {}, 0
        for name, weight in weights.items():
            places[name] = torch.arange(count, count + weight.numel())
            count += weight.numel()
        own = torch.cat([torch.full((len(place),), self._own(name)) for name, place in places.items()])
        covariance = torch.diag(own.double().square())
        groups = [((name,), self._shared(name)) for name in places] + [(SIZES, self.shared_friction)]
        for names, shared in groups:
            together = [places[name] for name in names if name in places]
            if together:
                rows = torch.cat(together)
                covariance[rows[:, None], rows] += shared**2
        return covariance

    def _own(self, name: str) -> float:
        if name in ("bodies", "offset", "gains", "rotor"):
            return float(getattr(self, name))
        return self.speeds if name in SPEEDS else self.sizes

    def _shared(self, name: str) -> float:
        if name in ("bodies", "offset", "gains"):
            return 0.0
        if name == "rotor":
            return self.shared_rotor
        return self.shared_speeds if name in SPEEDS else self.shared_sizes
