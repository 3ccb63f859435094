r"""Port-Hamiltonian model of an arm with 3 joints, by `spelgen build`.

Robot "rpr". 3 rigid bodies with trained inertial parameters, friction. V depends on joint 3.

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
from spelgen.runtime import FrictionLaws, Joint, Link, RigidBodyDynamics

# Positions [rad, m], speed [rad/s, m/s], friction [Nm, N], armature [kg m^2, kg].
JOINTS = (
    Joint("joint1", "revolute", lower=-2.96706, upper=2.96706, speed=3.0, friction=0.4, armature=2.19),
    Joint("joint2", "prismatic", lower=0.305, upper=1.27, speed=1.0, friction=0.4, armature=0.782),
    Joint("joint3", "revolute", lower=-2.96706, upper=2.96706, speed=6.0, friction=0.4, armature=0.106),
)  # fmt: skip

# In the frame of the joint, z along its axis; position and rotation: of this frame in the parent's [m].
# mass [kg], center_of_mass [m], inertia about it: xx, xy, xz, yy, yz, zz [kg m^2].
LINKS = (
    Link(
        "link1", parent=None, joint="joint1", position=(0.0, 0.0, 0.0), mass=5.01,
        center_of_mass=(0.0, 0.0, -0.896), inertia=(0.108, 0.0, 0.0, 0.1, 0.0, 0.018),
    ),
    Link(
        "link2", parent="link1", joint="joint2", position=(0.0, 0.0, 0.154),
        rotation=((1.0, 0.0, 0.0), (0.0, 0.0, -1.0), (0.0, 1.0, 0.0)), mass=4.25,
        center_of_mass=(0.0, -0.0203, -6.45), inertia=(2.51, 0.0, 0.0, 2.51, 0.0, 0.006),
    ),
    Link(
        "link3", parent="link2", joint="joint3", position=(0.0, -0.0203, 0.0),
        rotation=((0.0, 1.0, 0.0), (-1.0, 0.0, 0.0), (0.0, 0.0, 1.0)), mass=1.08,
        center_of_mass=(0.0, 0.092, -0.054),
        inertia=(0.002, 0.0, 0.0, 0.00110923016621, 0.0, 0.0011092301662),
    ),
)  # fmt: skip


class Model(RigidBodyDynamics):
    """3 rigid bodies with trained inertial parameters, friction."""

    def __init__(self, seed: int = 0, dtype: torch.dtype = torch.float64) -> None:
        super().__init__(
            joints=JOINTS,
            links=LINKS,
            gravity=(0.0, 0.0, -9.81),
            friction=FrictionLaws(
                JOINTS,
                breakaway={
                    "revolute": (0.0001, 0.0004, 0.0016, 0.0064, 0.025, 0.1),
                    "prismatic": (1e-05, 4e-05, 0.00016, 0.00064, 0.0025, 0.01),
                },
            ),
        )  # fmt: skip
        self.to(dtype)


# The specification, for `spelgen train` and `spelgen check`; they refuse a module that was edited.
SPEC = r"""{"constants":[{"basis":[[2,2,1.0]],"scale":0.0101411,"start":0.0101411},{"basis":[[1,1,1.0]],"scale":5.33,"start":5.33}],"design":{"dissipation":"constants","encoding":"none","input":"derived","mass":"closed-form","memory":"bristles","net":"none","potential":"closed-form"},"entries":[[0,0,"varying",[1,2]],[1,0,"varying",[2]],[1,1,"constant",[]],[2,0,"varying",[1,2]],[2,1,"zero",[]],[2,2,"constant",[]]],"format":9,"gravity":[0.0,0.0,-9.81],"inputs":[],"joints":[{"armature":2.19,"center":0.0,"friction":0.4,"gear":1.0,"half_range":2.96706,"joint_type":"revolute","lower":-2.96706,"mass_sensitivity":0.02,"name":"joint1","potential_sensitivity":0.02,"speed":3.0,"upper":2.96706},{"armature":0.782,"center":0.7875,"friction":0.4,"gear":1.0,"half_range":0.4825,"joint_type":"prismatic","lower":0.305,"mass_sensitivity":1.0,"name":"joint2","potential_sensitivity":0.02,"speed":1.0,"upper":1.27},{"armature":0.106,"center":0.0,"friction":0.4,"gear":1.0,"half_range":2.96706,"joint_type":"revolute","lower":-2.96706,"mass_sensitivity":0.518,"name":"joint3","potential_sensitivity":1.0,"speed":6.0,"upper":2.96706}],"links":[{"center_of_mass":[0.0,0.0,-0.896],"inertia":[0.108,0.0,0.0,0.1,0.0,0.018],"joint":0,"joint_type":"revolute","mass":5.01,"name":"link1","offset":0.0,"parent":-1,"position":[0.0,0.0,0.0],"ratio":1.0,"rotation":[[1.0,0.0,0.0],[0.0,1.0,0.0],[0.0,0.0,1.0]]},{"center_of_mass":[0.0,-0.0203,-6.45],"inertia":[2.51,0.0,0.0,2.51,0.0,0.006],"joint":1,"joint_type":"prismatic","mass":4.25,"name":"link2","offset":0.0,"parent":0,"position":[0.0,0.0,0.154],"ratio":1.0,"rotation":[[1.0,0.0,0.0],[0.0,0.0,-1.0],[0.0,1.0,0.0]]},{"center_of_mass":[0.0,0.092,-0.054],"inertia":[0.002,0.0,0.0,0.00110923016621,0.0,0.0011092301662],"joint":2,"joint_type":"revolute","mass":1.08,"name":"link3","offset":0.0,"parent":1,"position":[0.0,-0.0203,0.0],"ratio":1.0,"rotation":[[0.0,1.0,0.0],[-1.0,0.0,0.0],[0.0,0.0,1.0]]}],"margin":0.08,"motor_speeds":[],"options":{"angle_tolerance":0.002,"assume":"kinematics","depth":2,"design":null,"joints":null,"preset":"closed-form","tip":null,"width":64},"outputs":[{"basis":[[1,0,1.0]],"joints":[2],"mean":-0.00167665,"scale":1.36528},{"basis":[[2,0,1.0]],"joints":[1,2],"mean":-0.00154309,"scale":0.0595527},{"basis":[[0,0,1.0]],"joints":[1,2],"mean":139.887,"scale":12.6351}],"potential":[2],"potential_scale":0.703291,"robot":"rpr","servos":[],"started_from_urdf":true,"urdf":"rpr.urdf","urdf_sha256":"aaacb65e5fa6a4caf626114ddf8869514f479b568dae43957e41214d3c6eff8d"}"""  # noqa: E501
