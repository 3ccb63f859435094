"""The classes that a module written by `spelgen build` is made of; they depend on PyTorch only."""

from spelgen.runtime.constant_mass import ConstantMass
from spelgen.runtime.dense_mass import DenseMass
from spelgen.runtime.derived_mass import DerivedMass
from spelgen.runtime.friction_laws import FrictionLaws, SlidingFriction
from spelgen.runtime.inputs import MotorInputs
from spelgen.runtime.masked_kan import MaskedKAN
from spelgen.runtime.masked_mlp import MaskedMLP
from spelgen.runtime.network_dynamics import DenseInputDynamics, NetworkDynamics
from spelgen.runtime.network_friction import DenseFriction, JointFriction
from spelgen.runtime.parts import symmetric
from spelgen.runtime.port_hamiltonian import PortHamiltonian
from spelgen.runtime.position_servo import PositionServo
from spelgen.runtime.residual_dynamics import ResidualDynamics
from spelgen.runtime.residual_terms import ResidualTerms
from spelgen.runtime.rigid_body_dynamics import RigidBodyDynamics
from spelgen.runtime.rows import Constant, Function, Joint, Link, joints_of

__all__ = [
    "Constant", "ConstantMass", "DenseFriction", "DenseInputDynamics", "DenseMass", "DerivedMass", "FrictionLaws",
    "Function", "Joint", "JointFriction", "Link", "MaskedKAN", "MaskedMLP", "MotorInputs",
    "NetworkDynamics", "PortHamiltonian", "PositionServo", "ResidualDynamics", "ResidualTerms", "RigidBodyDynamics",
    "SlidingFriction", "joints_of", "symmetric",
]  # fmt: skip
