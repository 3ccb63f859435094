"""Constants of fits of position servos."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class ServoWindowTuning:
    """Decide which windows a fit of servos predicts."""

    # [s] as long as gravity and friction need to show; longer ones diverge with the delay
    length: float = 4.0
    settling: float = 1.0  # [s] of its beginning that is not judged: friction's state forms there
    count: int = 200  # at most, evenly spread: ten minutes of motion


@dataclass(frozen=True)
class ServoPriorTuning:
    """Standard deviations of the Gaussian prior of a fit of servos, from where its parameters start."""

    logarithm: float = 2.0  # [1] of a joint's gains, armature and friction: a factor of seven
    # [1] of its logarithm: by more, friction that falls at any speed fits offsets
    stribeck_velocity: float = 1.0
    dead_zone: float = 0.02  # [rad, m] half a dead zone: gears of hobby servos have a few mrad
    delay: float = 0.1  # [s]
    bodies: float = 0.3  # [1] of the bodies' log-Cholesky parameters: 30 % in mass
    body_directions: int = 6  # that change gravity most; further ones move by less than their prior


@dataclass(frozen=True)
class ServoCostTuning:
    """Decide what errors of predicted windows count, and how their slopes are taken."""

    correlation_time: float = 0.5  # [s] at most, over which errors say the same; measured: most are over 0.2
    nudge: float = 1e-4  # of parameters, in their units: rollouts in double precision lose half their digits


@dataclass(frozen=True)
class ServoSolverTuning:
    """Decide when rounds of a fit of servos end."""

    sparse_windows: int = 32  # at most, in all rounds but the last
    steps: int = 12  # of a round at most
    last_steps: int = 2  # of the last round, on all windows: it starts near the minimum of few
    gain: float = 0.01  # [1] of the cost: a step that gains less ends a round, and a comparison of laws
    relative_gain: float = 1e-4  # [1] likewise, of the cost: where a model's form is wrong costs are high
    # [1] of the first step of a round, after the first round; by 1e-3 kd ends 0.3 % off
    later_damping: float = 1e-5
    # of parameters for the last slopes: by shorter ones a joint that just slips looks known
    last_nudge: float = 1e-3


@dataclass(frozen=True)
class ServoLawTuning:
    """Decide which joints get a dead zone or friction that falls with velocity."""

    dead_zone_fraction: float = 0.25  # [1] of the static error, that a dead zone makes up to begin with
    steps: int = 6  # of joints by themselves
    # [1] standard deviations that a law has to gain: other forms of friction gain 3
    significance: float = 4.0
    least_dead_zone: float = 1e-3  # [rad, m] smaller ones are none: a step of a 12-bit encoder is 1.5e-3


@dataclass(frozen=True)
class ServoIntervalTuning:
    """Decide what is reported as determined."""

    logs: int = 3  # [1] at least, each left out whole: half of a motion says what its other half does
    stretches: int = 6  # [1] into which fewer logs are cut, at least
    # [1] from which on two effects are one; measured on SO-101s: below 30, above 90
    variance_inflation: float = 50.0
    # [1] of ratios, by what friction's laws are not: benchmarks/servo_recovery.py
    law_deviation: float = 0.015
    open_factor: float = 1.25  # [1] what may be larger by this factor within its interval is not determined


@dataclass(frozen=True)
class ServoStartTuning:
    """Decide where a fit of servos starts."""

    # [1] standard deviations of kp by gravity: samples of neighbouring windows are alike
    significance: float = 8.0
    # [1] factor on the kp of the settings, or 2 efforts a rad, beyond which it is not believed
    kp_range: float = 20.0
    # [1] of usual dry friction; squared of kd/kp, cubed of armature/kp: so that these have a log
    least: float = 0.05
