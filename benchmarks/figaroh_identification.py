"""Identify an arm with figaroh, a toolbox for identification, if it is installed (`pip install figaroh`).

    python benchmarks/figaroh_identification.py ARM.urdf LOGS...

figaroh 1.0's own workflow of functions: the regressor with viscous and Coulomb friction, armature and an offset of each
joint, without its zero columns; base parameters by its double QR decomposition; then least squares weighted by the
inverse variance of each joint's residual. It gets the samples of `spelgen identify`: filtered, subsampled, and shifted
by the delay of the torques.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import torch

import spelgen
from spelgen.arm.arm import Chain
from spelgen.dynamics.pinocchio_arm import pinocchio_model
from spelgen.errors import ArmError
from spelgen.logs.dynamics_samples import DynamicsSamples

CONFIG = {
    "has_friction": True,
    "has_actuator_inertia": True,
    "has_joint_offset": True,
    "is_joint_torques": True,
}
EXTRAS = (
    "fv",
    "fs",
    "ia",
    "off",
)  # regressor columns of each joint, in figaroh's order, after the columns of the bodies
OURS = [
    0,
    1,
    2,
    3,
    4,
    5,
    7,
    6,
    8,
    9,
]  # indices of m, m c, Ixx, Ixy, Ixz, Iyy, Iyz, Izz in Pinocchio's ten inertial parameters


@dataclass(frozen=True, eq=False)
class FigarohDynamics:
    """Dynamics by the constants that figaroh identified, (14 n,): ten per body, then n per name in `EXTRAS`."""

    builder: Any
    constants: np.ndarray
    n: int

    def _torque(self, columns: Sequence[str], q: np.ndarray, qd: np.ndarray, qdd: np.ndarray) -> np.ndarray:
        """Return the torque (T, n) [Nm] of some groups of regressor columns: "bodies" or names of `EXTRAS`."""
        rows = self.builder.build_basic_regressor(q, qd, qdd, {"act_idxv": range(self.n)})
        groups = np.repeat(("bodies", *EXTRAS), [10 * self.n, *[self.n] * len(EXTRAS)])
        return (rows @ (self.constants * np.isin(groups, columns))).reshape(self.n, -1).T

    def mass_matrix(self, q: torch.Tensor) -> np.ndarray:
        """Return M (T, n, n), armatures included, at positions q (T, n)."""
        still = np.zeros(q.shape)
        inertial = ("bodies", "ia")
        bias = self._torque(inertial, q.numpy(), still, still)
        columns = [self._torque(inertial, q.numpy(), still, still + axis) - bias for axis in np.eye(self.n)]
        return np.stack(columns, axis=-1)

    def gravity(self, q: torch.Tensor) -> np.ndarray:
        """Return the gravity torque dV/dq, (T, n) [Nm], at positions q (T, n)."""
        still = np.zeros(q.shape)
        return self._torque(("bodies",), q.numpy(), still, still)

    def friction_torque(self, q: torch.Tensor, qd: torch.Tensor) -> np.ndarray:
        """Return viscous plus Coulomb friction, (T, n) [Nm], at positions and velocities (T, n)."""
        return self._torque(("fv", "fs"), q.numpy(), qd.numpy(), np.zeros(q.shape))

    def inverse_dynamics(self, q: torch.Tensor, qd: torch.Tensor, qdd: torch.Tensor) -> np.ndarray:
        """Return the torque, (T, n) [Nm], with friction, armatures and offsets, of a motion q, qd, qdd (T, n)."""
        return self._torque(("bodies", *EXTRAS), q.numpy(), qd.numpy(), qdd.numpy())

    @property
    def inertial_parameters(self) -> np.ndarray:
        """Return m, m c, Ixx, Ixy, Ixz, Iyy, Iyz, Izz per body in the joint frame, (n, 10).

        Entries that are no base parameters are 0."""
        return self.constants[: 10 * self.n].reshape(-1, 10)[:, OURS]

    @property
    def armature(self) -> np.ndarray:
        """Return the armatures, (n,) [kg m^2, kg]."""
        return self.constants[12 * self.n : 13 * self.n]


def figaroh_dynamics(arm: Chain, settings: Any, samples: Sequence[DynamicsSamples]) -> FigarohDynamics:
    """Identify an arm from samples by figaroh's weighted least squares; return the identified dynamics.

    settings: spelgen's settings of the arm, for its model in Pinocchio. Raises ImportError without figaroh, ArmError
    for mimic joints.
    """
    from figaroh.tools.qrdecomposition import QRDecomposer
    from figaroh.tools.regressor import RegressorBuilder, RegressorConfig, eliminate_non_dynaffect
    from figaroh.tools.solver import solve_linear_system

    n = len(arm.coordinates)
    if len(arm.bodies) != n:
        raise ArmError("mimic joints", expected="a joint for each body, as figaroh has it")
    model = pinocchio_model(arm, settings)
    # figaroh's regressor has a column of armature: an armature of Pinocchio's model would count twice
    model.armature = np.zeros(n)
    builder = RegressorBuilder(
        SimpleNamespace(model=model, data=model.createData()), RegressorConfig(**CONFIG)
    )
    q, qd, qdd, tau = (
        np.concatenate([getattr(x, name) for x in samples]) for name in ("q", "qd", "qdd", "tau")
    )
    full = builder.build_basic_regressor(q, qd, qdd, {"act_idxv": range(n)})
    torque = tau.T.ravel()  # all samples of joint 1 first, as the rows of figaroh's regressor
    names = dict.fromkeys(map(str, range(full.shape[1])), 0.0)
    reduced, columns = eliminate_non_dynaffect(full, names)
    decomposer = QRDecomposer()
    base, _, _, ordinary = decomposer.double_decomposition(torque, reduced, columns)
    residual = (torque - base @ ordinary).reshape(n, -1)
    # figaroh's "weighted" solver forms a square matrix of all samples; scaled rows have the same solution
    weight = np.repeat(1.0 / np.sqrt(np.square(residual).mean(axis=1) + 1e-12), len(q))
    solution, _ = solve_linear_system(base * weight[:, None], torque * weight)
    constants = np.zeros(full.shape[1])
    constants[[int(columns[k]) for k in decomposer.base_indices]] = solution
    return FigarohDynamics(builder, constants, n)


def main() -> None:
    """Identify an arm from logs by figaroh, and print the torque nMSE per joint on the same logs."""
    from spelgen.logs.dynamics_samples import dynamics_samples

    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("urdf", type=Path, nargs="?")
    parser.add_argument("logs", type=Path, nargs="*")
    options = parser.parse_args()
    if options.urdf is None:
        return
    loaded = spelgen.load_arm(options.urdf)
    samples = dynamics_samples(spelgen.read_logs(options.logs, loaded))
    dynamics = figaroh_dynamics(loaded.chain, loaded.settings, samples)
    for joint, name in enumerate(loaded.chain.joint_names):
        missed, torque = [], []
        for x in samples:
            states = [torch.from_numpy(np.ascontiguousarray(y)) for y in (x.q, x.qd, x.qdd)]
            missed.append(x.tau[:, joint] - dynamics.inverse_dynamics(*states)[:, joint])
            torque.append(x.tau[:, joint])
        print(f"{name:24} nMSE {np.square(np.concatenate(missed)).mean() / np.concatenate(torque).var():.3g}")


if __name__ == "__main__":
    main()
