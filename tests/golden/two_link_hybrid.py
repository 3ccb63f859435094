r"""Port-Hamiltonian model of an arm with 2 joints, by `spelgen build`.

Robot "two_link". 2 rigid bodies with trained inertial parameters, friction, and residual terms. Residual
terms are zero until a fit selects them; in M: 1 learned function of q and 2 constants. V depends on joints
1,2.

    import torch
    from two_link_spel import Model  # if this file is two_link_spel.py

    model = Model()  # trained: model.load_state_dict(torch.load("run/model.pt"))
    q, qd, tau = torch.zeros(3, 100, 2, dtype=torch.float64)  # any batch, joints last
    M = model.mass_matrix(q)  # (100, 2, 2)
    qdd = model.forward_dynamics(q, qd, tau)  # (100, 2)
    tau = model.inverse_dynamics(q, qd, qdd)
    V = model.potential_energy(q)  # (100,) [J]
    H = model.hamiltonian(q, model.momentum(q, qd))

Mass matrix: numbers of the joints that each entry depends on; C constant, 0 always zero

     1  2
     2  2   C

Joints, in the order of q, qd and tau

     1  "joint1"  revolute   -3.14159 .. 3.14159 rad, Nm
     2  "joint2"  revolute   -3.14159 .. 3.14159 rad, Nm
"""

import torch
from spelgen.runtime import (
    FrictionLaws,
    Function,
    Joint,
    Link,
    MaskedMLP,
    ResidualDynamics,
    ResidualTerms,
    joints_of,
    symmetric,
)
from torch import Tensor

# Positions [rad, m], speed [rad/s, m/s], friction [Nm, N], armature [kg m^2, kg].
JOINTS = (
    Joint("joint1", "revolute", lower=-3.14159, upper=3.14159, speed=10.0, friction=1.0, armature=0.1),
    Joint("joint2", "revolute", lower=-3.14159, upper=3.14159, speed=10.0, friction=1.0, armature=0.1),
)  # fmt: skip

# In the frame of the joint, z along its axis; position and rotation: of this frame in the parent's [m].
# mass [kg], center_of_mass [m], inertia about it: xx, xy, xz, yy, yz, zz [kg m^2].
LINKS = (
    Link(
        "link1", parent=None, joint="joint1", position=(0.0, 0.0, 0.0), mass=1.0,
        center_of_mass=(0.5, 0.0, 0.0), inertia=(0.6, 0.0, 0.0, 0.6, 0.0, 1.0),
    ),
    Link(
        "link2", parent="link1", joint="joint2", position=(1.0, 0.0, 0.0), mass=1.0,
        center_of_mass=(0.5, 0.0, 0.0), inertia=(0.6, 0.0, 0.0, 0.6, 0.0, 1.0),
    ),
)  # fmt: skip

# The learned functions of q, and the joints that each depends on.
FUNCTIONS = (
    Function(("joint2",)),  # f1: M11, M21 [kg m^2]
)  # fmt: skip


def mass_entries(f1: Tensor, c1: Tensor, c2: Tensor) -> Tensor:
    """Return the residual of M, (..., n, n), from functions of q and constants."""
    m11 = 2 * f1 + c2
    return symmetric([m11], [f1, c1])


class Model(ResidualDynamics):
    """2 rigid bodies with trained inertial parameters, friction, and residual terms."""

    def __init__(self, seed: int = 0, dtype: torch.dtype = torch.float64) -> None:
        generator = torch.Generator().manual_seed(seed)
        super().__init__(
            joints=JOINTS,
            links=LINKS,
            gravity=(0.0, -9.81, 0.0),
            friction=FrictionLaws(
                JOINTS, breakaway={"revolute": (0.0001, 0.0004, 0.0016, 0.0064, 0.025, 0.1)},
            ),
            residuals=ResidualTerms(
                JOINTS, mass_entries, functions=1, constants=2, potential_scale=10.8194,
                network=MaskedMLP(
                    generator, JOINTS, scales=((0.02, 1.0), (0.02, 1.0)), outputs=joints_of(FUNCTIONS),
                    width=64, depth=2, min_units=4,
                ),
                potential=MaskedMLP(
                    generator, JOINTS, scales=((1.0, 0.307), (1.0, 0.307)), outputs=(("joint1", "joint2"),),
                    width=32, depth=2,
                ),
            ),
        )  # fmt: skip
        self.to(dtype)


# The specification, for `spelgen train` and `spelgen check`; they refuse a module that was edited.
SPEC = r"""{"constants":[{"basis":[[1,1,1.0]],"scale":1.25,"start":1.25},{"basis":[[0,0,1.0]],"scale":1.0,"start":1.0}],"design":{"dissipation":"constants","encoding":"joint","input":"derived","mass":"closed-form","memory":"bristles","net":"mlp","potential":"closed-form"},"entries":[[0,0,"varying",[1]],[1,0,"varying",[1]],[1,1,"constant",[]]],"format":9,"gravity":[0.0,-9.81,0.0],"inputs":[],"joints":[{"armature":0.1,"center":0.0,"friction":1.0,"gear":1.0,"half_range":3.14159,"joint_type":"revolute","lower":-3.14159,"mass_sensitivity":0.02,"name":"joint1","potential_sensitivity":1.0,"speed":10.0,"upper":3.14159},{"armature":0.1,"center":0.0,"friction":1.0,"gear":1.0,"half_range":3.14159,"joint_type":"revolute","lower":-3.14159,"mass_sensitivity":1.0,"name":"joint2","potential_sensitivity":0.307,"speed":10.0,"upper":3.14159}],"links":[{"center_of_mass":[0.5,0.0,0.0],"inertia":[0.6,0.0,0.0,0.6,0.0,1.0],"joint":0,"joint_type":"revolute","mass":1.0,"name":"link1","offset":0.0,"parent":-1,"position":[0.0,0.0,0.0],"ratio":1.0,"rotation":[[1.0,0.0,0.0],[0.0,1.0,0.0],[0.0,0.0,1.0]]},{"center_of_mass":[0.5,0.0,0.0],"inertia":[0.6,0.0,0.0,0.6,0.0,1.0],"joint":1,"joint_type":"revolute","mass":1.0,"name":"link2","offset":0.0,"parent":0,"position":[1.0,0.0,0.0],"ratio":1.0,"rotation":[[1.0,0.0,0.0],[0.0,1.0,0.0],[0.0,0.0,1.0]]}],"margin":0.07,"motor_speeds":[],"options":{"angle_tolerance":0.002,"assume":"kinematics","depth":2,"design":null,"joints":null,"preset":"hybrid","tip":null,"width":64},"outputs":[{"basis":[[0,0,2.0],[1,0,1.0]],"joints":[1],"mean":1.2652,"scale":0.343656}],"potential":[0,1],"potential_scale":10.8194,"robot":"two_link","servos":[],"started_from_urdf":true,"urdf":"two_link.urdf","urdf_sha256":"d5393c842e189b72219c5ce02e115de571a94cd406b48898ea64b5431a395232"}"""  # noqa: E501
