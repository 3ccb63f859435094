"""Hold the tuned numbers of the checks of logs."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class LogCheckTuning:
    """Numbers from which on something about a log is odd, or so odd that nothing may be fitted to it."""

    increments: int = (
        10  # [samples] over which q and the integral of qd are compared: hides quantisation of q
    )
    drift: float = (
        0.05  # [rad, m] that qd must say a joint moved, before a q that never changes is called frozen
    )
    agreement: float = 0.9  # correlation from which on two signals are certainly the same but for a factor
    derivative_error: float = 0.1  # by which the factor of qd to dq/dt may differ from 1
    unit_factor: float = 1.25  # a factor this near to that of a unit is that of the unit
    limit_rounding: float = 1e-3  # [rad, m, of a limit] a limit overrun by less is rounding
    loaded: float = (
        0.2  # deviation of gravity's torque, of the torque's: from here on it must be seen (UR10e wrist)
    )
    unseen: float = 0.3  # correlation of torque and gravity below which the one is not in the other
    seen: float = 0.7  # correlation of torque and gravity from which on the one is in the other
    unusual_factor: float = (
        5.0  # times the URDF's gravity torque: inertials are often wrong, but not like this
    )
    impossible_factor: float = 10.0  # times the URDF's gravity torque, which only another unit has
    beyond_drives: float = 20.0  # times its effort limit, which no drive gives in whatever unit
    gravity_samples: int = 400  # of one trajectory; friction and gravity change slowly
    gravity_fewest: int = 100  # of all trajectories, below which gravity cannot be told from friction
    smallest_steps: float = 0.05  # part of the differences between neighbouring levels that may be one step
    whole_step: float = 0.05  # a difference this near to a whole number of steps is that number
    mostly: float = 0.95  # of the differences are whole steps where a signal is quantised
