"""Arm + Settings -> logs: rigid bodies by Pinocchio, drives and friction here, integrated nearly to rounding.

    (M(q) + diag(gear^2 rotor_inertia)) qdd + nle(q, qd) = tau - friction(qd)

with tau held between samples. Joint limits are not enforced: there are no end stops.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.integrate import solve_ivp

from spelgen.arm import Arm, Coordinate
from spelgen.errors import ArmError, RunError, SettingsError, collect
from spelgen.logs import Trajectory
from spelgen.settings import JointSettings, Settings

try:
    import pinocchio as pin
except ImportError as error:
    raise RunError("Pinocchio is not installed", do="pip install 'spelgen[simulate]'") from error

RTOL, ATOL = 1e-13, 1e-15  # of what is logged
LOOSER = 100.0  # the same again with tolerances this much larger: the difference bounds the integration error


@dataclass(frozen=True)
class SimulationResult:
    """Simulated logs, split by trajectory.

    integration_error: largest difference of any logged q or qd [rad, rad/s; m, m/s] to the same trajectory
        integrated at 100 times larger tolerances; the error of what is logged is smaller.
    """

    train: tuple[Trajectory, ...]
    test: tuple[Trajectory, ...]
    integration_error: float


@dataclass(frozen=True, eq=False)
class Engine:
    """An arm of n coordinates for Pinocchio, whose model has one joint for each of the b bodies.

    jacobian (b, n), offset (b,): joint positions = jacobian q + offset (mimic joints share a coordinate).
    direct: bodies and coordinates are the same.
    """

    model: pin.Model
    data: pin.Data
    jacobian: np.ndarray
    offset: np.ndarray
    direct: bool


@dataclass(frozen=True, eq=False)
class Friction:
    """Friction of n joints: viscous, forward (qd > 0: not negative), backward (qd < 0: not positive), all (n,)."""

    viscous: np.ndarray
    forward: np.ndarray
    backward: np.ndarray
    velocity: float

    def __call__(self, qd: np.ndarray) -> np.ndarray:
        """Return the torque (..., n) that is lost at velocity qd (..., n):

            viscous qd + s (forward - backward)/2 + s^2 (forward + backward)/2,    s = tanh(qd / velocity)

        Without the viscous part it tends to `forward` and `backward` on the two sides. It is smooth, 0 at rest,
        and never drives: its product with qd is not negative.
        """
        s = np.tanh(qd / self.velocity)
        even, odd = self.forward + self.backward, self.forward - self.backward
        return self.viscous * qd + 0.5 * s * (odd + s * even)


def pinocchio_model(arm: Arm, settings: Settings) -> pin.Model:
    """Return the arm as a Pinocchio model: per body, in the order of `arm.bodies`, a joint about or along its z.

    Reflected rotor inertia is the model's armature. Raises ArmError when a body has no inertial.
    """
    massless = [body.name for body in arm.bodies if body.inertia is None]
    collect([ArmError("its link has no inertial", element=f"joint {name!r}", do="add one") for name in massless])
    model = pin.Model()
    model.name = arm.name
    model.gravity.linear = np.array(arm.gravity, dtype=float)
    for body in arm.bodies:
        joint = pin.JointModelPZ() if body.kind == "prismatic" else pin.JointModelRZ()
        placement = pin.SE3(np.array(body.rotation, dtype=float), np.array(body.translation, dtype=float))
        index = model.addJoint(body.parent + 1, joint, placement, body.name)
        assert body.inertia is not None
        model.appendBodyToJoint(index, _inertia(np.array(body.inertia, dtype=float)), pin.SE3.Identity())
    model.armature = np.array([_armature(arm, settings, body.name) for body in arm.bodies])
    return model


def engine(arm: Arm, settings: Settings) -> Engine:
    """Return the arm ready for `mass_matrix`, `bias`, `forward_dynamics`; raises ArmError without inertials."""
    model = pinocchio_model(arm, settings)
    jacobian = np.zeros((len(arm.bodies), len(arm.coordinates)))
    for row, body in enumerate(arm.bodies):
        jacobian[row, body.coordinate] = float(body.multiplier)
    offset = np.array([body.offset for body in arm.bodies], dtype=float)
    direct = not offset.any() and np.array_equal(jacobian, np.eye(*jacobian.shape))
    return Engine(model, model.createData(), jacobian, offset, direct)


def mass_matrix(engine: Engine, q: np.ndarray) -> np.ndarray:
    """Return M(q), (n, n), rotors included, at q (n,): K^T M_bodies(K q + offset) K, K the constant Jacobian."""
    upper = np.triu(pin.crba(engine.model, engine.data, engine.jacobian @ q + engine.offset))
    bodies = upper + np.triu(upper, 1).T  # Pinocchio promises the upper triangle only
    return engine.jacobian.T @ bodies @ engine.jacobian


def bias(engine: Engine, q: np.ndarray, qd: np.ndarray) -> np.ndarray:
    """Return the Coriolis, centrifugal and gravity torques (n,) at q, qd (n,); K is constant and adds none."""
    positions = engine.jacobian @ q + engine.offset
    return engine.jacobian.T @ pin.nle(engine.model, engine.data, positions, engine.jacobian @ qd)


def forward_dynamics(engine: Engine, q: np.ndarray, qd: np.ndarray, tau: np.ndarray) -> np.ndarray:
    """Return qdd (n,) under the joint torques tau (n,), friction already taken off."""
    if engine.direct:
        return pin.aba(engine.model, engine.data, q, qd, tau).copy()
    return np.linalg.solve(mass_matrix(engine, q), tau - bias(engine, q, qd))


def simulate(
    arm: Arm, settings: Settings, *, progress: Callable[[int, int], None] | None = None
) -> SimulationResult:
    """Return random-input trajectories of the arm by `settings.simulation`; the same settings give the same logs.

    Every trajectory starts at rest at a random position and has round(duration * rate) + 1 samples; tau[k] acts
    from t[k] to t[k+1]. progress: called with (trajectories done, all) after each one.
    Raises ArmError without inertials, SettingsError for a joint without a range of initial positions, RunError
    when the motion cannot be integrated.
    """
    protocol = settings.simulation
    model, losses = engine(arm, settings), friction(arm, settings)
    lowest, highest = _initial_range(arm, settings)
    torques = [_torques(coordinate, settings) for coordinate in arm.coordinates]
    t = np.arange(round(protocol.duration * protocol.rate) + 1) / protocol.rate
    split_seed, *seeds = np.random.SeedSequence(protocol.seed).spawn(protocol.trajectories + 1)
    trajectories, errors = [], []
    for number, seed in enumerate(seeds):
        random = np.random.default_rng(seed)
        start = np.concatenate([random.uniform(lowest, highest), np.zeros(len(torques))])
        tau = np.stack([random.choice(choices, size=t.size) for choices in torques], axis=1)
        name = f"traj_{number:02d}"
        states = rollout(model, losses, start, t, tau, name=name)
        looser = rollout(model, losses, start, t, tau, name=name, looser=LOOSER)
        errors.append(np.abs(states - looser).max())
        q, qd = np.split(states, 2, axis=1)
        trajectories.append(Trajectory(name, t, q, qd, tau))
        if progress is not None:
            progress(number + 1, protocol.trajectories)
    tested = _tested(protocol.trajectories, protocol.test_fraction, np.random.default_rng(split_seed))
    return SimulationResult(
        train=tuple(x for k, x in enumerate(trajectories) if k not in tested),
        test=tuple(x for k, x in enumerate(trajectories) if k in tested),
        integration_error=float(max(errors)),
    )


def rollout(
    engine: Engine,
    friction: Friction,
    start: np.ndarray,
    t: np.ndarray,
    tau: np.ndarray,
    *,
    name: str = "trajectory",
    looser: float = 1.0,
) -> np.ndarray:
    """Return the states (T, 2n) at the times t (T,) [s] from the state start = (q, qd), (2n,), under tau (T, n).

    Dormand-Prince 8(5,3), restarted at every sample because tau jumps there. Raises RunError where it cannot go on.
    """
    n = tau.shape[1]
    states = np.empty((t.size, 2 * n))
    states[0] = start

    def derivative(_: float, state: np.ndarray) -> np.ndarray:
        qd = state[n:]
        return np.concatenate([qd, forward_dynamics(engine, state[:n], qd, held - friction(qd))])

    for k in range(t.size - 1):
        held = tau[k]
        if not np.isfinite(derivative(t[k], states[k])).all():  # the step-size control would never come back
            place = f"{name} at t={t[k]:g} s"
            raise RunError("an acceleration that is not finite", element=place, do="check the inertials")
        span, tolerances = (t[k], t[k + 1]), {"rtol": RTOL * looser, "atol": ATOL * looser}
        solution = solve_ivp(derivative, span, states[k], method="DOP853", **tolerances)
        if not solution.success:
            raise RunError(
                f"integration stopped: {solution.message}",
                element=f"{name} at t={solution.t[-1]:g} s",
                do="make simulation.duration smaller or simulation.friction_velocity larger",
            )
        states[k + 1] = solution.y[:, -1]
    return states


def friction(arm: Arm, settings: Settings) -> Friction:
    """Return the friction of the arm's joints: the sidecar's where it lists the joint, else that of <dynamics>."""
    joints = [_losses(coordinate, settings) for coordinate in arm.coordinates]
    return Friction(
        viscous=np.array([joint.viscous for joint in joints]),
        forward=np.array([joint.coulomb[0] for joint in joints]),
        backward=np.array([joint.coulomb[1] for joint in joints]),
        velocity=settings.simulation.friction_velocity,
    )


def _losses(coordinate: Coordinate, settings: Settings) -> JointSettings:
    urdf = JointSettings(viscous=coordinate.damping, coulomb=(coordinate.friction, -coordinate.friction))
    return settings.joints.get(coordinate.name, urdf)


def _armature(arm: Arm, settings: Settings, name: str) -> float:
    """Reflected rotor inertia on a body's joint; a mimic joint has no motor."""
    if name not in {coordinate.name for coordinate in arm.coordinates}:
        return 0.0
    joint = settings.joint(name)
    return joint.rotor_inertia * joint.gear**2


def _inertia(parameters: np.ndarray) -> pin.Inertia:
    mass, hx, hy, hz, ixx, ixy, ixz, iyy, iyz, izz = parameters
    if mass == 0.0:  # Pinocchio would divide by it
        return pin.Inertia(0.0, np.zeros(3), np.array([[ixx, ixy, ixz], [ixy, iyy, iyz], [ixz, iyz, izz]]))
    return pin.Inertia.FromDynamicParameters(np.array([mass, hx, hy, hz, ixx, ixy, iyy, ixz, iyz, izz]))


def _torques(coordinate: Coordinate, settings: Settings) -> np.ndarray:
    joint = settings.joint(coordinate.name)
    if coordinate.passive or not joint.actuated:
        return np.zeros(1)
    return np.array(joint.inputs or settings.simulation.inputs)


def _initial_range(arm: Arm, settings: Settings) -> tuple[np.ndarray, np.ndarray]:
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
            place = f"simulation.positions.{joint.name}"
            errors.append(SettingsError("nothing", element=place, expected="[lowest, highest]: no limits"))
    collect(errors)
    lowest, highest = np.array(ranges, dtype=float).T
    return lowest, highest


def _tested(count: int, fraction: float, random: np.random.Generator) -> set[int]:
    """Numbers of the trajectories kept for testing; at least one is left to train on."""
    return set(random.permutation(count)[: min(round(fraction * count), count - 1)].tolist())
