"""Tuned numbers of arms under position servos: checks of their logs, fits, baselines and simulation."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class ServoRolloutTuning:
    """Decide how finely motion under servos is integrated."""

    step: float = 3.4e-3  # [s] at most; measured: longer steps bias armatures by a few percent


@dataclass(frozen=True)
class ServoLogTuning:
    """Decide what the checks of logs of commanded positions report."""

    earliest_delay: float = -0.1  # [s] positions before commands: such rows are shifted
    latest_delay: float = 0.4  # [s] of every delay that is searched; measured: cheap servos stay below 0.2
    delay_step: float = 0.01  # [s] half a sample at 50 Hz
    rest_time: float = 0.25  # [s] a command rests so long before its joint can rest; measured on an SO-101
    rest_velocity: float = 0.02  # [rad/s, m/s] below it a joint rests, as in the checks of torque logs
    equal_delays: float = 0.1  # log of a mean square error: delays less apart explain the command error alike
    idle_command: float = 1e-2  # [rad, m] standard deviation below which a command does not move
    follows: float = 0.9  # correlation from which on a position follows a command
    ignores: float = 0.5  # correlation below which a position does not follow its command
    sparse_rate: float = 20.0  # [Hz] below it delays and friction are not seen
