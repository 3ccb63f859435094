"""Configure how parameters are identified."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal

from spelgen.identification.friction import FrictionModel

Weights = Literal["equal", "range", "noise"]


@dataclass(frozen=True)
class LeastSquares:
    """Say how parameters are fitted.

    weights: of the joints' squared errors: ``equal`` (a Nm is a Nm), by the ``range`` of each joint's torque, or
    by the ``noise`` that is left, found in a few rounds.
    """

    weights: Weights = "noise"
    friction: FrictionModel = field(default_factory=FrictionModel)
