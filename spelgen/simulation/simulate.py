"""Simulate logs of an arm, in memory, by the protocol that its settings name."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from spelgen.arm.configured_arm import ConfiguredArm
from spelgen.settings.messages import validated
from spelgen.settings.settings import Settings
from spelgen.settings.simulation import ControlledSimulation, ServoSimulation, SimulationSettings
from spelgen.settings.yaml_document import Document
from spelgen.simulation.protocol import SimulatedLogs
from spelgen.simulation.random_inputs import random_inputs
from spelgen.simulation.servo_motions import servo_motions
from spelgen.simulation.tracking import track
from spelgen.simulation.tuning import TUNING

PROTOCOLS = {"random-inputs": random_inputs, "tracking": track}


def simulate(
    arm: ConfiguredArm,
    *,
    trajectories: int | None = None,
    duration: float | None = None,
    sample_rate: float | None = None,
    test_fraction: float | None = None,
    seed: int | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> SimulatedLogs:
    """Return simulated logs of the arm: all trajectories in a list, `train` and `test` apart.

    What is not given is as `simulation` in the settings beside the URDF says: how many trajectories, of which
    duration [s] and sample rate [Hz], the part kept for testing, the seed. Same arguments, same logs. progress:
    called with (trajectories done, all) after each one. Mimic joints move as the URDF says.
    Raises ArmError without inertials, SettingsError for values that cannot be or a joint without a range of initial
    positions, and RunError when the motion cannot be integrated.
    """
    arguments = {
        "trajectories": trajectories, "duration": duration, "sample_rate": sample_rate,
        "test_fraction": test_fraction, "seed": seed,
    }  # fmt: skip
    changes = {key: value for key, value in arguments.items() if value is not None}
    values = arm.settings.simulation.model_dump(exclude_unset=True) | changes
    changed = validated(SimulationSettings, values, Document(Path("simulate"), None))
    settings = _controlled(arm.settings.model_copy(update={"simulation": changed}))
    run = servo_motions if settings.input == "position" else PROTOCOLS[settings.simulation.protocol]
    return run(arm.arm, settings, arm.actuation.drives(), progress=progress or (lambda done, total: None))


def _controlled(settings: Settings) -> Settings:
    """The settings, with the arm controlled where nobody says how it is driven: under random torques it would fall."""
    simulation, tracking = settings.simulation, settings.tracking
    if settings.input == "position":
        usual = ServoSimulation(**simulation.model_dump(exclude_unset=True))
        return settings.model_copy(update={"simulation": usual})
    is_driven = {"protocol", "inputs"} & simulation.model_fields_set
    if is_driven or any(joint.inputs for joint in settings.joints.values()):
        return settings
    simulation = ControlledSimulation(**simulation.model_dump(exclude_unset=True))
    rate = simulation.sample_rate
    usual_tracking: dict[str, object] = {
        "control": "computed-torque",
        "paths": "own" if {"amplitude", "frequency"} & tracking.model_fields_set else "excitation",
        "control_rate": rate / max(1, round(rate / TUNING.control_rate)),
        "cutoff": min(tracking.cutoff, rate / 4),
    }
    tracking = tracking.model_copy(update=usual_tracking | tracking.model_dump(exclude_unset=True))
    return settings.model_copy(update={"simulation": simulation, "tracking": tracking})
