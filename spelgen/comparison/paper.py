"""What the paper reports, to stand beside what is measured here: compare ratios, its widths and epochs are not public.

Source: Wang, Chen, Ding, Sci Rep 15:33179 (2025), Tables 3 to 6.
"""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Published:
    """One model of the paper on one robot; None where the paper gives no figure.

    train_loss, test_loss, prediction_loss: of eq. 8. step_seconds: a training step on an RTX 4090.
    velocity, position: mean squared errors summed over the joints.
    """

    outputs: tuple[int, int, int, int]
    """Of the networks of M, D, G and V."""
    inputs: int
    parameters: int
    train_loss: float
    step_seconds: float
    test_loss: float | None = None
    prediction_loss: float | None = None
    velocity: float | None = None
    position: float | None = None


PAPER: dict[str, dict[str, Published]] = {
    "two_link": {
        "phnode": Published((21, 21, 6, 1), 18, 277_319, 8.51e-3, 1.81, prediction_loss=0.194),
        "spel": Published((1, 3, 0, 1), 18, 56_165, 8.01e-3, 0.31, prediction_loss=0.113),
        "spel-kan": Published((1, 3, 0, 1), 18, 13_604, 7.39e-3, 0.82, prediction_loss=0.160),
    },
    "rpr": {
        "phnode": Published((45, 45, 9, 1), 21, 329_700, 7.27e-3, 3.41, prediction_loss=1.30),
        "spel": Published((3, 6, 3, 1), 21, 121_053, 6.92e-3, 0.71, prediction_loss=0.193),
        "spel-kan": Published((3, 6, 3, 1), 21, 118_812, 6.65e-3, 2.08, prediction_loss=0.192),
    },
    "six_dof": {
        "phnode": Published(
            (171, 171, 18, 1), 54, 326_911, 8.13e-3, 17.70, 9.62e-3, velocity=7.93e-2, position=4.707e-3
        ),
        "spel": Published(
            (20, 21, 6, 1), 54, 156_359, 7.99e-3, 3.76, 8.77e-3, velocity=2.45e-2, position=4.693e-3
        ),
        "spel-kan": Published(
            (20, 21, 6, 1), 54, 85_521, 7.96e-3, 6.44, 9.07e-3, velocity=2.50e-2, position=4.691e-3
        ),
    },
}
"""By robot, then by preset."""
