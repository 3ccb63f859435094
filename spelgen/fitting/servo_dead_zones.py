"""Which joints have a dead zone: those where it foretells windows that it was not fitted to.

By the cost's first two derivatives, window by window: without each one in turn all weights are fitted with a joint's
dead zone and without, and both are judged there. A dead zone enters where windows as a whole gain, beyond luck.
"""

from __future__ import annotations

import torch

from spelgen.fitting.servo_descent import Normal

SURE = 2.82  # standard errors of the mean gain of a window, as in `residual_fit`
LEAST = 1e-3  # rad, m: to begin with, and no gain below


def dead_zones(
    normal: Normal, away: torch.Tensor, precision: torch.Tensor, places: torch.Tensor
) -> torch.Tensor:
    """Half widths (n,) that windows ask for, 0 where they ask for none.

    away: (k,) of the unknowns from the prior's centre; precision: (k,) of the prior, with dead zones; places: (n,) of
    the dead zones among the unknowns.
    """
    others = torch.ones(len(precision), dtype=torch.bool)
    others[places] = False
    rest = torch.nonzero(others).squeeze(-1)
    without = _left_out(normal, away, precision, rest)
    found = torch.zeros(len(places)).double()
    for joint, place in enumerate(places.tolist()):
        both = torch.cat([rest, torch.tensor([place])])
        width = _left_out(normal, away, precision, both)
        gain = _cost(normal, without) - _cost(normal, width)
        error = gain.std() / len(gain) ** 0.5
        if gain.mean() > SURE * error and float(width[:, place].mean()) > LEAST:
            found[joint] = width[:, place].mean()
    return found


def _left_out(
    normal: Normal, away: torch.Tensor, precision: torch.Tensor, chosen: torch.Tensor
) -> torch.Tensor:
    """Steps (W, k) of the chosen unknowns to where the cost without a window is least."""
    matrix, target = normal.matrix[:, chosen[:, None], chosen], normal.target[:, chosen]
    whole = matrix.sum(dim=0) + torch.diag(precision[chosen])
    slope = target.sum(dim=0) + (precision * away)[chosen]
    steps = torch.zeros_like(normal.target)
    steps[:, chosen] = -torch.linalg.solve(whole - matrix, (slope - target).unsqueeze(-1)).squeeze(-1)
    return steps


def _cost(normal: Normal, steps: torch.Tensor) -> torch.Tensor:
    """What steps (W, k) add to the cost of their own window, (W,)."""
    turned = (normal.matrix @ steps.unsqueeze(-1)).squeeze(-1)
    return (steps * (turned + 2 * normal.target)).sum(dim=-1)
