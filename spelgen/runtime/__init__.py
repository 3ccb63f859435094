"""Runtime of emitted modules: the model classes that a module of `spelgen build` uses; PyTorch only."""

from spelgen.runtime.derived_mass import ConstantMass, DenseMass, DerivedMass
from spelgen.runtime.friction_laws import FrictionLaws, SlidingFriction
from spelgen.runtime.motors import MotorInputs, PositionServo
from spelgen.runtime.network_dynamics import DenseFriction, DenseInputDynamics, JointFriction, NetworkDynamics
from spelgen.runtime.networks import MaskedKAN, MaskedMLP
from spelgen.runtime.parts import symmetric
from spelgen.runtime.port_hamiltonian import PortHamiltonian
from spelgen.runtime.residual_terms import ResidualDynamics, ResidualTerms
from spelgen.runtime.rigid_body_dynamics import RigidBodyDynamics
from spelgen.runtime.rows import Constant, Function, Joint, Link, joints_of

__all__ = [
    "Constant", "ConstantMass", "DenseFriction", "DenseInputDynamics", "DenseMass", "DerivedMass", "FrictionLaws",
    "Function", "Joint", "JointFriction", "Link", "MaskedKAN", "MaskedMLP", "MotorInputs",
    "NetworkDynamics", "PortHamiltonian", "PositionServo", "ResidualDynamics", "ResidualTerms", "RigidBodyDynamics",
    "SlidingFriction", "joints_of", "symmetric",
]  # fmt: skip
