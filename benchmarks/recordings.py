"""Make the folder of recordings that the benchmarks read, from clones of public repositories.

    python benchmarks/recordings.py [FOLDER] [--clones DIR] [--only NAME ...]

Each source is read at the commit of `SOURCES`, by `git show`. FOLDER is runs/recordings by default, where the
benchmarks look for it. A repository is cloned into DIR (by default FOLDER/clones), unless DIR/<its name> exists.
Licences are quoted from the repositories; if none is stated, all rights are the authors'.

Recordings are Parquet files with the columns t [s], and q_<joint> [rad], qd_<joint> [rad/s], tau_<joint> [Nm] per
joint; sample times are as recorded.
"""

from __future__ import annotations

import argparse
import csv
import io
import json
import pickle
import subprocess
import sys
import tempfile
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar

import numpy as np
import pyarrow as pa
import pyarrow.parquet

from spelgen.logs.read import read_logs

FOLDER = Path(__file__).parents[1] / "runs" / "recordings"
Read = Callable[[str], bytes]
"""Return the bytes of a file of a repository, by its path."""


@dataclass(frozen=True)
class Repository:
    """Address and commit of a repository. licence: as the repository states it."""

    address: str
    commit: str
    licence: str

    @property
    def name(self) -> str:
        """Name of the folder into which the repository is cloned."""
        return self.address.rsplit("/", 1)[1]


@dataclass(frozen=True)
class Source:
    """Source of the recordings of one arm.

    make: function that writes the recordings into a folder. train, test: names of recordings, or a split by time.
    urdf: repository and path of the URDF, if one is published; otherwise `make` writes it.
    """

    repository: Repository
    make: Callable[[Read, Path], None]
    train: str
    test: str
    urdf: tuple[Repository, str] | None = None


def write_log(path: Path, t: np.ndarray, joints: Sequence[str], **quantities: np.ndarray) -> None:
    """Write a recording of times t (T,) [s] and quantities (T, n); a keyword `q` gives the columns `q_<joint>`."""
    columns = {"t": t}
    for prefix, values in quantities.items():
        columns |= {f"{prefix}_{joint}": values[:, k] for k, joint in enumerate(joints)}
    pa.parquet.write_table(pa.table(columns), path)


def numbers(content: bytes, delimiter: str | None = ",", skiprows: int = 0) -> np.ndarray:
    """Return the table of numbers in a text file, (rows, columns)."""
    return np.loadtxt(io.BytesIO(content), delimiter=delimiter, skiprows=skiprows)


UR10E_JOINTS = [
    f"{x}_joint" for x in ("shoulder_pan", "shoulder_lift", "elbow", "wrist_1", "wrist_2", "wrist_3")
]
PANDA_JOINTS = [f"panda_joint{k}" for k in range(1, 8)]
# [Nm/A] drive gains that the authors of the logs identified
UR10E_GAINS = np.array([14.87, 13.26, 11.13, 10.62, 11.03, 11.47])
# {folder and name of a log: rows that the authors of the data use}; the file is FOLDER/ur-NAME.csv for "FOLDER/NAME"
UR10E_LOGS = {
    "identification_data/19_12_23_free": slice(None),
    "identification_data/20_01_13-load_2600": slice(None),
    "identification_data/20_01_31-load": slice(None),
    "identification_data/20_01_31-unload": slice(None),
    "identification_data/20_02_05-20sec_12harm": slice(None),
    "identification_data/20_02_05-20sec_8harm": slice(319, 2310),
    "identification_data/20_02_06-20sec_10harm": slice(None),
    "identification_data/20_02_06-20sec_5harm": slice(None),
    "identification_data/20_02_10-20sec_7harm": slice(None),
    "identification_data/20_02_10-30sec_12harm": slice(634, 3510),
    "identification_data/20_02_12-40sec_12harm": slice(499, 4460),
    "identification_data/20_02_12-50sec_12harm": slice(354, 5090),
    "identification_data/20_02_19_14harm50sec": slice(None),
    "identification_data/20_02_19_14harm50secLoad": slice(None),
    "identification_data/20_02_19_15harm50sec": slice(None),
    "validation_data/20_01_17-ptp_10_points": slice(699, 4200),
}


def ur10e(read: Read, folder: Path) -> None:
    """Write the UR10e's logs: torques are motor currents times drive gains; currents are the columns i_<joint> [A]."""
    for path, rows in UR10E_LOGS.items():
        kind, name = path.split("/")
        table = numbers(read(f"dataset_ur10e/{kind}/ur-{name}.csv"))[rows]
        q, qd, current = table[:, 1:7], table[:, 7:13], table[:, 13:19]
        log = folder / f"{name.replace('-', '_')}.parquet"
        write_log(
            log, table[:, 0] - table[0, 0], UR10E_JOINTS, q=q, qd=qd, tau=current * UR10E_GAINS, i=current
        )


def panda(read: Read, folder: Path) -> None:
    """Write the Panda's log from text files of its repository. The torques are values of joint torque sensors.

    read: function that returns the bytes of a file of the repository.
    """
    log = "matlab/data/Exciting_Traj/Trajectory_1/rbt_log/exciting_traj_{}.txt"
    t, *rest = (numbers(read(log.format(x)), None) for x in ("time", "positions", "velocity", "torques"))
    q, qd, tau = (values.reshape(-1, 7) for values in rest)
    write_log(folder / "exciting_traj1.parquet", t, PANDA_JOINTS, q=q, qd=qd, tau=tau)


def from_bag(path: str, logged: Sequence[str], joints: Sequence[str]) -> Callable[[Read, Path], None]:
    """Return a function that writes the joint states of a ROS 2 bag in SQLite; torques are the logged efforts.

    path: path of the bag in the repository. logged, joints: names of the joints in the bag and in the URDF.
    """

    def write(read: Read, folder: Path) -> None:
        with tempfile.TemporaryDirectory() as scratch:
            bag = Path(scratch) / Path(path).name
            bag.write_bytes(read(path))
            (log,) = read_logs([bag], logged)
        write_log(folder / f"{bag.stem}.parquet", log.t, joints, q=log.q, qd=log.qd, tau=log.tau)

    return write


def shanghai(read: Read, folder: Path) -> None:
    """Write the Shanghai arm's logs at 6 ms: each value is logged three times, and one of the three is used.

    Velocities are differences of positions; torques are scaled by the authors' factors.
    """
    joints = [f"joint{k}" for k in range(1, 7)]
    scale = 101 * np.array([3.442383e-4, 3.442383e-4, -3.442383e-4, 1.342773e-4, 1.342773e-4, 1.342773e-4])
    count, step = 3665, 0.006
    for number, first in ((1, 5), (2, 6), (3, 6)):
        columns: dict[str, np.ndarray] = {}
        for quantity in ("theta", "torque"):
            files = [f"DataOutput_Traj{number}/DataOutput_{quantity}{k}.txt" for k in range(1, 7)]
            texts = [read(f"matlab_identification/data/{file}").decode() for file in files]
            rows = [[_plc_number(line) for line in text.splitlines() if ":=" in line] for text in texts]
            columns[quantity] = np.array(rows).T
        q = columns["theta"][first - 3 :: 3][: count + 1]
        tau = columns["torque"][first::3][:count] * scale
        t = step * np.arange(count)
        write_log(folder / f"traj{number}.parquet", t, joints, q=q[1:], qd=np.diff(q, axis=0) / step, tau=tau)
    write_urdf(folder / "shanghai.urdf", SHANGHAI_LINKS)


def _plc_number(line: str) -> float:
    """Return the number in a line of a PLC's log such as `DataOutput.OutData[0]:=0.6995783F16#B3178FH-6`: 0.6995783."""
    return float(line.split(":=")[1].split("F")[0])


def xmate3(read: Read, folder: Path) -> None:
    """Write the xMate3's log at 1 kHz, with the torques of joint torque sensors."""
    files = [f"filtering/data/excit/excit_{x}_record.txt" for x in ("ang", "vel", "torque")]
    q, qd, tau = (numbers(read(file), None) for file in files)
    joints = [f"joint{k}" for k in range(1, 8)]
    write_log(folder / "excit.parquet", 0.001 * np.arange(len(q)), joints, q=q, qd=qd, tau=tau)
    write_urdf(folder / "xmate3.urdf", XMATE3_LINKS)


def ar5(read: Read, folder: Path) -> None:
    """Write the AR5's log at 50 Hz, with the torques of joint torque sensors; gravity is along x of its base."""
    table = numbers(read("src/config/dynamics_identification_data_real.csv"), skiprows=1)
    joints = [f"AR5-5_07R-W4C4A2_joint_{k}" for k in range(1, 8)]
    write_log(
        folder / "real.parquet", table[:, 0], joints, q=table[:, 1:8], qd=table[:, 8:15], tau=table[:, 22:29]
    )
    (folder / "ar5.yaml").write_text("gravity: [9.81, 0, 0]\n")


AIRBOT_LOGS = ["ga_N12T25", "opt", *(f"ptrnSrch_N7T25QR-{k}" for k in (5, 6, 7))]
AIRBOT_ONCE = ["ptrnSrch_N8T25QR-8", "ptrnSrch_N8T25QR", "ptrnSrch_N8T25QR_maxq1"]


def airbot(read: Read, folder: Path) -> None:
    """Write the Airbot's logs of eight motions; five were recorded twice, the second time with the suffix `_again`."""
    joints = [f"joint{k}" for k in range(1, 7)]
    logs = {name: name for name in (*AIRBOT_LOGS, *AIRBOT_ONCE)} | {
        f"{x}_again": f"{x}(1)" for x in AIRBOT_LOGS
    }
    for name, file in logs.items():
        table = numbers(read(f"state_machine_demo/real_data/vali_{file}.csv"))
        log = folder / f"{name.replace('ptrnSrch', 'ps')}.parquet"
        write_log(log, table[:, 0], joints, q=table[:, 1:7], qd=table[:, 7:13], tau=table[:, 13:19])


def tx40(read: Read, folder: Path) -> None:
    """Write the TX40's log: motor positions and torques converted to joints, averaged from 5 kHz to 1 kHz.

    The conversion has the gear ratios and the coupling of joint 6 to joint 5.
    """
    motors, torques = (
        numbers(read(f"examples/staubli_TX40/data/{x}_data.csv"), skiprows=1) for x in ("pos_read", "curr")
    )
    gears = np.diag([32.0, 32.0, 45.0, -48.0, 45.0, 32.0])
    gears[5, 4] = 32.0
    zero = np.pi / 2 * np.array([0.0, -1.0, 1.0, 0.0, 0.0, 0.0])
    q, tau = motors @ np.linalg.inv(gears).T, torques @ gears
    q, tau = (values.reshape(-1, 5, 6).mean(axis=1) for values in (q, tau))
    joints = [f"joint_{k}" for k in range(1, 7)]
    write_log(folder / "identification.parquet", 0.001 * np.arange(len(q)), joints, q=q + zero, tau=tau)
    (folder / "tx40.yaml").write_text("logs: {velocity: differentiated}\n")


SO101_TRAIN = (
    "chirp_sweep multisine prbs_excitation workspace_sweep single_joint_elbow triangle_wave friction_gravity"
)
SO101_TEST = (
    "pick_place velocity_ramp static_holding random_waypoints backlash_detection step_response slow_precision"
)


def so101(read: Read, folder: Path) -> None:
    """Write the SO-101's logs at 50 Hz: positions, commands, and load_<joint>, the servo's unsigned load register."""
    joints = ["shoulder_pan", "shoulder_lift", "elbow_flex", "wrist_flex", "wrist_roll", "gripper"]
    for name in f"{SO101_TRAIN} {SO101_TEST}".split():
        motion = f"output/real/so101/custom/{name}"
        states, commands = (
            list(csv.DictReader(io.StringIO(read(f"{motion}/{x}.csv").decode())))
            for x in ("state_motor", "control")
        )
        t = np.array([float(row["timestamp"]) for row in states])
        q, load = (np.array([json.loads(row[x]) for row in states]) for x in ("positions", "torques"))
        u = np.array([json.loads(row["positions"]) for row in commands])
        columns = {"t": (t - t[0]) / 1e6}
        for k, joint in enumerate(joints):
            columns |= {f"q_{joint}": q[:, k], f"u_{joint}": u[:, k], f"load_{joint}": load[:, k]}
        pa.parquet.write_table(pa.table(columns), folder / f"{name}.parquet")
    (folder / "so101.yaml").write_text("input: position\n")


RECONSTRUCT = np.zeros(0).__reduce__()[0]
"""The function that makes an array from its parts, by numpy's own pickles."""


class Arrays(pickle.Unpickler):
    """Reader of pickled NumPy arrays; it rejects any function that is not needed for arrays, so that no code runs."""

    allowed: ClassVar[dict[tuple[str, str], object]] = {
        ("numpy", "ndarray"): np.ndarray,
        ("numpy", "dtype"): np.dtype,
        ("dill._dill", "_import_module"): lambda name: name,
        ("dill._dill", "_get_attr"): lambda module, name: {"_reconstruct": RECONSTRUCT}[name],
    }

    def find_class(self, module: str, name: str) -> object:
        """Return a function that a pickle names, if it is in `allowed`; raise `UnpicklingError` otherwise."""
        if (module, name) not in self.allowed:
            raise pickle.UnpicklingError(f"{module}.{name} in a file of arrays")
        return self.allowed[module, name]


def delan_characters(read: Read, folder: Path) -> None:
    """Write the data set of Deep Lagrangian Networks, a simulated arm that draws characters, as an NPZ file.

    The sample interval is 0.04 s. read: function that returns the bytes of a file in the repository of the data set.
    """
    content = Arrays(io.BytesIO(read("data/character_data.pickle"))).load()
    arrays = {"labels": np.array(content["labels"])}
    for name in sorted(content.keys() - {"labels"}):
        arrays |= {f"{name}_{k}": np.asarray(values) for k, values in enumerate(content[name])}
    np.savez_compressed(folder / "character_data.npz", **arrays)


@dataclass(frozen=True)
class Link:
    """A link and the joint that moves it: origin (xyz [m], roll [rad]), centre of mass [m], mass [kg], effort [Nm].

    Kinematics are as published by the authors; masses are invented, and inertias are of spheres of radius 6 cm.
    """

    xyz: str
    roll: str
    center: str
    mass: int
    effort: int


UP, DOWN = "1.57079632679", "-1.57079632679"
SHANGHAI_LINKS = [
    Link("0 0 0.1181", "0", "0 0 0", 8, 200),
    Link("0 0 0", UP, "-0.208 0 0", 8, 200),
    Link("-0.416 0 0", "0", "-0.2104 0 0.06505", 5, 150),
    Link("-0.4208 0 0.1301", "0", "0 -0.05105 0", 2, 50),
    Link("0 -0.1021 0", UP, "0 0.0284 0", 2, 50),
    Link("0 0.0568 0", DOWN, "0 0 0.05", 1, 50),
]
XMATE3_LINKS = [
    Link("0 0 0.3415", "0", "0 0 0", 5, 100),
    Link("0 0 0", DOWN, "0 -0.197 0", 4, 100),
    Link("0 -0.394 0", UP, "0 0 0", 4, 100),
    Link("0 0 0", DOWN, "0 -0.183 0", 3, 50),
    Link("0 -0.366 0", UP, "0 0 0", 3, 30),
    Link("0 0 0", DOWN, "0 -0.12515 0", 2, 30),
    Link("0 -0.2503 0", UP, "0 0 0.05", 1, 30),
]
LINK = """\
  <link name="link{k}">
    <inertial>
      <origin xyz="{link.center}"/>
      <mass value="{link.mass}"/>
      <inertia ixx="{i:.10g}" ixy="0" ixz="0" iyy="{i:.10g}" iyz="0" izz="{i:.10g}"/>
    </inertial>
  </link>
  <joint name="joint{k}" type="revolute">
    <origin xyz="{link.xyz}" rpy="{link.roll} 0 0"/>
    <parent link="{parent}"/>
    <child link="link{k}"/>
    <axis xyz="0 0 1"/>
    <limit lower="-6.2832" upper="6.2832" effort="{link.effort}" velocity="3.14"/>
  </joint>
"""


def write_urdf(path: Path, links: Sequence[Link]) -> None:
    """Write the URDF of a serial arm from its links, for arms whose kinematics are published as a table only."""
    text = f'<?xml version="1.0"?>\n<robot name="{path.stem}">\n  <link name="base"/>\n'
    for k, link in enumerate(links, start=1):
        parent = f"link{k - 1}" if k > 1 else "base"
        text += LINK.format(k=k, link=link, parent=parent, i=0.00144 * link.mass)
    path.write_text(f"{text}</robot>\n")


GITHUB, NONE = "https://github.com", "none stated"
UR10E = Repository(
    f"{GITHUB}/shamilmamedov/dynamic_calibration", "11af40e7deb758ec080a175fed8fcdd6c99aca29", NONE
)
PANDA = Repository(
    f"{GITHUB}/marcocognetti/FrankaEmikaPandaDynModel", "24d85ce4e648e2e894c832bfeee9b16711eb1a1a", "GPL-3.0"
)
SHANGHAI = Repository(
    f"{GITHUB}/Naruton94/robot_identification", "a75121d23d6d73a870d6ff77136a6294235135e5", NONE
)
XMATE3 = Repository(
    f"{GITHUB}/YanjunLIU-ac/Dynamic_Parameter_Identification_for_Rokae_xMate",
    "d5855f4731b00fc90061c838d66cc40c59f88c7d",
    NONE,
)
AR5 = Repository(
    f"{GITHUB}/FrankJIE09/Dynamics_identification_Frank", "758dc8d6f78e63ecba0aac16d28255ae045f1d3c", NONE
)
AIRBOT = Repository(
    f"{GITHUB}/Zeyu1-oss/dynamics_calibration_airbot", "55aac2fcfa490c4ba3dfae5d2aea15fd2e0f138e", NONE
)
TX40 = Repository(
    f"{GITHUB}/thanhndv212/figaroh-examples",
    "c0b5c7f0fda10078be55104f9ee76ac106b7a5ee",
    "that of figaroh-plus",
)
SAGE = Repository(f"{GITHUB}/isaac-sim2real/sage", "4ffd2627df9d23e279b35712a67e629ce0c0dfa7", "Apache-2.0")
DELAN = Repository(
    f"{GITHUB}/milutter/deep_lagrangian_networks", "18a943d07fa25193c52d239b5fb2478900d4259a", "MIT"
)
SO_ARM = Repository(
    f"{GITHUB}/TheRobotStudio/SO-ARM100", "fda892cba81032c46c40976a48c9ceadbf40a9ca", "Apache-2.0"
)
ROBOTS = Repository(
    f"{GITHUB}/Gepetto/example-robot-data", "39aa94379908fa743da90b21dc9e1fb8308f746b", "BSD-3-Clause"
)
UNISA = Repository(
    f"{GITHUB}/unisa-acg/inverse-dynamics-solver", "41e196de5ca340f2b48e443484a7c74a77533da4", "BSD-3-Clause"
)

SOURCES = {
    "ur10e": Source(
        UR10E, ur10e,
        "20_02_10_30sec_12harm 20_02_12_50sec_12harm 20_02_05_20sec_8harm",
        "nine others without load and ptp", (UR10E, "URe/urdf/ur10e.urdf"),
    ),
    "panda": Source(PANDA, panda, "first 12 s", "rest", (ROBOTS, "robots/panda_description/urdf/panda.urdf")),
    "shanghai": Source(SHANGHAI, shanghai, "two of three", "the third"),
    "xmate3": Source(XMATE3, xmate3, "first 12 s", "rest"),
    "ar5": Source(AR5, ar5, "first 36 s", "rest", (AR5, "urdf/AR5-5_07R-W4C4A2.urdf")),
    "airbot": Source(
        AIRBOT, airbot, "ps_N7T25QR-5 ps_N7T25QR-6_again", "nine, without these and their repeats",
        (AIRBOT, "state_machine_demo/resources/urdf/play.urdf"),
    ),
    "tx40": Source(TX40, tx40, "first 5.4 s", "rest", (TX40, "examples/staubli_TX40/urdf/tx40_mdh_modified.urdf")),
    "unisa_ur10": Source(
        UNISA,
        from_bag(
            "ur10_inverse_dynamics_solver/bagfiles/ur10_exciting_trajectory.db3", UR10E_JOINTS, UR10E_JOINTS
        ),
        "first 16.5 s", "rest", (ROBOTS, "robots/ur_description/urdf/ur10_robot.urdf"),
    ),
    "unisa_panda": Source(
        UNISA,
        from_bag(
            "franka_inria_inverse_dynamics_solver/bagfiles/panda_exciting_trajectory.db3",
            [f"fer_joint{k}" for k in range(1, 8)], PANDA_JOINTS,
        ),
        "first 14.5 s", "rest", (ROBOTS, "robots/panda_description/urdf/panda.urdf"),
    ),
    "so101": Source(SAGE, so101, SO101_TRAIN, SO101_TEST, (SO_ARM, "Simulation/SO101/so101_new_calib.urdf")),
    "delan_characters": Source(DELAN, delan_characters, "17 characters", "e, q, v"),
}  # fmt: skip


def reader(repository: Repository, clones: Path) -> Read:
    """Return a function that reads a file of a repository by its path, at the repository's commit.

    The repository is cloned into the folder `clones` if it is absent.
    """
    clone = clones / repository.name
    if not clone.exists():
        command = [
            "git",
            "clone",
            "--quiet",
            "--no-checkout",
            "--filter=blob:none",
            repository.address,
            str(clone),
        ]
        subprocess.run(command, check=True)

    def read(path: str) -> bytes:
        show = ["git", "-C", str(clone), "show", f"{repository.commit}:{path}"]
        return subprocess.run(show, check=True, capture_output=True).stdout

    return read


def make(name: str, folder: Path, clones: Path) -> None:
    """Write the recordings and the URDF of one arm into the subfolder `name` of `folder`.

    name: key of `SOURCES`. clones: folder of the cloned repositories; a repository is cloned if it is not there.
    """
    source, target = SOURCES[name], folder / name
    target.mkdir(parents=True, exist_ok=True)
    source.make(reader(source.repository, clones), target)
    if source.urdf is not None:
        repository, path = source.urdf
        (target / f"{name}.urdf").write_bytes(reader(repository, clones)(path))


def folder_of(argument: str | Path | None) -> Path:
    """Return the folder of recordings that a benchmark reads: FOLDER of its command line, or the default."""
    folder = Path(argument or FOLDER)
    if not folder.is_dir():
        sys.exit(f"{folder}: no folder of recordings; make it by `python benchmarks/recordings.py FOLDER`")
    return folder


def panda_urdf(folder: Path) -> Path:
    """Return the file of the Panda's URDF. folder: folder of all recordings, with a subfolder per arm.

    It is panda/panda.urdf in the folder, or arms/panda_erd.urdf next to the folder if the former does not exist.
    """
    urdf = folder / "panda" / "panda.urdf"
    return urdf if urdf.exists() else folder.parent / "arms" / "panda_erd.urdf"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("folder", nargs="?", type=Path, default=FOLDER)
    parser.add_argument("--clones", type=Path, help="folder of the clones; default: FOLDER/clones")
    parser.add_argument("--only", nargs="+", choices=SOURCES, default=list(SOURCES))
    options = parser.parse_args()
    clones, failed = options.clones or options.folder / "clones", False
    clones.mkdir(parents=True, exist_ok=True)
    for name in options.only:
        repository = SOURCES[name].repository
        try:
            make(name, options.folder, clones)
            print(f"{name}: {repository.address} at {repository.commit[:12]}, licence: {repository.licence}")
        except subprocess.CalledProcessError as error:
            reason = (error.stderr or b"").decode(errors="replace").strip().splitlines()[-1:]
            print(f"{name}: {repository.address}: git failed: {' '.join(reason)}", file=sys.stderr)
            failed = True
    if failed:
        sys.exit(1)


if __name__ == "__main__":
    main()
