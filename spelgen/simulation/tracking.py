"""Arm + Settings -> logs as a real arm gives them: controlled along paths, seen by encoders, velocities by differences.

Stands in for the protocol of the paper's real arm (Wang, Chen, Ding, Sci Rep 15:33179, 2025), whose logs are not
public. What the paper leaves open is ours: gains, phases, encoders and the filter's cutoff.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from spelgen.arm.arm import Arm
from spelgen.dynamics.pinocchio_arm import arm_dynamics
from spelgen.dynamics.pinocchio_dynamics import PinocchioDynamics
from spelgen.errors import SettingsError
from spelgen.excitation.trajectory import Motion
from spelgen.logs.trajectory import Trajectory
from spelgen.settings.settings import Settings
from spelgen.settings.simulation import TrackingSettings
from spelgen.simulation.friction import Friction, make_friction
from spelgen.simulation.integration import LOOSER, rollout
from spelgen.simulation.paths import paths
from spelgen.simulation.random_inputs import initial_range
from spelgen.simulation.simulated_logs import SimulatedLogs

FILTER_ORDER = 4
STRETCH = 32  # samples
UNSEEN = 0.01  # of an encoder's step: an error of integration that nobody sees
INTEGRAL_GAIN = 0.2  # a tenth of what makes a joint without friction unstable

Wanted = tuple[np.ndarray, np.ndarray, np.ndarray]
"""q, qd and qdd (n,)."""


@dataclass(frozen=True, eq=False)
class Gains:
    """Of a PID controller at each joint, (n,): torque per error of position, of its integral and of velocity."""

    proportional: np.ndarray
    integral: np.ndarray
    derivative: np.ndarray


@dataclass(frozen=True, eq=False)
class Recording:
    """One motion of T samples: what happened, and what the arm's own sensors saw of it.

    t: (T,) [s]. states: (T, 2n) true positions and velocities. encoders: (T, n) positions in whole steps of the
    encoders. tau: (T, n) motor torques, tau[k] held from t[k] to t[k+1], known exactly.
    """

    t: np.ndarray
    states: np.ndarray
    encoders: np.ndarray
    tau: np.ndarray


def track(
    arm: Arm,
    settings: Settings,
    input_matrix: np.ndarray | None = None,
    *,
    progress: Callable[[int, int], None] | None = None,
) -> SimulatedLogs:
    """Return logs of the arm controlled along paths, by `settings.simulation` and `settings.tracking`.

    Every recording has its own gains, and its own phases or place to begin. The last `test_fraction` of each is
    for testing. Logged are positions from the encoders after a zero-phase low-pass, velocities by central
    differences of these, and the motors' torques. Arguments, errors and the integration error, here over whole
    recordings under the same torques, as for `random_inputs`.
    """
    protocol = settings.simulation
    dynamics, friction = arm_dynamics(arm, settings), make_friction(arm, settings)
    inputs = np.eye(len(arm.coordinates)) if input_matrix is None else input_matrix
    middle = np.mean(initial_range(arm, settings), axis=0)
    ticks = np.arange(_ticks(settings)) * (1.0 / settings.tracking.control_rate)
    train, test, errors = [], [], []
    for number, path in enumerate(paths(arm, settings, ticks)):
        bandwidth = settings.tracking.bandwidths[number % len(settings.tracking.bandwidths)]
        # what a joint feels when the others are free
        inertia = 1 / np.diag(np.linalg.inv(dynamics.mass_matrix(middle)))
        gains = tuned_gains(inertia, bandwidth)
        recording = record(dynamics, friction, inputs, path, gains, settings, 2 * np.pi * bandwidth)
        effect = recording.tau @ inputs.T
        errors.append(_integration_error(dynamics, friction, recording, effect))
        log = measured(recording, settings.tracking, f"traj_{number:02d}")
        kept = max(1, len(log) - round(protocol.test_fraction * len(log)))
        train.append(log[:kept])
        if kept < len(log):
            test.append(replace(log[kept:], name=f"{log.name}_end"))
        if progress is not None:
            progress(number + 1, protocol.trajectories)
    return SimulatedLogs(train, test, float(max(errors)), allowed=UNSEEN * settings.tracking.resolution)


def _integration_error(
    dynamics: PinocchioDynamics, friction: Friction, recording: Recording, effect: np.ndarray
) -> float:
    """The largest difference to looser integration, begun anew every STRETCH samples: an arm that falls when nobody
    controls it carries any difference away.
    """
    largest = 0.0
    for start in range(0, len(recording.t) - 1, STRETCH):
        part = slice(start, start + STRETCH + 1)
        again = rollout(
            dynamics, friction, recording.states[start], recording.t[part], effect[part], looser=LOOSER
        )
        largest = max(largest, float(np.abs(recording.states[part] - again).max()))
    return largest


def tuned_gains(inertia: np.ndarray, bandwidth: float) -> Gains:
    """Return gains for joints of inertia (n,) [kg m^2; kg] with both poles of the position loop at the bandwidth
    [Hz].
    """
    omega = 2 * np.pi * bandwidth
    return Gains(inertia * omega**2, INTEGRAL_GAIN * inertia * omega**3, 2 * inertia * omega)


def computed_torque(
    dynamics: PinocchioDynamics,
    friction: Friction,
    wanted: Wanted,
    seen: np.ndarray,
    lag: np.ndarray,
    omega: float,
) -> np.ndarray:
    """Return the joint torques (n,) of a controller that knows the arm: M (qdd* + 2 omega e' + omega^2 e) + what
    motion, gravity and friction take (Siciliano et al., Robotics, 2009, 8.5.2).

    wanted: q*, qd*, qdd* (n,). seen: positions (n,); lag: e', the error of velocity. Where viscous friction alone makes
    a joint slower than omega, a stiffness of viscous * omega beside it.
    """
    q, qd, qdd = wanted
    error = q - seen
    mass = dynamics.mass_matrix(seen)
    slow = np.where(friction.viscous > np.diag(mass) * omega, friction.viscous * omega, 0.0)
    accelerated = mass @ (qdd + 2 * omega * lag + omega**2 * error)
    held: np.ndarray = dynamics.nonlinear_effects(seen, qd) + friction(qd) + slow * error
    return accelerated + held


def record(
    dynamics: PinocchioDynamics,
    friction: Friction,
    inputs: np.ndarray,
    path: Motion,
    gains: Gains,
    settings: Settings,
    omega: float = 0.0,
) -> Recording:
    """Return a motion along a path: the controller sees the encoders and holds its torques between its ticks.

    path: at the ticks. inputs: G (n, n). The arm starts at rest where the path begins, held against its weight.
    omega: of computed torques [rad/s], where these are asked for.
    """
    tracking, n = settings.tracking, path.q.shape[1]
    tick, held = 1.0 / tracking.control_rate, _samples_of_a_tick(settings)
    to_motors = np.linalg.pinv(inputs)
    state = np.concatenate([path.q[0], np.zeros(n)])
    integral = dynamics.nonlinear_effects(*np.split(state, 2))
    before = seen = _seen(state[:n], tracking)
    states, torques = [], []
    for k, wanted in enumerate(zip(path.q, path.qd, path.qdd, strict=True)):
        before, seen = seen, _seen(state[:n], tracking)
        error = wanted[0] - seen
        lag = wanted[1] - (seen - before) / tick
        integral = integral + tick * gains.integral * error
        effort = gains.proportional * error + gains.derivative * lag + integral
        if tracking.control == "computed-torque":
            effort = computed_torque(dynamics, friction, wanted, seen, lag, omega)
        tau = to_motors @ effort
        t = k * tick + np.arange(held + 1) / settings.simulation.sample_rate
        passed = rollout(dynamics, friction, state, t, np.tile(inputs @ tau, (held + 1, 1)))
        states.append(passed[:-1])
        torques.append(np.tile(tau, (held, 1)))
        state = passed[-1]
    true = np.concatenate(states)
    t = np.arange(len(true)) / settings.simulation.sample_rate
    return Recording(t, true, _seen(true[:, :n], tracking), np.concatenate(torques))


def measured(recording: Recording, tracking: TrackingSettings, name: str) -> Trajectory:
    """Return what is logged of a motion: filtered positions, their differences, and the torques."""
    from scipy.signal import butter, sosfiltfilt  # as in logs/filtering.py

    sample_rate = 1.0 / (recording.t[1] - recording.t[0])
    low_pass = butter(FILTER_ORDER, tracking.cutoff, fs=sample_rate, output="sos")
    padding = min(
        len(recording.t) - 1, int(3 * sample_rate / tracking.cutoff)
    )  # as `low_pass` of logs/filtering.py
    q = sosfiltfilt(low_pass, recording.encoders, axis=0, padlen=padding)
    return Trajectory(recording.t, q, np.gradient(q, recording.t, axis=0), recording.tau, name)


def _seen(q: np.ndarray, tracking: TrackingSettings) -> np.ndarray:
    """The nearest whole steps of the encoders."""
    return np.round(q / tracking.resolution) * tracking.resolution


def _ticks(settings: Settings) -> int:
    """How many there are in a trajectory."""
    simulation = settings.simulation
    return -(-round(simulation.duration * simulation.sample_rate) // _samples_of_a_tick(settings))


def _samples_of_a_tick(settings: Settings) -> int:
    """How many samples the controller holds a torque."""
    sample_rate, control_rate = settings.simulation.sample_rate, settings.tracking.control_rate
    count = round(sample_rate / control_rate)
    if count < 1 or abs(count * control_rate - sample_rate) > 1e-9 * sample_rate:
        raise SettingsError(
            f"{control_rate:g} Hz beside samples at {sample_rate:g} Hz", element="tracking.control_rate",
            expected="a rate of which simulation.sample_rate is a multiple",
        )  # fmt: skip
    return count
