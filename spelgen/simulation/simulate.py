"""Arm + Settings -> logs: held random torques, friction, and an integration whose error is measured.

    M(q) qdd + bias(q, qd) = tau - friction(qd)        tau held between samples

Joint limits are not enforced: there are no end stops.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.integrate import DOP853

from spelgen.arm.arm import Arm, Coordinate
from spelgen.dynamics.pinocchio_arm import arm_dynamics
from spelgen.dynamics.pinocchio_dynamics import PinocchioDynamics
from spelgen.errors import RunError, SettingsError, collect
from spelgen.logs.read import Trajectory
from spelgen.settings.joint import JointSettings
from spelgen.settings.settings import Settings

RTOL, ATOL = 1e-13, 1e-15
LOOSER = 100.0  # tolerances of the second integration, which the first is compared with


@dataclass(frozen=True)
class SimulationResult:
    """Simulated logs, split by trajectory.

    integration_error: largest difference of any logged q or qd [rad, rad/s; m, m/s] to the same trajectory
        integrated with 100 times larger tolerances; the error of what is logged is smaller still.
    """

    train: tuple[Trajectory, ...]
    test: tuple[Trajectory, ...]
    integration_error: float


@dataclass(frozen=True, eq=False)
class Friction:
    """Friction of n joints, each array (n,), in Nm and rad/s, N and m/s for prismatic joints.

    forward, backward: Coulomb torque for qd > 0 (not negative) and for qd < 0 (not positive).
    velocity: width of the tanh in place of Coulomb friction's jump.
    """

    viscous: np.ndarray
    forward: np.ndarray
    backward: np.ndarray
    velocity: float

    def __call__(self, qd: np.ndarray) -> np.ndarray:
        """Return the torque (..., n) that friction takes at velocity qd (..., n):

            viscous qd + s (forward - backward)/2 + s^2 (forward + backward)/2,    s = tanh(qd / velocity)

        The last two terms tend to `forward` and `backward` on the two sides. All is smooth, 0 at rest, and
        never drives: its product with qd is not negative.
        """
        s = np.tanh(qd / self.velocity)
        even, odd = self.forward + self.backward, self.forward - self.backward
        return self.viscous * qd + 0.5 * s * (odd + s * even)

    @property
    def widths(self) -> np.ndarray:
        """Velocity (n,) within which the friction of each joint jumps, infinite where it does not."""
        return np.where(self.forward > self.backward, self.velocity, np.inf)


def make_friction(arm: Arm, settings: Settings) -> Friction:
    """Return the friction of the arm: a joint's settings where it has some, else its URDF's <dynamics>."""
    joints = [_losses(coordinate, settings) for coordinate in arm.coordinates]
    return Friction(
        viscous=np.array([joint.viscous for joint in joints]),
        forward=np.array([joint.coulomb[0] for joint in joints]),
        backward=np.array([joint.coulomb[1] for joint in joints]),
        velocity=settings.simulation.friction_velocity,
    )


def simulate(
    arm: Arm,
    settings: Settings,
    input_matrix: np.ndarray | None = None,
    *,
    progress: Callable[[int, int], None] | None = None,
) -> SimulationResult:
    """Return random-input trajectories of the arm by `settings.simulation`; same settings, same logs.

    Each starts at rest at a random position and has round(duration * rate) + 1 samples; tau[k] acts from t[k]
    to t[k+1]. input_matrix: G (n, n), where the torques drawn and logged are those of motors; the joints get
    G tau. progress: called with (trajectories done, all) after each one.
    Raises ArmError without inertials, SettingsError for a joint without a range of initial positions, and
    RunError when the motion cannot be integrated.
    """
    protocol = settings.simulation
    dynamics, friction = arm_dynamics(arm, settings), make_friction(arm, settings)
    lowest, highest = initial_range(arm, settings)
    torques = [_torques(coordinate, settings) for coordinate in arm.coordinates]
    t = np.arange(round(protocol.duration * protocol.rate) + 1) / protocol.rate
    split_seed, *seeds = np.random.SeedSequence(protocol.seed).spawn(protocol.trajectories + 1)
    trajectories, errors = [], []
    for number, seed in enumerate(seeds):
        random = np.random.default_rng(seed)
        start = np.concatenate([random.uniform(lowest, highest), np.zeros(lowest.size)])
        tau = np.stack([random.choice(choices, size=t.size) for choices in torques], axis=1)
        effect = tau if input_matrix is None else tau @ input_matrix.T
        states = rollout(dynamics, friction, start, t, effect)
        errors.append(np.abs(states - rollout(dynamics, friction, start, t, effect, looser=LOOSER)).max())
        q, qd = np.split(states, 2, axis=1)
        trajectories.append(Trajectory(f"traj_{number:02d}", t, q, qd, tau))
        if progress is not None:
            progress(number + 1, protocol.trajectories)
    tested = _tested(protocol.trajectories, protocol.test_fraction, np.random.default_rng(split_seed))
    return SimulationResult(
        train=tuple(each for number, each in enumerate(trajectories) if number not in tested),
        test=tuple(each for number, each in enumerate(trajectories) if number in tested),
        integration_error=float(max(errors)),
    )


def rollout(
    dynamics: PinocchioDynamics,
    friction: Friction,
    start: np.ndarray,
    t: np.ndarray,
    tau: np.ndarray,
    looser: float = 1.0,
) -> np.ndarray:
    """Return the states (q, qd), (T, 2n), at the times t (T,) [s] from a start (2n,) under tau (T, n).

    Dormand-Prince 8(5,3), begun anew at every sample because tau jumps there. looser: factor on the error
    allowed. Raises RunError where it cannot go on.
    """
    n = tau.shape[1]
    states = np.empty((t.size, 2 * n))
    states[0] = start

    def derivative(_: float, state: np.ndarray) -> np.ndarray:
        qd = state[n:]
        return np.concatenate([qd, dynamics.forward_dynamics(state[:n], qd, held - friction(qd))])

    for k in range(t.size - 1):
        held = tau[k]
        solver = DOP853(derivative, t[k], states[k], t[k + 1], rtol=RTOL * looser, atol=ATOL * looser)
        _finish(solver, friction.widths, stretch=looser**0.125)  # as error control lengthens steps of order 8
        states[k + 1] = solver.y
    return states


def _finish(solver: DOP853, widths: np.ndarray, stretch: float) -> None:
    """Carry a solver of (q, qd) to the end of its interval.

    No step may change a velocity by much more than a quarter of it, or of the width (n,) of its joint's
    friction jump if that is more, times stretch: friction is flat beyond the jump, and the error control
    would not see a reversal between the stages of a long step.
    """
    n, failure = widths.size, None
    while solver.status == "running" and failure is None:
        rate = np.max(np.abs(solver.f[n:]) / np.maximum(widths, np.abs(solver.y[n:])))
        solver.max_step = 0.25 * stretch / rate if rate > 0 else np.inf
        # the step-size control would never come back from a nan
        failure = solver.step() if np.isfinite(solver.f).all() else "an acceleration is not finite"
    if failure is not None:
        cure = "check the inertials; make simulation.duration smaller or simulation.friction_velocity larger"
        raise RunError(f"the motion cannot be integrated beyond t = {solver.t:g} s: {failure}", do=cure)


def _losses(coordinate: Coordinate, settings: Settings) -> JointSettings:
    urdf = JointSettings(viscous=coordinate.damping, coulomb=(coordinate.friction, -coordinate.friction))
    return settings.joints.get(coordinate.name, urdf)


def _torques(coordinate: Coordinate, settings: Settings) -> np.ndarray:
    joint = settings.joint(coordinate.name)
    if coordinate.passive or not joint.actuated:
        return np.zeros(1)
    return np.array(joint.inputs or settings.simulation.inputs)


def initial_range(arm: Arm, settings: Settings) -> tuple[np.ndarray, np.ndarray]:
    """Return the lowest and highest positions (n,) [rad; m] to start from; SettingsError where a joint has none."""
    given = settings.simulation.positions or {}
    ranges, errors = [], []
    for joint in arm.coordinates:
        if joint.name in given:
            ranges.append(given[joint.name])
        elif joint.continuous:
            ranges.append((-np.pi, np.pi))
        elif joint.lower is not None and joint.upper is not None:
            ranges.append((joint.lower, joint.upper))
        else:
            message = "the joint has no limits: give its lowest and highest initial position"
            errors.append(SettingsError(message, element=f"simulation.positions.{joint.name}"))
    collect(errors)
    lowest, highest = np.array(ranges, dtype=float).T
    return lowest, highest


def _tested(count: int, fraction: float, random: np.random.Generator) -> set[int]:
    """Numbers of the trajectories kept for testing; at least one is left to train on."""
    return set(random.permutation(count)[: min(round(fraction * count), count - 1)].tolist())
