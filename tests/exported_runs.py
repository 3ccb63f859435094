"""Models and run folders for export tests; all parameters are random, so that no term of the model is zero."""

import contextlib
import re
from pathlib import Path

import torch
from emitted import ROBOTS

from spelgen.arm.configured_arm import load_arm
from spelgen.emission.build import build
from spelgen.fitting.fitted import Fit
from spelgen.fitting.run_folder import RunFolder
from spelgen.fitting.run_record import Checkpoint, Record

COUPLED = """<robot name="2 fast; } int main( /* */"><link name="base"/>
<link name="a"><inertial><origin xyz="0.1 0 0.2"/><mass value="2"/>
<inertia ixx="0.1" iyy="0.2" izz="0.15" ixy="0.01" ixz="0" iyz="0"/></inertial></link>
<link name="b"><inertial><origin xyz="0 0.1 0.1"/><mass value="1"/>
<inertia ixx="0.02" iyy="0.03" izz="0.02" ixy="0" ixz="0" iyz="0.001"/></inertial></link>
<link name="c"><inertial><origin xyz="0.1 0 0"/><mass value="0.5"/>
<inertia ixx="0.01" iyy="0.01" izz="0.01" ixy="0" ixz="0" iyz="0"/></inertial></link>
<link name="d"><inertial><origin xyz="0 0 0.1"/><mass value="0.5"/>
<inertia ixx="0.01" iyy="0.01" izz="0.01" ixy="0" ixz="0" iyz="0"/></inertial></link>
<joint name="shoulder" type="revolute"><parent link="base"/><child link="a"/><origin rpy="0.3 0 0"/><axis xyz="0 1 0"/>
<limit lower="-2" upper="2" effort="50" velocity="2"/></joint>
<joint name="slide" type="prismatic"><parent link="a"/><child link="b"/><origin xyz="0.2 0 0" rpy="0 0.7 0"/>
<axis xyz="1 0 0"/><limit lower="0" upper="0.5" effort="50" velocity="1"/></joint>
<joint name="wrist" type="continuous"><parent link="b"/><child link="c"/><axis xyz="0 0 1"/></joint>
<joint name="follower" type="revolute"><parent link="c"/><child link="d"/><origin xyz="0.1 0 0"/><axis xyz="1 0 0"/>
<limit lower="-3" upper="3" effort="1" velocity="9"/><mimic joint="slide" multiplier="-2" offset="0.4"/></joint>
</robot>"""
"""A follower, motors and a passive joint, and a name that would be code."""
MOTORS = """torque: motor
gravity: [1, 2, -9]
joints: {shoulder: {gear: 50}, slide: {gear: 20, gain: trained}, wrist: {actuated: false}}
"""


def moved_model(robot, preset, size=0.2):
    """Return a robot's model; a normal random number of standard deviation `size` is added to each parameter."""
    model = build(ROBOTS / f"{robot}.urdf", preset)
    random = torch.Generator().manual_seed(0)
    with torch.no_grad():
        for parameter in model.parameters():
            parameter += size * torch.randn(parameter.shape, dtype=torch.float64, generator=random)
    return model.requires_grad_(False)


def arm_of(robot):
    return load_arm(ROBOTS / f"{robot}.urdf")


def readme_results(files, folder: Path):
    """Run the Python example of an exported README with all inputs set to one; return {name of a variable: value}.

    files: {name: content} of the export.
    """
    for name, content in files.items():
        (folder / name).write_bytes(content)
    (code,) = re.findall(r"```python\n(.*?)```", files["README.md"].decode(), re.DOTALL)
    names = {}
    with contextlib.chdir(folder):
        exec(
            re.sub(r"(?<=^q = qd = qdd = tau = dq = )(np|torch)\.zeros", r"\1.ones", code, flags=re.M), names
        )
    return names


def saved_run(model, urdf, folder: Path) -> RunFolder:
    """Write a run folder with all files of `spelgen train` for a model that was not trained. urdf: path of its URDF."""
    record = {"robot": urdf.stem, "objective": "torque", "config": {}, "preprocessing": {}, "mapping": {}}
    record |= {"joints": [], "validation_fraction": 0.25, "seed": 0, "data_digest": ""}
    record |= {"training": [], "validation": []}
    checkpoint = dict.fromkeys(("epoch", "step", "best_epoch", "best_loss", "rollbacks", "seconds"), 0)
    checkpoint |= {"learning_rate_factor": 1.0, "substeps": 1, "momentum_done": True, "best_weights": {}}
    fit = Fit(
        model, (), (), None, Record.model_validate(record), Checkpoint.model_validate(checkpoint), {}, urdf
    )
    return RunFolder(fit.save(folder / "run"))


def run_folder(robot, preset, folder: Path) -> RunFolder:
    """Write the run folder of a robot's model with randomly changed parameters (`moved_model`)."""
    return saved_run(moved_model(robot, preset), ROBOTS / f"{robot}.urdf", folder)
