"""The classes that a module written by `spelgen build` is made of; they depend on PyTorch only."""

from spelgen.runtime.constant_mass import ConstantMass
from spelgen.runtime.dense_friction import DenseFriction
from spelgen.runtime.dense_input import DenseInputDynamics
from spelgen.runtime.dense_mass import DenseMass
from spelgen.runtime.derived_mass import DerivedMass
from spelgen.runtime.friction_laws import FrictionLaws
from spelgen.runtime.inputs import MotorInputs
from spelgen.runtime.joint_friction import JointFriction
from spelgen.runtime.masked_kan import MaskedKAN
from spelgen.runtime.masked_mlp import MaskedMLP
from spelgen.runtime.network_dynamics import NetworkDynamics
from spelgen.runtime.port_hamiltonian import PortHamiltonian
from spelgen.runtime.position_servo import PositionServo
from spelgen.runtime.residual_dynamics import ResidualDynamics
from spelgen.runtime.residual_terms import ResidualTerms
from spelgen.runtime.rigid_body_dynamics import RigidBodyDynamics
from spelgen.runtime.rows import Constant, Function, Joint, Link, joints_of
from spelgen.runtime.sliding_friction import SlidingFriction
from spelgen.runtime.symmetric import symmetric

__all__ = [
    "Constant", "ConstantMass", "DenseFriction", "DenseInputDynamics", "DenseMass", "DerivedMass", "FrictionLaws",
    "Function", "Joint", "JointFriction", "Link", "MaskedKAN", "MaskedMLP", "MotorInputs",
    "NetworkDynamics", "PortHamiltonian", "PositionServo", "ResidualDynamics", "ResidualTerms", "RigidBodyDynamics",
    "SlidingFriction", "joints_of", "symmetric",
]  # fmt: skip
