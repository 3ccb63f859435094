"""The function ``build``: an untrained model in memory from a URDF or a loaded arm."""

from pathlib import Path

from spelgen.arm.configured_arm import Arm
from spelgen.design import Design
from spelgen.emission.assemble import ArmModel, assemble
from spelgen.emission.specify import make_spec
from spelgen.urdf.robot import Assume


def build(
    arm: Arm | str | Path,
    preset: str | Path | Design = "hybrid",
    *,
    width: int = 64,
    depth: int = 2,
    assume: Assume = "kinematics",
    seed: int = 0,
) -> ArmModel:
    """Return the model tailored to an arm, untrained; ``model.spec`` is its specification.

    Args:
        arm: the result of ``load_arm``, or the path of a URDF.
        preset: name of a preset, path of a YAML file with a design, or a ``Design``.
        width, depth: number of units of each hidden layer of networks, and number of hidden layers.
        assume: ``kinematics``: the structure is valid for any inertial parameters; ``inertials``: it is valid only for
            the inertial parameters of the URDF.
        seed: seed of the random initial weights of networks.

    Raises the errors of ``load_arm``, and SettingsError for an inconsistent design.
    """
    return assemble(make_spec(arm, preset, width=width, depth=depth, assume=assume), seed)
