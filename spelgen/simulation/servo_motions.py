"""Arm + Settings -> logs of an arm under position servos: commands that swing, hold and jump, positions of encoders."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from spelgen.arm.arm import Arm
from spelgen.dynamics.pinocchio_arm import arm_dynamics
from spelgen.dynamics.pinocchio_dynamics import PinocchioDynamics
from spelgen.logs.trajectory import Trajectory
from spelgen.settings.settings import Settings
from spelgen.simulation.friction import Friction, make_friction
from spelgen.simulation.random_inputs import initial_range
from spelgen.simulation.simulated_logs import SimulatedLogs

STEP = 1e-3  # s, at most
SWEEPS = 4  # over the joints, of dry friction
ENCODER = 2 * np.pi / 4096  # rad: a turn in twelve bits; of a sliding joint [m] a tenth of that
WIDEST = 0.6  # rad, m from the middle
LEVEL, SLOWEST, FASTEST = 2.0, 0.05, 1.2  # s; Hz
WAVES = 3
ALLOWED = 5e-3  # rad, m: joints that stick or not by a hair are that far apart


@dataclass(frozen=True, eq=False)
class Held:
    """kp and kd (n,) of servos, their limits, and the friction of their joints."""

    kp: np.ndarray
    kd: np.ndarray
    limit: np.ndarray
    friction: Friction


def servo_motions(
    arm: Arm,
    settings: Settings,
    input_matrix: np.ndarray | None = None,
    *,
    progress: Callable[[int, int], None] | None = None,
) -> SimulatedLogs:
    """Trajectories by `settings.simulation`; same settings, same logs. Arguments and errors as of `random_inputs`."""
    protocol = settings.simulation
    dynamics, held = arm_dynamics(arm, settings), _held(arm, settings)
    lowest, highest = initial_range(arm, settings)
    middle, width = (lowest + highest) / 2, np.minimum((highest - lowest) / 2, WIDEST)
    t = np.arange(round(protocol.duration * protocol.sample_rate) + 1) / protocol.sample_rate
    encoder = np.array([ENCODER if x.kind == "revolute" else ENCODER / 10 for x in arm.coordinates])
    found: list[Trajectory] = []
    error = 0.0
    for number, seed in enumerate(np.random.SeedSequence(protocol.seed).spawn(protocol.trajectories)):
        u = middle + width * _commands(np.random.default_rng(seed), t, len(middle))
        q = _positions(dynamics, held, t, u, protocol.delay, STEP)
        if not number:
            error = float(np.abs(q - _positions(dynamics, held, t, u, protocol.delay, 2 * STEP)).max())
        q = np.round(q / encoder) * encoder
        nothing = np.zeros((len(t), 0))
        found.append(Trajectory(t, q, np.gradient(q, t, axis=0), nothing, f"traj_{number:02d}", u=u))
        if progress is not None:
            progress(number + 1, protocol.trajectories)
    tested = min(round(protocol.test_fraction * len(found)), len(found) - 1)
    return SimulatedLogs(found[: len(found) - tested], found[len(found) - tested :], error, ALLOWED)


def _held(arm: Arm, settings: Settings) -> Held:
    """A servo that nothing is said of is stiff as its effort and late by a twentieth of a second."""
    efforts = np.array([x.effort or 5.0 for x in arm.coordinates])
    known = [settings.joint(x.name).kp for x in arm.coordinates]
    kp = np.array([2 * effort if k is None else k for k, effort in zip(known, efforts, strict=True)])
    return Held(kp, kp / 20, efforts, make_friction(arm, settings))


def _commands(random: np.random.Generator, t: np.ndarray, n: int) -> np.ndarray:
    """(T, n) between -1 and 1: sines about levels that are held for a while."""
    frequencies = np.exp(random.uniform(np.log(SLOWEST), np.log(FASTEST), (WAVES, n)))
    phases = random.uniform(0, 2 * np.pi, (WAVES, n))
    sines = np.sin(2 * np.pi * frequencies * t[:, None, None] + phases).mean(axis=1)
    levels = random.uniform(-1, 1, (int(t[-1] / LEVEL) + 1, n))
    return np.asarray(0.5 * (sines + levels[(t / LEVEL).astype(int)]))


def _positions(
    dynamics: PinocchioDynamics, held: Held, t: np.ndarray, u: np.ndarray, delay: float, longest: float
) -> np.ndarray:
    """Positions (T, n) from rest at the first command: semi-implicit Euler, dry friction as impulses.

    The impulse of a joint's dry friction is the one that stops it, or else its largest one (projected Gauss-Seidel, as
    in physics engines: Catto, Iterative Dynamics with Temporal Coherence, 2005).
    """
    per = int(np.ceil((t[1] - t[0]) / longest))
    h, late = (t[1] - t[0]) / per, round(delay * per / (t[1] - t[0]))
    q, qd = u[0].copy(), np.zeros(u.shape[1])
    friction, found = held.friction, np.empty_like(u)
    damping = np.diag(h / 2 * (held.kd + friction.viscous))  # at a step's middle, as the positions are
    least, most = -h * friction.forward, -h * friction.backward
    for k in range(len(t)):
        found[k] = q
        for step in range(per):
            command = u[max(0, k * per + step - late) // per]
            torque = np.clip(held.kp * (command - q) - held.kd * qd, -held.limit, held.limit)
            force = torque - friction.viscous * qd - dynamics.nonlinear_effects(q, qd)
            inverse = np.linalg.inv(dynamics.mass_matrix(q) + damping)
            qd = _slowed(qd + h * inverse @ force, inverse, least, most)
            q = q + h * qd
    return found


def _slowed(qd: np.ndarray, inverse: np.ndarray, least: np.ndarray, most: np.ndarray) -> np.ndarray:
    """The velocity after dry friction's impulses, each between ``least`` and ``most`` (n,)."""
    impulse = np.zeros_like(qd)
    for _ in range(SWEEPS):
        for k in range(len(qd)):
            wanted = impulse[k] - qd[k] / inverse[k, k]
            change = min(max(wanted, least[k]), most[k]) - impulse[k]
            impulse[k] += change
            qd = qd + inverse[:, k] * change
    return qd
