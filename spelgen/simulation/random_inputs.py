"""Simulated logs under random torques that are constant between samples."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from spelgen.arm.actuation import Drives
from spelgen.arm.arm import Arm
from spelgen.dynamics.pinocchio_arm import arm_dynamics
from spelgen.logs.trajectory import Trajectory, set_aside
from spelgen.settings.settings import Settings
from spelgen.simulation.integration import rollout
from spelgen.simulation.protocol import SimulatedLogs, initial_range, make_friction


def random_inputs(
    arm: Arm,
    settings: Settings,
    drives: Drives | None = None,
    *,
    progress: Callable[[int, int], None] = lambda done, total: None,
) -> SimulatedLogs:
    """Return trajectories under random inputs; the same settings give the same logs.

    Each trajectory starts at rest at a random position and has round(duration * sample_rate) + 1 samples; tau[k] acts
    from t[k] to t[k+1]. Raises ArmError without inertials, SettingsError for a joint without a range of initial
    positions, and RunError if the motion cannot be integrated.

    Args:
        arm: The arm.
        settings: `simulation` and `joints` are used.
        drives: Matrices of coupled motors: inputs are motor torques, joints get G tau, friction is the motors'.
        progress: Called with (trajectories done, all) after each trajectory.
    """
    protocol = settings.simulation
    dynamics = arm_dynamics(arm, settings, make_friction(arm, settings, drives and drives.speeds))
    lowest, highest = initial_range(arm, settings)
    torques = []
    for coordinate in arm.coordinates:
        joint = settings.joint(coordinate.name)
        is_driven = joint.actuated and not coordinate.passive
        torques.append(np.array(joint.inputs or protocol.inputs) if is_driven else np.zeros(1))
    t = np.arange(round(protocol.duration * protocol.sample_rate) + 1) / protocol.sample_rate
    # one seed per trajectory: the first trajectories do not depend on their number
    split_seed, *seeds = np.random.SeedSequence(protocol.seed).spawn(protocol.trajectories + 1)
    trajectories = []
    for number, seed in enumerate(seeds):
        random = np.random.default_rng(seed)
        start = np.concatenate([random.uniform(lowest, highest), np.zeros(lowest.size)])
        tau = np.stack([random.choice(choices, size=t.size) for choices in torques], axis=1)
        effect = tau if drives is None else tau @ drives.inputs.T
        states = rollout(dynamics, start, t, effect)
        q, qd = np.split(states, 2, axis=1)
        trajectories.append(Trajectory(t, q, qd, tau, f"traj_{number:02d}"))
        progress(number + 1, protocol.trajectories)
    # at least one trajectory remains for training
    count = protocol.trajectories
    order = np.random.default_rng(split_seed).permutation(count)
    tests = min(round(protocol.test_fraction * count), count - 1)
    return SimulatedLogs(*set_aside(trajectories, order[:tests]))
