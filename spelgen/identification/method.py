"""Configure how parameters are identified, by options that agree with one another."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal

from spelgen.errors import OptionError, SettingsError
from spelgen.identification.friction import FrictionModel

Weights = Literal["equal", "range", "noise"]


@dataclass(frozen=True)
class LeastSquares:
    """How parameters are fitted. Raises SettingsError for options that do not go together.

    weights: of the joints' squared errors: ``equal`` (a Nm is a Nm), by the ``range`` of each joint's torque, or
    by the ``noise`` that is left, found in a few rounds. ridge: times the squared length of each column, as a
    penalty; 0: none. prior: standard deviation of the bodies around the URDF's (see ``gaussian_prior``), 0.5 suits
    few data; None: none.
    """

    weights: Weights = "noise"
    ridge: float = 0.0
    prior: float | None = None
    friction: FrictionModel = field(default_factory=FrictionModel)

    def __post_init__(self) -> None:
        if self.ridge < 0 or (self.prior is not None and self.prior <= 0):
            raise SettingsError("a negative ridge or prior", element="identify", expected="positive ones")
        if self.prior is not None and self.ridge:
            raise OptionError("ridge", "belongs to a fit without prior; give one of the two")
        if self.prior is not None and self.weights != "noise":
            raise OptionError("prior", f"belongs to the weights noise, these are {self.weights}")
