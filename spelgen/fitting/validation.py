"""What a fit is judged by while it goes on: predicted validation windows, integrated finely enough."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import torch

from spelgen.fitting.dataset import TrainingData
from spelgen.fitting.rollout import INTEGRATION_FRACTION, choose_substeps, integration_error, rollout_loss

if TYPE_CHECKING:
    from spelgen.emission.loading import EmittedModel
    from spelgen.settings.fits import WindowConfig

PROBE = 64  # windows on which the integration error is watched


class Validation:
    """Validation windows, and a probe of the training windows; ``batch``: windows predicted together, a quarter."""

    def __init__(
        self, model: EmittedModel, data: TrainingData, config: WindowConfig, batch: int, device: str
    ) -> None:
        self.model, self.config = model, config
        self.size = len(data.validation)
        self.scales = data.scales.to(device)
        self.parts = data.validation.to(device).split(4 * batch)
        self.probe = data.training[:: -(-len(data.training) // PROBE)].to(device)

    def loss(self, substeps: int) -> float:
        """`rollout_loss` of the validation windows; infinite where numbers blow up."""
        solver = self.config.solver
        try:
            with torch.no_grad():
                losses = [
                    rollout_loss(self.model, x, self.scales, substeps, solver).item() * len(x)
                    for x in self.parts
                ]
        except torch.linalg.LinAlgError:
            return math.inf
        return sum(losses) / self.size

    def substeps(self, present: int | None = None) -> int:
        """Integrator steps per sample interval: those asked for, or as many as the model now needs; never fewer than
        the present ones.
        """
        if self.config.solver != "rk4":
            return 1
        if self.config.substeps is not None:
            return self.config.substeps
        if present is None:
            return choose_substeps(self.model, self.probe, self.scales)
        if integration_error(self.model, self.probe, self.scales, present) <= INTEGRATION_FRACTION:
            return present
        return choose_substeps(self.model, self.probe, self.scales, start=2 * present)
