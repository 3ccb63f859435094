"""Simulate recordings of motions that the arm performs exactly: torques by inverse dynamics, with friction hysteresis.

Prescribed motion needs no controller and no integration. Dry friction may therefore have presliding hysteresis, whose
stiff bristles would require steps of microseconds in an integrator.
"""

from collections.abc import Sequence
from functools import partial
from pathlib import Path

import numpy as np
import pyarrow as pa

from spelgen.arm.actuation import Drives
from spelgen.arm.arm import Chain
from spelgen.dynamics.bristles import BristleReach, bristles_along
from spelgen.dynamics.friction import DriveFriction
from spelgen.dynamics.pinocchio_arm import arm_dynamics
from spelgen.errors import LogError, SettingsError, in_one_line
from spelgen.excitation.trajectory import Motion, motion_columns
from spelgen.files import require_regular_file
from spelgen.logs.csv_files import csv_table
from spelgen.settings.settings import Settings
from spelgen.simulation.protocol import Progress, SimulatedLogs, make_friction, paths, sample_times, silent
from spelgen.simulation.tracking import Recording, measured, quantized
from spelgen.simulation.tuning import AS_BUILT, TUNING


def read_motion(file: Path, joints: Sequence[str]) -> Motion:
    """Return the motion in a CSV file with the columns `t`, and `q_`, `qd_`, `qdd_` per joint.

    Raises LogError for a file without these columns, for a value that is no finite number, for times that do not
    increase by equal steps from row to row, and for fewer than 20 rows.

    Args:
        file: The file.
        joints: Names of the n joints, in the order of the coordinates.
    """
    require_regular_file(file, LogError)
    columns = motion_columns(joints)
    refused = partial(LogError, file=file, do="`spelgen excite` writes such files for the same arm")
    try:
        table, _, _ = csv_table(file)
        missing = [name for name in columns if name not in table.column_names]
        if missing:
            raise refused(f"no column {', '.join(missing[:3])}", expected="t, q_, qd_ and qdd_ per joint")
        values = np.stack([table[name].cast(pa.float64()).to_numpy() for name in columns], axis=1)
    except (pa.ArrowException, UnicodeError) as error:
        raise refused(f"unreadable ({in_one_line(error)})", expected="CSV of numbers") from error
    too_short = len(values) < TUNING.min_samples
    if too_short or not np.isfinite(values).all():
        got = f"{len(values)} rows" if too_short else "a value that is no finite number"
        raise refused(got, expected=f"{TUNING.min_samples} rows of numbers or more")
    t = values[:, 0]
    steps = np.diff(t)
    if steps.min() <= 0 or np.ptp(steps) > 0.01 * steps.mean():
        row = int(np.argmax(np.abs(steps - np.median(steps))))
        expected = f"equal steps (most are {np.median(steps):g} s)"
        step = f"a step of {steps[row]:g} s after {t[row]:g} s"
        raise refused(step, line=row + 3, element="t", expected=expected)
    return Motion(t - t[0], *np.split(values[:, 1:], 3, axis=1))


def prescribed(
    arm: Chain,
    settings: Settings,
    drives: Drives | None = None,
    *,
    motions: Sequence[Motion] = (),
    progress: Progress = silent,
) -> SimulatedLogs:
    """Return one recording per motion; the last `test_fraction` of them are for testing.

    A recording contains encoder positions after a zero-phase low-pass filter, velocities by central differences of the
    filtered positions, and motor torques with white noise. Raises SettingsError for an arm with a passive joint.

    Args:
        arm: The arm.
        settings: `simulation` and `tracking` are used.
        drives: Input matrix and couplings of motors; None: each motor moves its own joint.
        motions: Positions with two derivatives, (T, n) each; if empty, the motions of `tracking.paths`.
        progress: Function called after each recording with the number of finished and the number of all recordings.
    """
    protocol = settings.simulation
    passive = [joint.name for joint in arm.coordinates if joint.passive]
    if passive:
        raise SettingsError(
            f"the passive joint {passive[0]!r}", element="simulation.protocol", expected="a motor at every joint",
            do="use the protocol random-inputs: no torque moves this joint along a path",
        )  # fmt: skip
    drives = drives or Drives.direct(len(arm.coordinates))
    friction = make_friction(arm, settings, drives.speeds)
    dynamics = arm_dynamics(arm, settings)
    to_motors = np.linalg.inv(drives.inputs)
    if not motions:
        motions = paths(arm, settings, sample_times(protocol))
    logs = []
    for number, motion in enumerate(motions):
        # Each motion has its own random generator, so that its noise does not depend on the other motions.
        rng = np.random.default_rng([protocol.seed, number])
        torque = dynamics.inverse_dynamics(motion.q, motion.qd, motion.qdd)
        torque = torque + friction_along(friction, arm, motion, protocol.presliding)
        tau = torque @ to_motors.T
        # The noise of a motor's torque is proportional to the standard deviation of this torque, because large motors
        # have sensors with large ranges.
        tau = tau + protocol.torque_noise * tau.std(axis=0) * rng.standard_normal(tau.shape)
        states = np.concatenate([motion.q, motion.qd], axis=1)
        recording = Recording(motion.t, states, quantized(motion.q, settings.tracking), tau)
        logs.append(measured(recording, settings.tracking, f"motion_{number:02d}"))
        progress(number + 1, len(motions))
    return SimulatedLogs.split(logs, protocol.test_fraction)


def friction_along(friction: DriveFriction, arm: Chain, motion: Motion, presliding: float) -> np.ndarray:
    """Return the friction torque (T, n) [Nm, N] along a motion.

    Maxwell-slip model (Al-Bender, Lampaert, Swevers, IEEE TAC 50:1883, 2005): elements in parallel, each of which
    sticks up to its own breakaway displacement and then slips. The direction of dry friction is the mean normalised
    deflection of the elements, in [-1, 1].

    Args:
        friction: Coefficients of the drives.
        arm: Arm, whose joint types set the scale of displacements.
        motion: Positions and velocities, (T, n) each.
        presliding: Largest breakaway displacement [rad]; a tenth of it [m] for prismatic joints. 0: no hysteresis.
    """
    if presliding == 0.0:
        return friction(motion.qd)
    scale = np.array([1.0 if kind == "revolute" else 0.1 for kind in arm.joint_types])
    elements = np.geomspace(presliding / AS_BUILT.presliding_span, presliding, AS_BUILT.elements)
    # breakaway: displacements (n, K) [rad, m] of K friction elements per joint
    breakaway = scale[:, None] * elements
    # deflection: (T, n, K) [rad, m] of the K elements of each joint
    deflection = bristles_along(motion.q, BristleReach(breakaway, friction.speeds))
    return friction(motion.qd, (deflection / breakaway).mean(axis=-1))
