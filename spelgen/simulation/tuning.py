"""Constants of simulated logs."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class SimulationTuning:
    """Numbers that decide how exactly motion is simulated, and how arms are controlled."""

    rtol: float = 1e-13  # of integration: as exact as floating-point numbers allow
    atol: float = 1e-14  # [rad, rad/s] likewise
    most_steps: int = 100_000  # while a torque is held: what takes more will not end
    seen_loosening: float = 100.0  # of tolerances where encoders see the motion: 1e-11 is enough
    used_range: float = 0.7  # of a joint's range and of its speed limit, where nothing is said
    integral_gain: float = 0.2  # of the PID: a tenth of what makes a joint without friction unstable
    control_rate: float = 125.0  # [Hz] about, where nothing is said of the controllers


@dataclass(frozen=True)
class ServoSimulationTuning:
    """Decide how `spelgen simulate` moves an arm under position servos."""

    step: float = 1e-3  # [s] at most
    widest: float = 0.6  # [rad, m] of commands, from the middle of a joint's range
    held_level: float = 2.0  # [s] between jumps of the commands
    lowest_frequency: float = 0.05  # [Hz] of the commands' sines
    highest_frequency: float = 1.2  # [Hz] above it servos of hobby arms hardly follow


TUNING, SERVOS = SimulationTuning(), ServoSimulationTuning()
