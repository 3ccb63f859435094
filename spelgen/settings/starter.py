"""The settings file of `spelgen init`: the main keys with their defaults, commented out and explained."""

import json
from collections.abc import Mapping, Sequence
from typing import NamedTuple

from spelgen.labels import UNITS

ARM = """\
## Settings of the arm {urdf}. Each line that begins with one # and a space is a default:
## delete these two characters (also in the line above, where it is indented) and change the value.

## Description of the arm and sources of the values.
# about: ""

## Gravity in the frame of the root link [m/s^2]: turn it for an arm on a wall or under a ceiling.
# gravity: [0.0, 0.0, -9.81]

## Joints that move, from the root to the tip; all others are locked at 0. Or, in place of this line,
## the last link of the arm: tip: {tip}
# moving_joints: {names}

## Commanded and logged input: torque, or position (u) of position servos, as
## of hobby arms. A servo whose kp [Nm/rad] is known: kp, among the drives below.
# input: torque

## Torques (tau) in the logs: of the joints, or of the motors, before the gears: joint or motor.
# torque: joint

## Drives. rotor_inertia [kg m^2] before the gear; gear: motor turns per joint turn; viscous [Nm s/rad] and
## coulomb [Nm], for qd > 0 and for qd < 0, after the gear; actuated: false for a passive joint; gain:
## trained if the factor from logged motor torques to joint torques is to be trained.
# joints:
{drives}
## How this arm's logs are named and measured: docs/logs.md; `spelgen logs LOG --robot ROBOT --suggest FILE`
## drafts the same keys from a log. velocity: differentiated if none is logged; sign: -1 if the sense of the
## log is opposite to the URDF's axis; offset: joint position at the logged value 0 [rad, m].
# logs:
#   velocity: logged
#   columns: {{t: t, trajectory: trajectory, q: "q_{{joint}}", qd: "qd_{{joint}}", tau: "tau_{{joint}}"}}
#   units: {{t: s}}
#   joints:
{logs}
## How `spelgen simulate` drives the arm: tracking, or random-inputs: torques drawn from `inputs` [Nm].
# simulation:
#   {{protocol: tracking, trajectories: 4, duration: 8.0, sample_rate: 125.0, test_fraction: 0.25, seed: 0}}
# tracking: {{control: computed-torque, paths: own, frequency: 0.125, control_rate: 125.0}}

## Defaults of `spelgen train`, which --set replaces: the keys of docs/cli_runs.md.
# training: {{validation_fraction: 0.25, seed: 0}}
"""


class StarterJoint(NamedTuple):
    """A joint of a URDF, for the settings file that `spelgen init` writes.

    joint_type: "revolute" or "prismatic". damping [Nm s/rad, N s/m], friction [Nm, N]: attributes of its <dynamics>.
    """

    name: str
    joint_type: str
    damping: float
    friction: float


def starter(urdf: str, joints: Sequence[StarterJoint], tip: str) -> str:
    """Return the text of a settings file, in which explanations begin with ``##`` and settings with ``# ``.

    urdf: name of the URDF. joints: moving joints from the root to the tip. tip: name of the last link.
    """
    drives, logs = "", ""
    for joint in joints:
        drive = {
            "rotor_inertia": 0.0, "gear": 1.0, "viscous": joint.damping,
            "coulomb": [joint.friction, -joint.friction], "actuated": True, "gain": "known",
        }  # fmt: skip
        units = UNITS[joint.joint_type]
        log = {
            "name": joint.name, "sign": 1, "offset": 0.0, "torque_offset": 0.0,
            "units": {"q": units.position, "qd": units.velocity, "tau": units.torque},
        }  # fmt: skip
        drives += f"#   {json.dumps(joint.name)}: {_flow(drive)}\n"
        logs += f"#     {json.dumps(joint.name)}: {_flow(log)}\n"
    names = json.dumps([joint.name for joint in joints])
    return ARM.format(urdf=json.dumps(urdf), drives=drives, logs=logs, names=names, tip=json.dumps(tip))


def _flow(keys: Mapping[str, object]) -> str:
    """Return keys and values as a mapping on one line of YAML."""
    pairs = [f"{key}: {_flow(x) if isinstance(x, dict) else json.dumps(x)}" for key, x in keys.items()]
    return f"{{{', '.join(pairs)}}}"
