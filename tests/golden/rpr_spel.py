r"""Port-Hamiltonian model of an arm with 3 joints, by `spelgen build`.

Robot "rpr". 3 learned functions of q and 2 constants make M; networks of V and D. V depends on joints 1-3.

    import torch
    from rpr_spel import Model  # if this file is rpr_spel.py

    model = Model()  # trained: model.load_state_dict(torch.load("run/model.pt"))
    q, qd, tau = torch.zeros(3, 100, 3, dtype=torch.float64)  # any batch, joints last
    M = model.mass_matrix(q)  # (100, 3, 3)
    qdd = model.forward_dynamics(q, qd, tau)  # (100, 3)
    tau = model.inverse_dynamics(q, qd, qdd)
    V = model.potential_energy(q)  # (100,) [J]
    H = model.hamiltonian(q, model.momentum(q, qd))

Mass matrix: numbers of the joints that each entry depends on; C constant, 0 always zero

     1  2,3
     2  3    C
     3  2,3  0    C

Joints, in the order of q, qd and tau

     1  "joint1"  revolute   -2.96706 .. 2.96706 rad, Nm
     2  "joint2"  prismatic  0.305 .. 1.27 m, N
     3  "joint3"  revolute   -2.96706 .. 2.96706 rad, Nm
"""

import torch
from spelgen.runtime import (
    Constant,
    DenseFriction,
    DerivedMass,
    Function,
    Joint,
    MaskedMLP,
    NetworkDynamics,
    joints_of,
    symmetric,
)
from torch import Tensor

# Positions [rad, m], speed [rad/s, m/s], friction [Nm, N], armature [kg m^2, kg].
JOINTS = (
    Joint("joint1", "revolute", lower=-2.96706, upper=2.96706, speed=3.0, friction=0.4, armature=2.19),
    Joint("joint2", "prismatic", lower=0.305, upper=1.27, speed=1.0, friction=0.4, armature=0.782),
    Joint("joint3", "revolute", lower=-2.96706, upper=2.96706, speed=6.0, friction=0.4, armature=0.106),
)  # fmt: skip

# The learned functions of q, and the joints that each depends on.
FUNCTIONS = (
    Function(("joint1", "joint2", "joint3"), mean=-0.00167665, scale=1.36528),  # f1: M21 [kg m]
    Function(("joint1", "joint2", "joint3"), mean=-0.00154309, scale=0.0595527),  # f2: M31 [kg m^2]
    Function(("joint1", "joint2", "joint3"), mean=139.887, scale=12.6351),  # f3: M11 [kg m^2]
)  # fmt: skip

# The trained constants, in units of scale.
CONSTANTS = (
    Constant(initial=0.0101411, scale=0.0101411),  # c1: M33 [kg m^2]
    Constant(initial=5.33, scale=5.33),  # c2: M22 [kg]
)  # fmt: skip


def mass_entries(f1: Tensor, f2: Tensor, f3: Tensor, c1: Tensor, c2: Tensor) -> Tensor:
    """Return M without armature, (..., n, n), from functions of q and constants."""
    return symmetric([f3], [f1, c2], [f2, 0, c1])


class Model(NetworkDynamics):
    """3 learned functions of q and 2 constants make M; networks of V and D."""

    def __init__(self, seed: int = 0, dtype: torch.dtype = torch.float64) -> None:
        generator = torch.Generator().manual_seed(seed)
        super().__init__(
            joints=JOINTS,
            mass=DerivedMass(
                JOINTS, mass_entries, functions=FUNCTIONS, constants=CONSTANTS, margin=0.08,
                network=MaskedMLP(
                    generator, JOINTS, scales=((0.02, 1.0, 0.518), (0.02, 1.0, 0.518)),
                    outputs=joints_of(FUNCTIONS), width=64, depth=2, min_units=4,
                ),
            ),
            potential=MaskedMLP(
                generator, JOINTS, scales=((0.02, 0.02, 1.0), (0.02, 0.02, 1.0)),
                outputs=(("joint1", "joint2", "joint3"),), width=32, depth=2,
            ),
            potential_scale=0.703291,
            friction=DenseFriction(
                JOINTS, axes=1,
                network=MaskedMLP(
                    generator, JOINTS, scales=((0.1, 0.1, 0.1), (0.1, 0.1, 0.1), (1.0, 1.0, 1.0)),
                    outputs=(("joint1", "joint2", "joint3"),) * 6, width=64, depth=2,
                ),
            ),
        )  # fmt: skip
        self.to(dtype)


# The specification, for `spelgen train` and `spelgen check`; they refuse a module that was edited.
SPEC = r"""{"constants":[{"basis":[[2,2,1.0]],"scale":0.0101411,"start":0.0101411},{"basis":[[1,1,1.0]],"scale":5.33,"start":5.33}],"design":{"dissipation":"dense-n","encoding":"lie-group","input":"derived","mass":"derived","memory":"none","net":"mlp","potential":"dense"},"entries":[[0,0,"varying",[1,2]],[1,0,"varying",[2]],[1,1,"constant",[]],[2,0,"varying",[1,2]],[2,1,"zero",[]],[2,2,"constant",[]]],"format":9,"gravity":[0.0,0.0,-9.81],"inputs":[],"joints":[{"armature":2.19,"center":0.0,"friction":0.4,"gear":1.0,"half_range":2.96706,"joint_type":"revolute","lower":-2.96706,"mass_sensitivity":0.02,"name":"joint1","potential_sensitivity":0.02,"speed":3.0,"upper":2.96706},{"armature":0.782,"center":0.7875,"friction":0.4,"gear":1.0,"half_range":0.4825,"joint_type":"prismatic","lower":0.305,"mass_sensitivity":1.0,"name":"joint2","potential_sensitivity":0.02,"speed":1.0,"upper":1.27},{"armature":0.106,"center":0.0,"friction":0.4,"gear":1.0,"half_range":2.96706,"joint_type":"revolute","lower":-2.96706,"mass_sensitivity":0.518,"name":"joint3","potential_sensitivity":1.0,"speed":6.0,"upper":2.96706}],"links":[],"margin":0.08,"motor_speeds":[],"options":{"angle_tolerance":0.002,"assume":"kinematics","depth":2,"design":null,"joints":null,"preset":"spel","tip":null,"width":64},"outputs":[{"basis":[[1,0,1.0]],"joints":[0,1,2],"mean":-0.00167665,"scale":1.36528},{"basis":[[2,0,1.0]],"joints":[0,1,2],"mean":-0.00154309,"scale":0.0595527},{"basis":[[0,0,1.0]],"joints":[0,1,2],"mean":139.887,"scale":12.6351}],"potential":[0,1,2],"potential_scale":0.703291,"robot":"rpr","servos":[],"started_from_urdf":true,"urdf":"rpr.urdf","urdf_sha256":"aaacb65e5fa6a4caf626114ddf8869514f479b568dae43957e41214d3c6eff8d"}"""  # noqa: E501
