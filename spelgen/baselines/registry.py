"""All baselines, in the order in which tables show them."""

from spelgen.baselines.baseline import Baseline
from spelgen.baselines.constant_velocity import ConstantVelocity
from spelgen.baselines.least_squares import IdentifiedArm
from spelgen.baselines.linear_servos import FittedServos
from spelgen.baselines.mujoco_actuators import MujocoActuators
from spelgen.baselines.urdf import UrdfValues

BASELINES: tuple[Baseline, ...] = (
    ConstantVelocity(),
    UrdfValues(),
    IdentifiedArm(),
    MujocoActuators(),
    FittedServos(),
)
