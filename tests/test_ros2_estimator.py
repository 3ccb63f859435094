"""The exported controller with its estimator controls a simulated UR10e: loads, contacts and published messages."""

import shutil

import numpy as np
import pytest
import torch
import yaml
from emitted import ROBOTS
from pyarrow import parquet
from ros2_controller import Controller, SimulatedArm, compiled

from spelgen import build, load_arm
from spelgen.dynamics.tip import tip_kinematics
from spelgen.exporting.describe import Trained
from spelgen.exporting.ros2_export import export_ros2
from spelgen.live.noise import BlockNoise, NoiseLevels

pytestmark = pytest.mark.skipif(
    not all(shutil.which(program) for program in ("gcc", "g++")), reason="no gcc or no g++ on this machine"
)

N, PERIOD = 6, 2e-3
STIFF = {"mode": "computed_torque", "kp": [400.0] * N, "kd": [40.0] * N, "max_position_error": [1.0] * N}
# mass [kg] and centre [m] of the load, in the frame of the last link
MASS, CENTER = 2.5, np.array([0.02, -0.03, 0.06])
START = np.array([0.0, -1.2, 1.4, -0.8, 1.2, 0.3])
FREQUENCIES = 2 * np.pi * np.array([0.21, 0.17, 0.25, 0.33, 0.29, 0.37])
LOAD = f"""<link name="load"><inertial><origin xyz="{" ".join(map(str, CENTER))}"/><mass value="{MASS}"/>
<inertia ixx="0.01" iyy="0.01" izz="0.01" ixy="0" ixz="0" iyz="0"/></inertial></link>
<joint name="gripper" type="fixed"><parent link="wrist_3"/><child link="load"/></joint></robot>"""


def arm_in(folder, *, loaded=False):
    """Return the UR10e; its URDF and settings are copied to `folder`.

    loaded: if True, the URDF has an additional link, the load, whose frame is the frame of the link wrist_3.
    """
    text = (ROBOTS / "ur10e.urdf").read_text()
    (folder / "ur10e.urdf").write_text(text.replace("</robot>", LOAD) if loaded else text)
    shutil.copy(ROBOTS / "ur10e.yaml", folder)
    return load_arm(folder / "ur10e.urdf")


def levels(arm):
    """Return noise levels of the live estimator for an accurate model: torque noise of 0.2 % of the effort limits."""
    effort = np.array([c.effort for c in arm.chain.coordinates])
    noise = BlockNoise(white=2e-3 * effort, disturbance=2e-3 * effort, time_constant=np.ones(N))
    ones = np.ones(N)
    return NoiseLevels(
        drift=noise, load=noise, observer=2e-3 * effort, peak_start=3 * ones, peak_scale=0.3 * ones, peak_count=40,
        load_variance=1.0, load_freedom=20, resting=0.01 * effort, resting_speed=0.02 * ones, speed=2 * ones,
        encoder=1e-5 * ones, effort=effort, minutes=10.0, point=np.zeros(3), delay=0.0,
    )  # fmt: skip


@pytest.fixture(scope="module")
def ur10e(tmp_path_factory):
    """Return the library of the controller, and the simulated arm without and with a load."""
    folders = [tmp_path_factory.mktemp(name) for name in ("free", "loaded")]
    free, loaded = (arm_in(folder, loaded=k > 0) for k, folder in enumerate(folders))
    model = build(free, "closed-form")
    export_ros2(Trained(model, free, levels=levels(free))).write(folders[0] / "package")
    library = compiled(folders[0] / "package", folders[0])
    plants = [SimulatedArm(model, free, folders[0])]
    plants.append(SimulatedArm(build(loaded, "closed-form"), loaded, folders[1]))
    return library, *plants


def moving(t):
    """Return a reference motion of all joints at time t [s], from rest at START: position, velocity, acceleration."""
    fade = 1 - np.exp(-t)
    wave, rate = np.sin(FREQUENCIES * t), FREQUENCIES * np.cos(FREQUENCIES * t)
    q = START + 0.5 * fade * wave
    qd = 0.5 * (fade * rate + (1 - fade) * wave)
    qdd = 0.5 * (-fade * FREQUENCIES**2 * wave + 2 * (1 - fade) * rate - (1 - fade) * wave)
    return q, qd, qdd


def tracked(controller, plant, seconds, start=0.0):
    """Run the controller along `moving` on a simulated arm; return the position errors, (T, n) [rad].

    Topics are published at 50 Hz. start: time of the reference at the beginning [s].
    """
    errors = []

    def at_each(t):
        reference = moving(start + t)
        controller.reference(*reference)
        errors.append(np.abs(reference[0] - plant.q))
        if round(t / PERIOD) % 10 == 0:
            controller.text("state")

    plant.run(controller, seconds, at_each, PERIOD)
    return np.array(errors)


def test_a_payload_is_found_published_and_compensated(ur10e):
    library, _, loaded = ur10e
    worst = {}
    for use in ("monitor", "compensate"):
        loaded.start(START)
        controller = Controller(library, N, measured_effort=False, estimator=use, **STIFF)
        errors = tracked(controller, loaded, 8.0)
        assert controller.text("state") == "computed_torque"
        worst[use] = errors[-1000:].max()
        frame, payload = controller.payload()
        assert frame == "wrist_3"
        assert payload[10] < MASS < payload[11]
        np.testing.assert_allclose(payload[0], MASS, atol=0.15)
        np.testing.assert_allclose(payload[1:4], CENTER, atol=0.02)
        assert controller.allocations == 0
    assert worst["compensate"] < 0.2 * worst["monitor"]
    # gravity compensation includes the found load, so that the arm stays where it is
    controller.set("mode", "gravity_compensation")
    controller.set("gravity_damping", 5.0)
    loaded.run(controller, 1.0, period=PERIOD)
    q, _, _ = loaded.run(controller, 0.5, period=PERIOD)
    assert np.abs(q[-1] - q[0]).max() < 2e-3


def test_without_a_payload_none_is_published_and_a_push_is_a_contact(ur10e):
    library, free, _ = ur10e
    free.start(START)
    controller = Controller(library, N, measured_effort=True, joint_prefix="left_", **STIFF)
    controller.commands = np.full(N, np.nan)  # there are no earlier commands before the first cycle
    tip = tip_kinematics(load_arm(ROBOTS / "ur10e.urdf"))
    force = np.array([30.0, -20.0, -60.0])  # [N] force at the tip, in the root frame
    contacts, external = [], []
    for cycle in range(2500):
        t = cycle * PERIOD
        controller.reference(*moving(t))
        tau = controller.update(free.q, free.qd, controller.commands, PERIOD)
        q, push = torch.from_numpy(free.q), np.zeros(N)
        if t > 4.5:
            push = tip.jacobian(q).numpy()[:3].T @ force
        free.step(tau + push, PERIOD)
        if cycle % 10 == 0:
            contacts.append(controller.joint_state("~/contact"))
            external.append(controller.joint_state("~/external_torque"))
    assert not any(contacts[:225])
    assert "left_shoulder_lift_joint" in contacts[-1]
    names = [f"left_{c}" for c in ("shoulder_pan_joint", "shoulder_lift_joint", "elbow_joint")]
    assert list(external[-1])[:3] == names
    assert np.abs(push).max() > 30
    np.testing.assert_allclose(list(external[-1].values()), push, atol=0.05 * np.abs(push).max())
    assert contacts[-1][names[1]] == external[-1][names[1]]
    frame, wrench = controller.wrench()
    assert frame == "left_wrist_3"
    rotation = tip.pose(q).numpy()[:3, :3]
    np.testing.assert_allclose(wrench[:3], rotation.T @ force, atol=5)
    np.testing.assert_array_equal(wrench[3:], 0)
    frame, payload = controller.payload()
    assert payload[0] == 0
    assert controller.text("state") == "computed_torque"
    controller.call("set_flag", b"stop_on_contact", 1)
    controller.update(free.q, free.qd, controller.commands, PERIOD)
    assert controller.text("state") == "damping: contact"


def test_efforts_that_are_not_finite_do_not_stop_the_controller(ur10e):
    library, free, _ = ur10e
    free.start(START)
    controller = Controller(library, N)
    tau = controller.update(START, np.zeros(N), np.full(N, np.nan), PERIOD)
    assert np.isfinite(tau).all()
    assert controller.text("state") == "gravity_compensation"


def test_hostile_inputs_never_give_torques_beyond_the_limits(ur10e):
    library, _, _ = ur10e
    controller = Controller(library, N, estimator="compensate", **STIFF)
    effort = np.array([330, 330, 150, 54, 54, 54])
    random = np.random.default_rng(1)
    values = np.array([0.0, 1e-320, 1e300, -1e300, np.inf, -np.inf, np.nan, 3.0, 1e6])
    for cycle in range(10_000):
        q, qd, measured, reference = START + 0.01 * random.standard_normal((4, N))
        for target in (q, qd, measured, reference):
            if random.random() < 0.1:
                target[random.integers(N)] = random.choice(values)
        controller.reference(reference)
        if cycle % 100 == 0:
            controller.activate()
            controller.set("mode", random.choice(["gravity_compensation", "computed_torque"]))
        tau = controller.update(q, qd, measured, random.choice([PERIOD, PERIOD, 0.0, -1.0, 10.0]))
        assert np.isfinite(tau).all()
        assert (np.abs(tau) <= effort).all()
    assert controller.allocations == 0


def test_the_parameter_file_has_the_parameters_and_their_defaults(ur10e):
    library, free, _ = ur10e
    own = yaml.safe_load((free.folder / "package/config/controller.yaml").read_text())
    parameters = own["ur10e_controller"]["ros__parameters"]
    parameters.pop("type")
    controller = Controller(library, N, **parameters)
    assert set(parameters) == set(controller.text("parameters").split())


def test_recordings_of_a_robot_cause_no_stop(ur10e, shared):
    """The checks of jumps, frozen positions and velocities accept all samples of a recorded UR10e."""
    library, _, _ = ur10e
    joints = ("shoulder_pan", "shoulder_lift", "elbow", "wrist_1", "wrist_2", "wrist_3")
    recordings = sorted((shared / "logs" / "ur10e").glob("*.parquet"))
    assert recordings
    for path in recordings:
        table = parquet.read_table(path)
        q, qd, tau = (
            np.stack([table[f"{x}_{joint}_joint"] for joint in joints], 1) for x in ("q", "qd", "tau")
        )
        controller = Controller(library, N)
        for k, period in enumerate(np.diff(table["t"].to_numpy())):
            controller.update(q[k], qd[k], tau[k], period)
            if k % 2 == 0:
                assert controller.text("state") == "gravity_compensation"
