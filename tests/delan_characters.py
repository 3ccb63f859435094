"""The arm and the recordings of the characters data set of Deep Lagrangian Networks (DeLaN), read from its files."""

from pathlib import Path

import numpy as np

from spelgen.logs.dynamics_samples import DynamicsSamples

# The first moment of the lower link is multiplied by the length of the upper link in M, and by gravity in the gravity
# torque: for a length of 1 m, the data determine a gravity of 3 m/s^2. Masses and inertias are assumed values: the data
# determine only base parameters, such as the first moment, not the mass.
URDF = """<robot name="planar">
  <link name="base"/>
  <link name="upper"><inertial><origin xyz="0.5 0 0"/><mass value="1"/>
    <inertia ixx="0.01" ixy="0" ixz="0" iyy="0.1" iyz="0" izz="0.1"/></inertial></link>
  <link name="lower"><inertial><origin xyz="0.5 0 0"/><mass value="1"/>
    <inertia ixx="0.01" ixy="0" ixz="0" iyy="0.1" iyz="0" izz="0.1"/></inertial></link>
  <joint name="shoulder" type="continuous"><parent link="base"/><child link="upper"/><axis xyz="0 0 1"/></joint>
  <joint name="elbow" type="continuous"><parent link="upper"/><child link="lower"/><axis xyz="0 0 1"/>
    <origin xyz="1 0 0"/></joint>
</robot>"""
TESTS = "eqv"


def write_arm(folder: Path) -> Path:
    """Write the URDF of the planar arm and its settings; return the path of the URDF."""
    urdf = folder / "planar.urdf"
    urdf.write_text(URDF, encoding="utf-8")
    urdf.with_suffix(".yaml").write_text("gravity: [0, -3, 0]\n", encoding="utf-8")
    return urdf


def read_characters(folder: Path) -> tuple[list[DynamicsSamples], list[np.ndarray]]:
    """Return the samples (q, qd, qdd, tau) of each character, named by its label, and its Coriolis torques, (T, 2)."""
    data = np.load(folder / "character_data.npz", allow_pickle=True)
    labels = [str(x) for x in data["labels"]]
    samples = [
        DynamicsSamples(x, *(data[f"{key}_{i}"] for key in ("qp", "qv", "qa", "tau")))
        for i, x in enumerate(labels)
    ]
    return samples, [data[f"c_{i}"] for i in range(len(labels))]
