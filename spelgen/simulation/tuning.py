"""Constants of simulated logs."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class SimulationTuning:
    """Accuracy of simulated motion, and controllers of simulated arms."""

    # [1] Relative tolerance of the integration: as accurate as double precision allows.
    rtol: float = 1e-13
    # [rad, rad/s] Absolute tolerance of the integration.
    atol: float = 1e-14
    # [1] Steps of the integrator while a torque is constant; an integration that needs more does not end.
    most_steps: int = 100_000
    # [1] Factor on the tolerances of simulations with encoders: 1e-11 is below their resolution.
    seen_loosening: float = 100.0
    # [1] Fraction of a joint's range and of its speed limit that motion uses by default.
    used_range: float = 0.7
    # [1] Integral gain of the PID: a tenth of the gain at which a joint without friction is unstable.
    integral_gain: float = 0.2
    # [Hz] Approximate rate of the controllers by default.
    control_rate: float = 125.0


@dataclass(frozen=True)
class ServoSimulationTuning:
    """Motion of arms under position servos in `spelgen simulate`."""

    # [s] Largest step of the integration.
    step: float = 1e-3
    # [rad, m] Largest amplitude of a command about the middle of a joint's range.
    widest: float = 0.6
    # [s] Time between jumps of the commands.
    held_level: float = 2.0
    # [Hz] Lowest frequency of the commands' sines.
    lowest_frequency: float = 0.05
    # [Hz] Highest frequency of the commands' sines: servos of hobby arms track no faster motion.
    highest_frequency: float = 1.2


TUNING, SERVOS = SimulationTuning(), ServoSimulationTuning()
