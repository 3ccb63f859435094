"""Simulated logs of an arm, in memory. The settings of the arm name the protocol, for example random torques."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from spelgen.arm.actuation import Drives
from spelgen.arm.arm import Chain
from spelgen.arm.configured_arm import Arm
from spelgen.dynamics.pinocchio_arm import arm_dynamics, require_inertials
from spelgen.errors import SettingsError
from spelgen.excitation.trajectory import Motion
from spelgen.logs.trajectory import Trajectory, set_aside
from spelgen.settings.settings import Settings
from spelgen.settings.simulation import ControlledSimulation, ServoSimulation, SimulationSettings
from spelgen.settings.yaml_document import YamlDocument, validated
from spelgen.simulation.integration import rollout
from spelgen.simulation.prescribed import prescribed
from spelgen.simulation.protocol import (
    Progress,
    SimulatedLogs,
    initial_range,
    make_friction,
    sample_times,
    silent,
)
from spelgen.simulation.servo_motions import servo_motions
from spelgen.simulation.tracking import track
from spelgen.simulation.tuning import TUNING


def random_inputs(
    arm: Chain, settings: Settings, drives: Drives | None = None, *, progress: Progress = silent
) -> SimulatedLogs:
    """Return trajectories under random inputs; the same settings give the same logs.

    Each trajectory starts at rest at a random position and has round(duration * sample_rate) + 1 samples; tau[k] acts
    from t[k] to t[k+1]. Raises ArmError without inertials, SettingsError for a joint without a range of initial
    positions, and RunError if the motion cannot be integrated.

    Args:
        arm: The arm.
        settings: `simulation` and `joints` are used.
        drives: Matrices of coupled motors: inputs are motor torques tau, the joint torques are G tau, and friction acts
            on the motors. None: each motor moves its own joint.
        progress: Function called after each trajectory with the number of finished and the number of all trajectories.
    """
    protocol = settings.simulation
    drives = drives or Drives.direct(len(arm.coordinates))
    dynamics = arm_dynamics(arm, settings, make_friction(arm, settings, drives.speeds))
    lowest, highest = initial_range(arm, settings)
    torques = []
    for coordinate in arm.coordinates:
        joint = settings.joint(coordinate.name)
        is_driven = joint.actuated and not coordinate.passive
        torques.append(np.array(joint.inputs or protocol.inputs) if is_driven else np.zeros(1))
    t = sample_times(protocol)
    # Each trajectory has its own random generator, so that the first trajectories are the same for any number of
    # trajectories.
    split, *randoms = np.random.default_rng(protocol.seed).spawn(protocol.trajectories + 1)
    trajectories = []
    for number, random in enumerate(randoms):
        start = np.concatenate([random.uniform(lowest, highest), np.zeros(lowest.size)])
        tau = np.stack([random.choice(choices, size=t.size) for choices in torques], axis=1)
        q, qd = np.split(rollout(dynamics, start, t, tau @ drives.inputs.T), 2, axis=1)
        trajectories.append(Trajectory(t, q, qd, tau, f"traj_{number:02d}"))
        progress(number + 1, protocol.trajectories)
    # The number of test trajectories is bounded, so that at least one trajectory remains for training.
    count = protocol.trajectories
    order = split.permutation(count)
    tests = min(round(protocol.test_fraction * count), count - 1)
    return SimulatedLogs(*set_aside(trajectories, order[:tests]))


PROTOCOLS = {"random-inputs": random_inputs, "tracking": track, "prescribed": prescribed}


def simulate(
    arm: Arm,
    *,
    trajectories: int | None = None,
    duration: float | None = None,
    sample_rate: float | None = None,
    test_fraction: float | None = None,
    seed: int | None = None,
    motions: Sequence[Motion] = (),
    progress: Progress | None = None,
) -> SimulatedLogs:
    """Return simulated logs of the arm: all trajectories, and their split into `train` and `test`.

    Default values are in `simulation` of the arm's settings. The same arguments give the same logs. Mimic joints move
    as the URDF specifies. Raises ArmError without inertials, SettingsError for an invalid value or a joint without a
    range of initial positions, and RunError if the motion cannot be integrated.

    Args:
        arm: The arm, from `load_arm` or `as_built`.
        trajectories: Number of trajectories.
        duration: Duration of each trajectory [s].
        sample_rate: Sample rate [Hz].
        test_fraction: Fraction of the trajectories for testing; with the protocol "tracking", the fraction of each
            trajectory, at its end.
        seed: Seed of all random numbers.
        motions: Motions that the arm performs exactly, (T, n) each; they replace the protocol of the settings.
        progress: Function called after each trajectory with the number of finished and the number of all trajectories.
    """
    arguments = {
        "trajectories": trajectories, "duration": duration, "sample_rate": sample_rate,
        "test_fraction": test_fraction, "seed": seed,
    }  # fmt: skip
    changes = {key: value for key, value in arguments.items() if value is not None}
    values = arm.settings.simulation.model_dump(exclude_unset=True) | changes
    changed = validated(SimulationSettings, values, YamlDocument(Path("simulate"), None))
    settings = _controlled(arm.settings.model_copy(update={"simulation": changed}))
    progress = progress or silent
    require_inertials(arm.chain, arm.robot.path)
    if settings.input == "position":
        if motions:
            raise SettingsError(
                "motions of an arm with position servos", element="input", expected="input: torque",
                do="simulate without motions: commands are random",
            )  # fmt: skip
        return servo_motions(arm.chain, settings, progress)
    drives = arm.actuation.drives()
    if motions:
        return prescribed(arm.chain, settings, drives, motions=motions, progress=progress)
    return PROTOCOLS[settings.simulation.protocol](arm.chain, settings, drives, progress=progress)


def _controlled(settings: Settings) -> Settings:
    """Return the settings, with the protocol "tracking" if they specify neither a protocol nor torques.

    Feedback control is the default, because an arm would fall under random torques that are not chosen for it.
    """
    simulation, tracking = settings.simulation, settings.tracking
    if settings.input == "position":
        servo = ServoSimulation(**simulation.model_dump(exclude_unset=True))
        return settings.model_copy(update={"simulation": servo})
    is_driven = {"protocol", "inputs"} & simulation.model_fields_set
    if is_driven or any(joint.inputs for joint in settings.joints.values()):
        return settings
    simulation = ControlledSimulation(**simulation.model_dump(exclude_unset=True))
    rate = simulation.sample_rate
    defaults = {
        "control": "computed-torque",
        "paths": "own" if {"amplitude", "frequency"} & tracking.model_fields_set else "excitation",
        "control_rate": rate / max(1, round(rate / TUNING.control_rate)),
        "cutoff": min(tracking.cutoff, rate / 4),
    }
    tracking = tracking.model_copy(update=defaults | tracking.model_dump(exclude_unset=True))
    return settings.model_copy(update={"simulation": simulation, "tracking": tracking})
