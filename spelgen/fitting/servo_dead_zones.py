"""Which joints have a dead zone: those where windows tell one, beyond luck, with all dead zones fitted beside all else.

By the cost's first two derivatives. A dead zone that dry friction could be as well does not enter.
"""

from __future__ import annotations

import torch

from spelgen.fitting.servo_descent import Normal
from spelgen.fitting.servo_intervals import covariance

SURE = 3.0  # standard deviations
LEAST = 1e-3  # rad, m
INFLATION = 50.0  # of a variance, from which on two things are one: of simulated SO-101s below 30 or above 90


def dead_zones(
    normal: Normal, away: torch.Tensor, precision: torch.Tensor, places: torch.Tensor, widths: torch.Tensor
) -> torch.Tensor:
    """Half widths (n,): those that have entered before, and those of which windows are sure; 0 where there is none.

    away: (k,) of the unknowns from the prior's centre; precision: (k,) of the prior, with dead zones; places: (n,) of
    the dead zones among the unknowns; widths: (n,) so far.
    """
    matrix = normal.matrix.sum(dim=0) + torch.diag(precision)
    target = normal.target.sum(dim=0) + precision * away
    free = torch.ones(len(precision), dtype=torch.bool)
    while True:
        step = torch.zeros_like(target)
        step[free] = -torch.linalg.solve(matrix[free][:, free], target[free])
        below = free[places] & (widths + step[places] < 0)
        if not below.any():
            break
        free[places[below]] = False  # none is negative
    found = widths + step[places]
    unsure = covariance(normal, precision, torch.zeros_like(target)).diagonal()
    deviation = torch.maximum(unsure, torch.linalg.inv(matrix).diagonal())[places].sqrt()
    enters = (found > SURE * deviation) & (found > LEAST) & told_apart(normal, precision, places)
    return torch.where(widths > 0, widths, torch.where(enters, found, torch.zeros_like(found)))


def told_apart(normal: Normal, precision: torch.Tensor, places: torch.Tensor) -> torch.Tensor:
    """Whether windows tell a joint's dead zone from its dry friction and all else, (n,).

    By the variance inflation factor of dead zones: of joints that gravity does not load the slopes of errors by either
    are the same but for a factor, and what is linear in them says nothing of the one without the other.
    """
    matrix = normal.matrix.sum(dim=0)
    inverse = torch.linalg.inv(matrix + torch.diag(precision))
    inflation: torch.Tensor = (matrix.diagonal() * inverse.diagonal())[places]
    return inflation < INFLATION
