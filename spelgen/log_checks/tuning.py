"""Constants of the checks of logs."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class LogCheckTuning:
    """Thresholds of notes and errors about logs."""

    limit_rounding: float = 1e-3  # [rad, m] a position limit overrun by less is rounding
    one_way: float = 0.1  # of a joint's fastest velocity: that of a joint that never moves back is less
    limit_noise: float = 0.01  # of a velocity or effort limit: overrun by less is noise of the signal
    loaded: float = 0.2  # deviation of gravity's torque, of the torque's: from here it must be seen (UR10e)
    # of inertial power that is negative beyond what is positive; +0.3 to +1 on recorded arms
    opposed: float = 0.25
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


@dataclass(frozen=True)
class ServoLogTuning:
    """Decide what the checks of logs of commanded positions report."""

    earliest_delay: float = -0.1  # [s] positions before commands: such rows are shifted
    latest_delay: float = 0.4  # [s] of every delay that is searched; measured: cheap servos stay below 0.2
    delay_step: float = 0.01  # [s] half a sample at 50 Hz
    rest_time: float = 0.25  # [s] a command rests so long before its joint can rest; measured on an SO-101
    idle_command: float = 1e-2  # [rad, m] standard deviation below which a command does not move
    ignores: float = 0.5  # correlation below which a position does not follow its command
    sparse_rate: float = 20.0  # [Hz] below it delays and friction are not seen


TUNING, SERVO_LOGS = LogCheckTuning(), ServoLogTuning()
