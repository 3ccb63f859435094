"""Simulated logs of a controlled arm: feedback control along paths, encoder positions, velocities by differences.

These logs replace the recordings of the real arm of Wang, Chen and Ding (Sci Rep 15:33179, 2025), which are not
public. Values that the paper does not state are chosen here: gains, phases, encoders and the cutoff of the filter.
"""

from dataclasses import dataclass, replace

import numpy as np

from spelgen.arm.actuation import Drives
from spelgen.arm.arm import Chain
from spelgen.dynamics.friction import DriveFriction
from spelgen.dynamics.pinocchio_arm import arm_dynamics
from spelgen.dynamics.pinocchio_dynamics import PinocchioDynamics
from spelgen.errors import SettingsError
from spelgen.excitation.trajectory import Motion
from spelgen.logs.filtering import low_pass_regular
from spelgen.logs.trajectory import Trajectory
from spelgen.settings.settings import Settings
from spelgen.settings.simulation import TrackingSettings
from spelgen.simulation.integration import rollout
from spelgen.simulation.protocol import Progress, SimulatedLogs, initial_range, make_friction, paths, silent
from spelgen.simulation.tuning import TUNING


@dataclass(frozen=True, eq=False)
class Recording:
    """One motion of T samples: the true states, and the signals of the sensors.

    Attributes:
        t: Times, (T,) [s].
        states: True positions and velocities, (T, 2n) [rad, rad/s; m, m/s].
        encoders: Positions rounded to steps of the encoders, (T, n) [rad, m].
        tau: Motor torques, (T, n) [Nm, N]; tau[k] acts from t[k] to t[k+1].
    """

    t: np.ndarray
    states: np.ndarray
    encoders: np.ndarray
    tau: np.ndarray


def track(
    arm: Chain, settings: Settings, drives: Drives | None = None, *, progress: Progress = silent
) -> SimulatedLogs:
    """Return logs of the arm under feedback control along paths.

    Each recording has the controller gains for the next bandwidth in `tracking.bandwidths`. Depending on
    `tracking.paths`, each recording has its own random path, its own phases of the sines, or its own first point on a
    common path. The last `test_fraction` of each recording is for testing. A log contains encoder positions after a
    zero-phase low-pass filter, velocities by central differences of the filtered positions, and motor torques. Raises
    ArmError without inertials, SettingsError for a joint without a range, and RunError if the motion cannot be
    integrated.

    Args:
        arm: The arm.
        settings: `simulation`, `tracking` and `joints` are used.
        drives: Input matrix and couplings of motors; None: each motor moves its own joint.
        progress: Function called after each trajectory with the number of finished and the number of all trajectories.
    """
    protocol = settings.simulation
    drives = drives or Drives.direct(len(arm.coordinates))
    friction = make_friction(arm, settings, drives.speeds)
    dynamics = arm_dynamics(arm, settings, friction)
    middle = np.mean(initial_range(arm, settings), axis=0)
    samples = round(protocol.duration * protocol.sample_rate)
    count = -(-samples // _samples_of_a_tick(settings))
    ticks = np.arange(count) * (1.0 / settings.tracking.control_rate)
    train, test = [], []
    for number, path in enumerate(paths(arm, settings, ticks)):
        bandwidth = settings.tracking.bandwidths[number % len(settings.tracking.bandwidths)]
        # The gains of a joint's controller are computed from the inertia at joint j while all other joints move freely,
        # which is 1 / (M^-1)_jj.
        inertia = 1 / np.diag(np.linalg.inv(dynamics.mass_matrix(middle)))
        recording = record(dynamics, friction, drives.inputs, path, settings, inertia, 2 * np.pi * bandwidth)
        log = measured(recording, settings.tracking, f"traj_{number:02d}")
        cut = max(1, len(log) - round(protocol.test_fraction * len(log)))
        train.append(log[:cut])
        if cut < len(log):
            test.append(replace(log[cut:], name=f"{log.name}_end"))
        progress(number + 1, protocol.trajectories)
    return SimulatedLogs(train, test)


def record(
    dynamics: PinocchioDynamics,
    friction: DriveFriction,
    inputs: np.ndarray,
    path: Motion,
    settings: Settings,
    inertia: np.ndarray,
    omega: float,
) -> Recording:
    """Return the recording of a controlled motion along a path. The arm starts at rest, in equilibrium with gravity.

    The controller reads the encoders at each tick of its clock, and its torques are constant between ticks. The
    controller is a PID controller per joint or, for `tracking.control: computed-torque`, inverse-dynamics control with
    the true parameters of the arm (Siciliano et al., Robotics, 2009, 8.5.2):

        M (qdd* + 2 omega e' + omega^2 e) + h(q, qd*) + friction(qd*)

    with the position error e = q* - q, and h: Coriolis, centrifugal and gravity torques. Friction is compensated at the
    desired velocity only, so the viscous friction D e' of a joint remains as additional damping. If D > M_jj omega,
    this damping would dominate and slow the decay of e down. In this case the torque D omega e is added: e then decays
    with the time constant 1 / omega.

    Args:
        dynamics: The arm, with friction.
        friction: Friction of the arm, as used by the controller.
        inputs: Input matrix G (n, n): joint torques = G times motor torques.
        path: Desired motion q*, qd*, qdd* at the ticks of the controller.
        settings: `simulation` and `tracking` are used.
        inertia: Inertias (n,) [kg m^2, kg] of the joints, which determine the gains of the PID controllers.
        omega: Natural frequency of the position loop [rad/s].
    """
    tracking, n = settings.tracking, path.q.shape[1]
    tick, samples = 1.0 / tracking.control_rate, _samples_of_a_tick(settings)
    # Without the integral term the characteristic polynomial of the position loop is s^2 + 2 omega s + omega^2. The
    # double pole -omega gives no overshoot.
    proportional, derivative = inertia * omega**2, 2 * inertia * omega
    integral_gain = TUNING.integral_gain * inertia * omega**3
    # Passive joints have no motor, so G is singular: the pseudo-inverse ignores the desired torque at these joints.
    to_motors = np.linalg.pinv(inputs)
    state = np.concatenate([path.q[0], np.zeros(n)])
    # The integral term starts with the gravity torque, so that the arm does not fall at the start.
    integral = dynamics.nonlinear_effects(*np.split(state, 2))
    previous = encoders = quantized(state[:n], tracking)
    states, torques = [], []
    within = np.arange(samples + 1) / settings.simulation.sample_rate
    for k, (q, qd, qdd) in enumerate(zip(path.q, path.qd, path.qdd, strict=True)):
        previous, encoders = encoders, quantized(state[:n], tracking)
        # The measured velocity is the difference of encoder positions divided by the tick, as in a servo drive.
        error, velocity_error = q - encoders, qd - (encoders - previous) / tick
        integral = integral + tick * integral_gain * error
        effort = proportional * error + derivative * velocity_error + integral
        if tracking.control == "computed-torque":
            mass = dynamics.mass_matrix(encoders)
            # If viscous friction v dominates, an added stiffness k gives v de/dt = -k e for the position error e. The
            # error then decays with the time constant v / k, which is 1 / omega for k = v omega.
            slow = np.where(friction.viscous > np.diag(mass) * omega, friction.viscous * omega, 0.0)
            effort = mass @ (qdd + 2 * omega * velocity_error + omega**2 * error) + slow * error
            effort = effort + dynamics.nonlinear_effects(encoders, qd) + friction(qd)
        torques.append(to_motors @ effort)
        torque = np.tile(inputs @ torques[-1], (samples + 1, 1))
        passed = rollout(dynamics, state, k * tick + within, torque, TUNING.seen_loosening)
        states.append(passed[:-1])
        state = passed[-1]
    true = np.concatenate(states)
    t = np.arange(len(true)) / settings.simulation.sample_rate
    return Recording(t, true, quantized(true[:, :n], tracking), np.repeat(torques, samples, axis=0))


def measured(recording: Recording, tracking: TrackingSettings, name: str) -> Trajectory:
    """Return the log of a recording: low-pass filtered positions, velocities by central differences, and torques.

    tracking: settings with the cutoff frequency of the filter. name: name of the log.
    """
    sample_rate = 1.0 / (recording.t[1] - recording.t[0])
    q = low_pass_regular(recording.encoders, sample_rate, tracking.cutoff)
    return Trajectory(recording.t, q, np.gradient(q, recording.t, axis=0), recording.tau, name)


def quantized(q: np.ndarray, tracking: TrackingSettings) -> np.ndarray:
    """Return positions q (T, n) or (n,), rounded to the resolution of the encoders in the settings ``tracking``."""
    return np.round(q / tracking.resolution) * tracking.resolution


def _samples_of_a_tick(settings: Settings) -> int:
    """Return the number of samples per tick of the controller. Raises SettingsError if the ratio is no integer."""
    sample_rate, control_rate = settings.simulation.sample_rate, settings.tracking.control_rate
    count = round(sample_rate / control_rate)
    if count < 1 or abs(count * control_rate - sample_rate) > 1e-9 * sample_rate:
        raise SettingsError(
            f"{control_rate:g} Hz with samples at {sample_rate:g} Hz", element="tracking.control_rate",
            expected="a rate of which simulation.sample_rate is a multiple",
        )  # fmt: skip
    return count
