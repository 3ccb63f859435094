"""Simulate logs of an arm under position servos: commands that swing, hold and jump, positions of encoders."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from spelgen.arm.actuation import Drives
from spelgen.arm.arm import Arm
from spelgen.dynamics.pinocchio_arm import arm_dynamics
from spelgen.logs.trajectory import Trajectory
from spelgen.settings.settings import Settings
from spelgen.simulation.protocol import SimulatedLogs, initial_range, make_friction
from spelgen.simulation.tuning import SERVOS as TUNING

SWEEPS = 4  # over the joints, of dry friction
ENCODER = 2 * np.pi / 4096  # rad: a turn in twelve bits; of a sliding joint [m] a tenth of that
EFFORT, LAG = 5.0, 0.05  # Nm, s: of a servo of which nothing is said


def servo_motions(
    arm: Arm,
    settings: Settings,
    drives: Drives | None = None,
    *,
    progress: Callable[[int, int], None] = lambda done, total: None,
) -> SimulatedLogs:
    """Return trajectories by `settings.simulation`; same settings, same logs.

    Arguments and errors as of `random_inputs`.
    """
    protocol = settings.simulation
    lowest, highest = initial_range(arm, settings)
    middle, width = (lowest + highest) / 2, np.minimum((highest - lowest) / 2, TUNING.widest)
    t = np.arange(round(protocol.duration * protocol.sample_rate) + 1) / protocol.sample_rate
    encoder = np.array([ENCODER if x.kind == "revolute" else ENCODER / 10 for x in arm.coordinates])
    logs: list[Trajectory] = []
    for number, seed in enumerate(np.random.SeedSequence(protocol.seed).spawn(protocol.trajectories)):
        u = middle + width * _commands(np.random.default_rng(seed), t, len(middle))
        q = _positions(arm, settings, t, u)
        q = np.round(q / encoder) * encoder
        qd, tau = np.gradient(q, t, axis=0), np.zeros((len(t), 0))
        logs.append(Trajectory(t, q, qd, tau, f"traj_{number:02d}", u=u))
        progress(number + 1, protocol.trajectories)
    trained = len(logs) - min(round(protocol.test_fraction * len(logs)), len(logs) - 1)
    return SimulatedLogs(logs[:trained], logs[trained:])


def _commands(random: np.random.Generator, t: np.ndarray, n: int) -> np.ndarray:
    """Return (T, n) between -1 and 1: sines about levels that are held for a while."""
    low, high = np.log(TUNING.lowest_frequency), np.log(TUNING.highest_frequency)
    frequencies = np.exp(random.uniform(low, high, (3, n)))
    phases = random.uniform(0, 2 * np.pi, (3, n))
    sines = np.sin(2 * np.pi * frequencies * t[:, None, None] + phases).mean(axis=1)
    levels = random.uniform(-1, 1, (int(t[-1] / TUNING.held_level) + 1, n))
    return np.asarray(0.5 * (sines + levels[(t / TUNING.held_level).astype(int)]))


def _positions(arm: Arm, settings: Settings, t: np.ndarray, u: np.ndarray) -> np.ndarray:
    """Return positions (T, n) from rest at the first command: semi-implicit Euler, dry friction as impulses.

    Servos of which nothing is said are stiff as their effort and late by `LAG`. The impulse of a joint's dry friction
    is the one that stops it, or else its largest one (projected Gauss-Seidel, as in physics engines: Catto, Iterative
    Dynamics with Temporal Coherence, 2005).
    """
    dynamics, friction = arm_dynamics(arm, settings), make_friction(arm, settings)
    limit = np.array([coordinate.effort or EFFORT for coordinate in arm.coordinates])
    kp = 2 * limit
    for joint, coordinate in enumerate(arm.coordinates):
        kp[joint] = settings.joint(coordinate.name).kp or kp[joint]
    kd = LAG * kp
    interval = t[1] - t[0]
    steps = int(np.ceil(interval / TUNING.step))
    h, late = interval / steps, round(settings.simulation.delay * steps / interval)
    damping = np.diag(h / 2 * (kd + friction.viscous))  # at a step's middle, as the positions are
    impulses = -h * np.stack([friction.forward, friction.backward])
    q, qd, positions = u[0].copy(), np.zeros(u.shape[1]), np.empty_like(u)
    for step in range(steps * len(t)):
        if step % steps == 0:
            positions[step // steps] = q
        command = u[max(0, step - late) // steps]
        torque = np.clip(kp * (command - q) - kd * qd, -limit, limit)
        force = torque - friction.viscous * qd - dynamics.nonlinear_effects(q, qd)
        inverse = np.linalg.inv(dynamics.mass_matrix(q) + damping)
        qd = _slowed(qd + h * inverse @ force, inverse, *impulses)
        q = q + h * qd
    return positions


def _slowed(qd: np.ndarray, inverse: np.ndarray, least: np.ndarray, most: np.ndarray) -> np.ndarray:
    """Return the velocity after dry friction's impulses, each between ``least`` and ``most`` (n,)."""
    impulse = np.zeros_like(qd)
    for _ in range(SWEEPS):
        for k in range(len(qd)):
            stopping = impulse[k] - qd[k] / inverse[k, k]
            change = min(max(stopping, least[k]), most[k]) - impulse[k]
            impulse[k] += change
            qd = qd + inverse[:, k] * change
    return qd
