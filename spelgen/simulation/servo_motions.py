"""Simulated logs of an arm under position servos: commands that are sums of sines and steps, and encoder positions."""

import numpy as np

from spelgen.arm.arm import Chain
from spelgen.dynamics.pinocchio_arm import arm_dynamics
from spelgen.logs.trajectory import Trajectory
from spelgen.settings.settings import Settings
from spelgen.simulation.protocol import Progress, SimulatedLogs, initial_range, make_friction, sample_times
from spelgen.simulation.tuning import TUNING


def servo_motions(arm: Chain, settings: Settings, progress: Progress) -> SimulatedLogs:
    """Return trajectories of an arm under position servos, whose commands are random sines and steps.

    The same settings give the same logs.

    Args:
        arm: The arm.
        settings: `simulation` and `joints` are used.
        progress: Function called after each trajectory with the number of finished and the number of all trajectories.
    """
    protocol = settings.simulation
    lowest, highest = initial_range(arm, settings)
    middle, width = (lowest + highest) / 2, np.minimum((highest - lowest) / 2, TUNING.command_amplitude)
    t = sample_times(protocol)
    resolution = 2 * np.pi / TUNING.encoder_counts
    is_revolute = np.array([x.joint_type == "revolute" for x in arm.coordinates])
    # encoder: step of each joint's encoder, (n,) [rad, m]
    encoder = np.where(is_revolute, resolution, resolution / 10)
    logs = []
    for number, random in enumerate(np.random.default_rng(protocol.seed).spawn(protocol.trajectories)):
        u = middle + width * _commands(random, t, len(middle))
        q = _positions(arm, settings, t, u)
        q = np.round(q / encoder) * encoder
        qd, tau = np.gradient(q, t, axis=0), np.zeros((len(t), 0))
        logs.append(Trajectory(t, q, qd, tau, f"traj_{number:02d}", u=u))
        progress(number + 1, protocol.trajectories)
    return SimulatedLogs.split(logs, protocol.test_fraction)


def _commands(random: np.random.Generator, t: np.ndarray, n: int) -> np.ndarray:
    """Return random commands (T, n) in [-1, 1] at times t (T,) [s]: the mean of sines and a random step signal."""
    low, high = np.log(TUNING.min_command_frequency), np.log(TUNING.max_command_frequency)
    frequencies = np.exp(random.uniform(low, high, (3, n)))
    phases = random.uniform(0, 2 * np.pi, (3, n))
    sines = np.sin(2 * np.pi * frequencies * t[:, None, None] + phases).mean(axis=1)
    levels = random.uniform(-1, 1, (int(t[-1] / TUNING.command_interval) + 1, n))
    return np.asarray(0.5 * (sines + levels[(t / TUNING.command_interval).astype(int)]))


def _positions(arm: Chain, settings: Settings, t: np.ndarray, u: np.ndarray) -> np.ndarray:
    """Return simulated positions (T, n) [rad, m]; the arm starts at rest at the first command.

    Method: semi-implicit Euler with dry friction as impulses. In each step, the impulse of a joint's dry friction stops
    the joint, if the impulse does not exceed Coulomb friction times the step length; otherwise it has this magnitude
    (projected Gauss-Seidel, as in physics engines: Catto, Iterative Dynamics with Temporal Coherence, 2005).

    Args:
        arm: The arm.
        settings: `joints` and `simulation.delay` are used. The default of a servo's gain kp is twice its torque limit
            per rad or m. The gain kd is always `TUNING.servo_lag` times kp.
        t: Times (T,) [s], at equal steps.
        u: Commanded positions (T, n) [rad, m].
    """
    dynamics, friction = arm_dynamics(arm, settings), make_friction(arm, settings)
    limit = np.array([coordinate.effort or TUNING.servo_effort for coordinate in arm.coordinates])
    gains = [settings.joint(coordinate.name).kp for coordinate in arm.coordinates]
    kp = np.array([gain or 2 * effort for gain, effort in zip(gains, limit, strict=True)])
    kd = TUNING.servo_lag * kp
    interval = t[1] - t[0]
    steps = int(np.ceil(interval / TUNING.servo_step))
    h, delay = interval / steps, round(settings.simulation.delay * steps / interval)
    # The damping torque is computed for the mean velocity of a step (implicit midpoint rule). With the damping D and
    # the step length h, its impulse is -h D (qd + dv / 2). The change dv of the velocity is unknown, so the term with
    # dv is added to M dv: the matrix of the linear equations for dv is M + h D / 2.
    damping = np.diag(h / 2 * (kd + friction.viscous))
    impulses = -h * np.stack([friction.forward, friction.backward])
    q, qd, positions = u[0].copy(), np.zeros(u.shape[1]), np.empty_like(u)
    for step in range(steps * len(t)):
        if step % steps == 0:
            positions[step // steps] = q
        command = u[max(0, step - delay) // steps]
        torque = np.clip(kp * (command - q) - kd * qd, -limit, limit)
        force = torque - friction.viscous * qd - dynamics.nonlinear_effects(q, qd)
        inverse = np.linalg.inv(dynamics.mass_matrix(q) + damping)
        qd = _after_dry_friction(qd + h * inverse @ force, inverse, *impulses)
        q = q + h * qd
    return positions


def _after_dry_friction(
    qd: np.ndarray, inverse: np.ndarray, lower: np.ndarray, upper: np.ndarray
) -> np.ndarray:
    """Return the velocity (n,) [rad/s, m/s] after the impulses of dry friction.

    Args:
        qd: Velocity (n,) without dry friction [rad/s, m/s].
        inverse: Inverse of M + h D / 2, (n, n), with the step length h and the damping coefficients D.
        lower, upper: Bounds of the impulses, (n,) [Nm s, N s]: the step length h times Coulomb friction.
    """
    impulse = np.zeros_like(qd)
    for _ in range(TUNING.friction_sweeps):
        for k in range(len(qd)):
            stopping = impulse[k] - qd[k] / inverse[k, k]
            change = min(max(stopping, lower[k]), upper[k]) - impulse[k]
            impulse[k] += change
            qd = qd + inverse[:, k] * change
    return qd
