r"""Port-Hamiltonian model of an arm with 3 joints, by `spelgen build`.

Robot "rpr". Networks give M^-1 (three axes per joint), potential energy V, damping D and input matrix G. V
depends on joints 1-3.

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
from spelgen.runtime import DenseFriction, DenseInputDynamics, DenseMass, Joint, MaskedMLP

# Positions [rad, m], speed [rad/s, m/s], friction [Nm, N], armature [kg m^2, kg].
JOINTS = (
    Joint("joint1", "revolute", lower=-2.96706, upper=2.96706, speed=3.0, friction=0.4, armature=2.19),
    Joint("joint2", "prismatic", lower=0.305, upper=1.27, speed=1.0, friction=0.4, armature=0.782),
    Joint("joint3", "revolute", lower=-2.96706, upper=2.96706, speed=6.0, friction=0.4, armature=0.106),
)  # fmt: skip


class Model(DenseInputDynamics):
    """Networks give M^-1 (three axes per joint), potential energy V, damping D and input matrix G."""

    def __init__(self, seed: int = 0, dtype: torch.dtype = torch.float64) -> None:
        generator = torch.Generator().manual_seed(seed)
        super().__init__(
            joints=JOINTS,
            mass=DenseMass(
                JOINTS, mean=((139.887,), (-0.00167665, 5.33), (-0.00154309, 0.0, 0.0101411)),
                network=MaskedMLP(
                    generator, JOINTS, scales=((0.02, 1.0, 0.518), (0.02, 1.0, 0.518)),
                    outputs=(("joint1", "joint2", "joint3"),) * 45, width=64, depth=2,
                ),
            ),
            potential=MaskedMLP(
                generator, JOINTS, scales=((0.02, 0.02, 1.0), (0.02, 0.02, 1.0)),
                outputs=(("joint1", "joint2", "joint3"),), width=32, depth=2,
            ),
            potential_scale=0.703291,
            friction=DenseFriction(
                JOINTS, axes=3,
                network=MaskedMLP(
                    generator, JOINTS, scales=((0.1, 0.1, 0.1), (0.1, 0.1, 0.1), (1.0, 1.0, 1.0)),
                    outputs=(("joint1", "joint2", "joint3"),) * 45, width=64, depth=2,
                ),
            ),
            input_network=MaskedMLP(
                generator, JOINTS, scales=((1.0, 1.0, 1.0), (1.0, 1.0, 1.0)),
                outputs=(("joint1", "joint2", "joint3"),) * 9, width=64, depth=2,
            ),
        )  # fmt: skip
        self.to(dtype)


# The specification, for `spelgen train` and `spelgen check`; they refuse a module that was edited.
SPEC = r"""{"constants":[{"basis":[[2,2,1.0]],"scale":0.0101411,"start":0.0101411},{"basis":[[1,1,1.0]],"scale":5.33,"start":5.33}],"design":{"dissipation":"dense-3n","encoding":"lie-group","input":"dense-3n","mass":"dense-3n","memory":"none","net":"mlp","potential":"dense"},"entries":[[0,0,"varying",[1,2]],[1,0,"varying",[2]],[1,1,"constant",[]],[2,0,"varying",[1,2]],[2,1,"zero",[]],[2,2,"constant",[]]],"format":9,"gravity":[0.0,0.0,-9.81],"inputs":[],"joints":[{"armature":2.19,"center":0.0,"friction":0.4,"gear":1.0,"half_range":2.96706,"joint_type":"revolute","lower":-2.96706,"mass_sensitivity":0.02,"name":"joint1","potential_sensitivity":0.02,"speed":3.0,"upper":2.96706},{"armature":0.782,"center":0.7875,"friction":0.4,"gear":1.0,"half_range":0.4825,"joint_type":"prismatic","lower":0.305,"mass_sensitivity":1.0,"name":"joint2","potential_sensitivity":0.02,"speed":1.0,"upper":1.27},{"armature":0.106,"center":0.0,"friction":0.4,"gear":1.0,"half_range":2.96706,"joint_type":"revolute","lower":-2.96706,"mass_sensitivity":0.518,"name":"joint3","potential_sensitivity":1.0,"speed":6.0,"upper":2.96706}],"links":[],"margin":0.08,"motor_speeds":[],"options":{"angle_tolerance":0.002,"assume":"kinematics","depth":2,"design":null,"joints":null,"preset":"phnode","tip":null,"width":64},"outputs":[{"basis":[[1,0,1.0]],"joints":[0,1,2],"mean":-0.00167665,"scale":1.36528},{"basis":[[2,0,1.0]],"joints":[0,1,2],"mean":-0.00154309,"scale":0.0595527},{"basis":[[0,0,1.0]],"joints":[0,1,2],"mean":139.887,"scale":12.6351}],"potential":[0,1,2],"potential_scale":0.703291,"robot":"rpr","servos":[],"started_from_urdf":true,"urdf":"rpr.urdf","urdf_sha256":"aaacb65e5fa6a4caf626114ddf8869514f479b568dae43957e41214d3c6eff8d"}"""  # noqa: E501
