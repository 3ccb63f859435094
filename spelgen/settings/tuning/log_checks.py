"""Hold the tuned numbers of the checks of logs."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class LogCheckTuning:
    """Numbers from which on something about a log is odd, or so odd that nothing may be fitted to it."""

    increments: int = 10  # [samples] over which q and the integral of qd are compared: hides quantisation
    drift: float = 0.05  # [rad, m] that qd must say a joint moved, before a constant q is called frozen
    agreement: float = 0.9  # correlation from which two signals are one; their factor may differ by the rest
    unit_factor: float = 1.25  # a factor this near to that of a unit is that of the unit
    limit_rounding: float = 1e-3  # [rad, m] a position limit overrun by less is rounding
    one_way: float = 0.1  # of a joint's fastest velocity: that of a joint that never moves back is less
    limit_noise: float = 0.01  # of a velocity or effort limit: overrun by less is noise of the signal
    loaded: float = 0.2  # deviation of gravity's torque, of the torque's: from here it must be seen (UR10e)
    seen: float = 0.7  # correlation from which on gravity is in the torque; below what lacks to 1 it is not
    unusual_factor: float = 5.0  # times the URDF's gravity torque: inertials are wrong, but not like this
    impossible_factor: float = 10.0  # times the URDF's gravity torque, which only another unit has
    beyond_drives: float = 20.0  # times its effort limit, which no drive gives in whatever unit
    gravity_samples: int = 400  # of one trajectory; friction and gravity change slowly
    levels: float = 10.0  # of a quantised signal: fewer say little of its size
    step_tolerance: float = 0.05  # of a step, and of the levels of a signal, that may be off a quantised grid
    all_gravity_samples: int = 6000  # of all trajectories together
    dependent: float = 1e-8  # of its own size: what is left of a column that others span
    examples: int = 2  # trajectories that a page draws
    shown: int = 20  # trajectories that a terminal and a notebook show
    slowest_step: float = 0.5  # [s] no arm is sampled more slowly than at 2 Hz


TUNING = LogCheckTuning()
