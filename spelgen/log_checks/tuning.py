"""Constants of the checks of logs."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class LogCheckTuning:
    """Thresholds of notes and errors about logs and their robot."""

    # [rad, m] A position limit may be exceeded by this much: rounding.
    limit_rounding: float = 1e-3
    # [1] A joint moves one way only if its speed in the other direction stays below this fraction of its largest.
    one_way: float = 0.1
    # [1] A velocity or effort limit may be exceeded by this fraction: noise.
    limit_noise: float = 0.01
    # [1] Standard deviation of the gravity torque, as a fraction of the measured torque's, from which on gravity must
    # be visible (UR10e).
    loaded: float = 0.2
    # [1] Correlation from which on gravity is part of the torque; with a correlation below 1 - seen it is not.
    seen: float = 0.7
    # [1] Multiple of the URDF's gravity torque that wrong inertials do not explain.
    unusual_factor: float = 5.0
    # [1] Multiple of the URDF's gravity torque that only another unit explains.
    impossible_factor: float = 10.0
    # [1] Multiple of a drive's effort limit that no drive produces in any unit.
    beyond_drives: float = 20.0
    # [1] Largest number of samples per trajectory for the fit of gravity; gravity and friction change slowly.
    gravity_samples: int = 400
    # [1] A quantised signal with fewer levels gives no reliable magnitude.
    levels: float = 10.0
    # [1] Largest distance of a level from a quantisation grid, as a fraction of its step, and largest fraction of
    # levels beyond it.
    step_tolerance: float = 0.05
    # [1] Largest number of samples of all trajectories for the fit of gravity.
    all_gravity_samples: int = 6000
    # [1] A column is dependent if the part that other columns do not span is below this fraction of its length.
    dependent: float = 1e-8
    # [1] Squared torque error of a joint, relative to the variance, from which on least squares does not explain it.
    unexplained: float = 0.1
    # [1] Flat top: its width as a fraction of the signal's range; its smallest fraction of the samples; its smallest
    # ratio to the number of samples in three times this width below it, which is at most 1 for the peaks of a
    # sinusoid.
    flat_top: float = 0.005
    flat_share: float = 0.01
    flat_ratio: float = 2.0
    # [1] Distance of a filtered signal from its limit, as a fraction of its range, up to which it counts as at the
    # limit.
    near_limit: float = 0.02
    # [1] Degrees of freedom of a joint's parameters, subtracted from the number of samples for the noise.
    free_samples: int = 30
    # [1] Smallest median difference from the model at a limit, in standard deviations of the residual and of the
    # torque.
    certain: float = 3.0
    excess: float = 0.08
    # [1] Largest number of trajectories in the charts of a page.
    examples: int = 2
    # [1] Largest number of trajectories in a list.
    shown: int = 20


@dataclass(frozen=True)
class ServoLogTuning:
    """Thresholds of notes about logs of commanded positions."""

    # [s] Smallest delay of positions after commands that is searched; a negative one means shifted rows.
    earliest_delay: float = -0.1
    # [s] Largest delay that is searched; measured delays of cheap servos are below 0.2 s.
    latest_delay: float = 0.4
    # [s] Step of the searched delays: half a sample at 50 Hz.
    delay_step: float = 0.01
    # [s] Time of constant command before a joint can be at rest; measured on an SO-101.
    rest_time: float = 0.25
    # [rad, m] Standard deviation below which a command is constant.
    idle_command: float = 1e-2
    # [1] Correlation below which a position does not track its command.
    ignores: float = 0.5
    # [Hz] Sample rate below which delays and friction are not visible.
    sparse_rate: float = 20.0


TUNING, SERVO_LOGS = LogCheckTuning(), ServoLogTuning()
