"""What a fit is judged by while it goes on: predicted validation windows, integrated finely enough."""

from __future__ import annotations

import copy
import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

import torch

from spelgen.fitting.dataset import TrainingData
from spelgen.fitting.rollout import choose_substeps, rollout_loss
from spelgen.fitting.run_record import Content
from spelgen.settings.fits import DEFAULTS, Solver
from spelgen.settings.tuning.fitting import ValidationTuning

if TYPE_CHECKING:
    from spelgen.emission.loading import EmittedModel

TUNING = ValidationTuning()


@dataclass(frozen=True, eq=False)
class Measured:
    """A model's weights, the integrator's steps that they need between samples, and their validation loss."""

    substeps: int
    loss: float
    weights: Content


class Validation:
    """Validation windows, and a probe of the training windows for the integrator's steps.

    substeps: of rk4 between samples, where they are prescribed. batch: a fourth of the windows predicted together.
    """

    def __init__(
        self,
        model: EmittedModel,
        data: TrainingData,
        device: str = "cpu",
        *,
        batch: int = DEFAULTS.batch,
        solver: Solver = "rk4",
        substeps: int | None = None,
    ) -> None:
        self.model = model.to(device)
        self.solver, self.prescribed = solver, substeps
        self.size = len(data.validation)
        self.scales = data.scales.to(device)
        self.batches = data.validation.to(device).split(4 * batch)
        self.probe = data.training[:: -(-len(data.training) // TUNING.probe)].to(device)

    def loss(self, substeps: int) -> float:
        """Return `rollout_loss` of the validation windows; infinite where numbers blow up."""
        total = 0.0
        try:
            with torch.no_grad():
                for windows in self.batches:
                    loss = rollout_loss(self.model, windows, self.scales, substeps, self.solver)
                    total += loss.item() * len(windows)
        except torch.linalg.LinAlgError:
            return math.inf
        return total / self.size

    def substeps(self, present: int | None = None) -> int:
        """Return the integrator's steps per sample interval: those prescribed, or as many as the model now needs.

        They are never fewer than the present ones.
        """
        if self.solver != "rk4":
            return 1
        if self.prescribed is not None:
            return self.prescribed
        return choose_substeps(self.model, self.probe, self.scales, start=present or 1)

    def measure(self) -> Measured:
        """Return what validation says of the model as it is."""
        substeps = self.substeps()
        return Measured(substeps, self.loss(substeps), copy.deepcopy(self.model.state_dict()))
