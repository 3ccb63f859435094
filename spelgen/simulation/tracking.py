"""Simulate logs as real arms give them: controlled along paths, seen by encoders, velocities by differences.

Stands in for the protocol of the paper's real arm (Wang, Chen, Ding, Sci Rep 15:33179, 2025), whose logs are not
public. What the paper leaves open is ours: gains, phases, encoders and the filter's cutoff.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from spelgen.arm.actuation import Drives
from spelgen.arm.arm import Arm
from spelgen.dynamics.joint_friction import Friction
from spelgen.dynamics.pinocchio_arm import arm_dynamics
from spelgen.dynamics.pinocchio_dynamics import PinocchioDynamics
from spelgen.errors import SettingsError
from spelgen.excitation.trajectory import Motion
from spelgen.logs.filtering import low_pass_regular
from spelgen.logs.trajectory import Trajectory
from spelgen.settings.settings import Settings
from spelgen.settings.simulation import TrackingSettings
from spelgen.simulation.integration import rollout
from spelgen.simulation.paths import paths
from spelgen.simulation.protocol import SimulatedLogs, initial_range, make_friction
from spelgen.simulation.tuning import TUNING


@dataclass(frozen=True, eq=False)
class Gains:
    """Hold a PID controller's gains by joint, (n,): torque per error of position, of its integral and of velocity."""

    proportional: np.ndarray
    integral: np.ndarray
    derivative: np.ndarray


@dataclass(frozen=True, eq=False)
class Recording:
    """One motion of T samples: what happened, and what the arm's own sensors saw of it.

    t: (T,) [s]. states: (T, 2n) true positions and velocities. encoders: (T, n) positions in whole steps of the
    encoders. tau: (T, n) motor torques, tau[k] constant from t[k] to t[k+1], known exactly.
    """

    t: np.ndarray
    states: np.ndarray
    encoders: np.ndarray
    tau: np.ndarray


def track(
    arm: Arm,
    settings: Settings,
    drives: Drives | None = None,
    *,
    progress: Callable[[int, int], None] = lambda done, total: None,
) -> SimulatedLogs:
    """Return logs of the arm controlled along paths, by `settings.simulation` and `settings.tracking`.

    Every recording has its own gains, and its own phases or place to begin. The last `test_fraction` of each is
    for testing. Logged are positions from the encoders after a zero-phase low-pass, velocities by central
    differences of these, and the motors' torques. Arguments and errors as for `random_inputs`.
    """
    protocol = settings.simulation
    friction = make_friction(arm, settings, drives and drives.speeds)
    dynamics = arm_dynamics(arm, settings, friction)
    inputs = np.eye(len(arm.coordinates)) if drives is None else drives.inputs
    middle = np.mean(initial_range(arm, settings), axis=0)
    samples = round(protocol.duration * protocol.sample_rate)
    count = -(-samples // _samples_of_a_tick(settings))
    ticks = np.arange(count) * (1.0 / settings.tracking.control_rate)
    train, test = [], []
    for number, path in enumerate(paths(arm, settings, ticks)):
        bandwidth = settings.tracking.bandwidths[number % len(settings.tracking.bandwidths)]
        # what a joint feels when the others are free
        inertia = 1 / np.diag(np.linalg.inv(dynamics.mass_matrix(middle)))
        gains = tuned_gains(inertia, bandwidth)
        recording = record(dynamics, friction, inputs, path, gains, settings, 2 * np.pi * bandwidth)
        log = measured(recording, settings.tracking, f"traj_{number:02d}")
        cut = max(1, len(log) - round(protocol.test_fraction * len(log)))
        train.append(log[:cut])
        if cut < len(log):
            test.append(replace(log[cut:], name=f"{log.name}_end"))
        progress(number + 1, protocol.trajectories)
    return SimulatedLogs(train, test)


def tuned_gains(inertia: np.ndarray, bandwidth: float) -> Gains:
    """Return gains for joints of inertia (n,) [kg m^2; kg]; both poles of the position loop are at the bandwidth."""
    omega = 2 * np.pi * bandwidth
    return Gains(inertia * omega**2, TUNING.integral_gain * inertia * omega**3, 2 * inertia * omega)


def computed_torque(
    dynamics: PinocchioDynamics,
    friction: Friction,
    motion: tuple[np.ndarray, np.ndarray, np.ndarray],
    error: np.ndarray,
    lag: np.ndarray,
    omega: float,
) -> np.ndarray:
    """Return the joint torques (n,) of a controller that knows the arm (Siciliano et al., Robotics, 2009, 8.5.2).

    They are M (qdd* + 2 omega e' + omega^2 e) + what motion, gravity and friction take.

    motion: q as it is seen, qd* and qdd* (n,). error, lag: e and e', those of position and velocity. Where viscous
    friction alone makes a joint slower than omega, a stiffness of viscous * omega beside it.
    """
    q, qd, qdd = motion
    mass = dynamics.mass_matrix(q)
    slow = np.where(friction.viscous > np.diag(mass) * omega, friction.viscous * omega, 0.0)
    torque = mass @ (qdd + 2 * omega * lag + omega**2 * error) + slow * error
    return np.asarray(torque + dynamics.nonlinear_effects(q, qd) + friction(qd))


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
    tick, samples = 1.0 / tracking.control_rate, _samples_of_a_tick(settings)
    # passive joints have no motor: the pseudo-inverse leaves them alone
    to_motors = np.linalg.pinv(inputs)
    state = np.concatenate([path.q[0], np.zeros(n)])
    # begun at the arm's weight, as a brake is released: else it falls until the integral has grown
    integral = dynamics.nonlinear_effects(*np.split(state, 2))
    previous = seen = _seen(state[:n], tracking)
    states, torques = [], []
    within = np.arange(samples + 1) / settings.simulation.sample_rate
    for k, (q, qd, qdd) in enumerate(zip(path.q, path.qd, path.qdd, strict=True)):
        previous, seen = seen, _seen(state[:n], tracking)
        error, lag = q - seen, qd - (seen - previous) / tick
        integral = integral + tick * gains.integral * error
        effort = gains.proportional * error + gains.derivative * lag + integral
        if tracking.control == "computed-torque":
            effort = computed_torque(dynamics, friction, (seen, qd, qdd), error, lag, omega)
        torques.append(to_motors @ effort)
        torque = np.tile(inputs @ torques[-1], (samples + 1, 1))
        passed = rollout(dynamics, state, k * tick + within, torque, TUNING.seen_loosening)
        states.append(passed[:-1])
        state = passed[-1]
    true = np.concatenate(states)
    t = np.arange(len(true)) / settings.simulation.sample_rate
    return Recording(t, true, _seen(true[:, :n], tracking), np.repeat(torques, samples, axis=0))


def measured(recording: Recording, tracking: TrackingSettings, name: str) -> Trajectory:
    """Return what is logged of a motion: filtered positions, their differences, and the torques."""
    sample_rate = 1.0 / (recording.t[1] - recording.t[0])
    q = low_pass_regular(recording.encoders, sample_rate, tracking.cutoff)
    return Trajectory(recording.t, q, np.gradient(q, recording.t, axis=0), recording.tau, name)


def _seen(q: np.ndarray, tracking: TrackingSettings) -> np.ndarray:
    """Return the nearest whole steps of the encoders."""
    return np.round(q / tracking.resolution) * tracking.resolution


def _samples_of_a_tick(settings: Settings) -> int:
    """Return how many samples the controller holds a torque."""
    sample_rate, control_rate = settings.simulation.sample_rate, settings.tracking.control_rate
    count = round(sample_rate / control_rate)
    if count < 1 or abs(count * control_rate - sample_rate) > 1e-9 * sample_rate:
        raise SettingsError(
            f"{control_rate:g} Hz beside samples at {sample_rate:g} Hz", element="tracking.control_rate",
            expected="a rate of which simulation.sample_rate is a multiple",
        )  # fmt: skip
    return count
