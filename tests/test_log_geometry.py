"""`spelgen logs` advises the right lines for a log whose columns, zeros or gravity differ from the settings.

Faults are random: joint, order, angle and direction. After the advised line is written into the settings, the log is
read without the fault. The URDF's inertials are 30 % wrong, torques have noise, and joints have friction.
"""

import re
import shutil
from dataclasses import replace
from fractions import Fraction

import numpy as np
import pytest
from scipy.signal import lfilter

from spelgen.arm.configured_arm import load_arm
from spelgen.dynamics.regressor_dynamics import regressor, urdf_parameters
from spelgen.errors import SpelgenError
from spelgen.identification.geometry_search import _likely, kinds_of_faults
from spelgen.identification.hypotheses import Hypothesis, HypothesisFit
from spelgen.log_checks.check_logs import check_logs, require_sound_logs
from spelgen.logs.read import read_logs, write_logs
from spelgen.logs.trajectory import Trajectory
from spelgen.settings.log_mapping import LogMapping

# most tests use the first four joints of an arm, as a search with six joints takes three seconds, with four one
ROBOTS = ("rpr", "four_dof")
RATE, SECONDS = 100.0, 20.0


@pytest.fixture(scope="module", params=ROBOTS)
def arm(request, robots, tmp_path_factory):
    folder = tmp_path_factory.mktemp(request.param)
    # the URDF has no effort limits, which would show the unit of torques
    path = robots / f"{request.param.replace('four', 'six')}.urdf"
    text = re.sub(r'effort="[^"]*"', 'effort="0"', path.read_text())
    if request.param == "four_dof":
        text = re.sub(r'(name="joint[56]" type=)"revolute"', r'\1"fixed"', text)
    (folder / "arm.urdf").write_text(text)
    return load_arm(folder / "arm.urdf")


def excitation(arm, rng):
    t = np.arange(0.0, SECONDS, 1 / RATE)
    n = len(arm.chain.coordinates)
    q = rng.uniform(-0.5, 0.5, n) * np.ones((len(t), 1))
    for omega in 2 * np.pi * rng.uniform(0.05, 0.5, (4, n)):
        q = q + rng.uniform(0.1, 0.4, n) * np.sin(omega * t[:, None] + rng.uniform(0, 6, n))
    return t, q


def pick_and_place(arm, rng):
    t = np.arange(0.0, SECONDS, 1 / RATE)
    s = np.clip((t % 2.0) / 1.6, 0.0, 1.0)[:, None]  # each motion takes 1.6 s, followed by 0.4 s of rest
    stops = rng.uniform(-1.0, 1.0, (round(SECONDS / 2) + 1, len(arm.chain.coordinates)))
    number = (t // 2.0).astype(int)
    return t, stops[number] + (10 * s**3 - 15 * s**4 + 6 * s**5) * (stops[number + 1] - stops[number])


def recorded(arm, seed, motion=excitation, noise=0.02, gravity=1.0) -> Trajectory:
    """Return a log of an arm whose inertials differ by 30 % from the URDF's, with friction and noise.

    motion: returns times (T,) and positions (T, n). noise: relative to the standard deviation of each torque.
    gravity: factor on the gravity torque.
    """
    rng = np.random.default_rng(seed)
    t, q = motion(arm, rng)
    qd = np.gradient(q, t, axis=0)
    qdd = np.gradient(qd, t, axis=0)
    factors = np.exp(0.3 * rng.standard_normal((len(arm.chain.bodies), 2)))
    parameters = urdf_parameters(arm.chain).reshape(-1, 10) * np.repeat(factors, (4, 6), axis=1)
    still = np.zeros_like(q)
    load = regressor(arm.chain, q, still, still) @ parameters.ravel()
    rigid = regressor(arm.chain, q, qd, qdd) @ parameters.ravel() + (gravity - 1.0) * load
    size = rigid.std(axis=0)
    tau = rigid + 0.1 * size * (np.sign(qd) + qd / np.abs(qd).max(axis=0))
    return Trajectory(t, q, qd, tau + noise * size * rng.standard_normal(q.shape), "motion")


def flipped(log, k, motion, torque):
    sign = 1.0 - 2.0 * (np.arange(log.q.shape[1]) == k)
    q, qd = (log.q * sign, log.qd * sign) if motion else (log.q, log.qd)
    return replace(log, q=q, qd=qd, tau=log.tau * sign if torque else log.tau)


def drawn_joint(log, rng, first=0):
    # never the last joint: if its link is symmetric, its sense and its zero have no effect on torques
    return int(rng.integers(first, log.q.shape[1] - 1))


def ordered(log, rng):
    order = rng.permutation(log.q.shape[1])
    while (order == np.arange(len(order))).all():
        order = rng.permutation(len(order))
    return order


def wrong_order(log, rng):
    order = ordered(log, rng)
    return replace(log, q=log.q[:, order], qd=log.qd[:, order], tau=log.tau[:, order])


FAULTS = {
    "position": ("joint-sense", lambda log, rng: flipped(log, drawn_joint(log, rng), True, False)),
    "torque": ("torque-sense", lambda log, rng: flipped(log, drawn_joint(log, rng), False, True)),
    "position and torque": ("joint-sense", lambda log, rng: flipped(log, drawn_joint(log, rng), True, True)),
    "order": ("joint-order", wrong_order),
    "order of torques": ("torque-order", lambda log, rng: replace(log, tau=log.tau[:, ordered(log, rng)])),
}


def told(arm, log, mapping=None):
    """Return the text of the error about a log; there must be exactly one."""
    report = check_logs([log], arm, mapping)
    (error,) = report.errors
    return str(error)


def mended(arm, error, logs):
    """Write the first line that an error advises into the settings; return the arm and the logs, both read again."""
    line, place = re.search(r"write '(.*?)' ((?:under 'logs' )?)in the robot's YAML", error).groups()
    settings = arm.robot.path.with_suffix(".yaml")
    settings.write_text(f"logs: {{{line}}}\n" if place else f"{line}\n")
    try:
        again = load_arm(arm.robot.path)
        return again, read_logs([logs], again)
    finally:
        settings.unlink()


@pytest.mark.parametrize("arm", ["rpr", "six_dof", "ur10e"], indirect=True)
@pytest.mark.parametrize("motion", [excitation, pick_and_place])
@pytest.mark.parametrize("noise", [0.005, 0.05])
def test_a_log_that_means_what_it_says_is_not_doubted(arm, motion, noise):
    report = check_logs([recorded(arm, 3, motion, noise)], arm)
    about_geometry = [x for x in report.findings if x.code in ("gravity", "joint-zero", "torque-scale")]
    assert (report.errors, about_geometry) == ((), [])


@pytest.mark.parametrize(
    ("arm", "fault"),
    [(arm, fault) for fault in FAULTS for arm in ("rpr", "ur10e" if "order" in fault else "four_dof")],
    indirect=["arm"],
)
def test_the_line_that_is_named_mends_the_log(arm, fault, tmp_path):
    code, spoil = FAULTS[fault]
    seed = sum(map(ord, fault + arm.chain.name))
    log = recorded(arm, seed, (excitation, pick_and_place)[seed % 2])
    wrong = spoil(log, np.random.default_rng(seed))
    error = told(arm, wrong)
    assert f"--accept {code}" in error
    write_logs(tmp_path / "log.csv", [wrong], arm.chain.joint_names)
    again, (read,) = mended(arm, error, tmp_path / "log.csv")
    for name in ("q", "qd", "tau"):
        np.testing.assert_allclose(getattr(read, name), getattr(log, name), atol=1e-9)
    assert check_logs([read], again).errors == ()


def test_two_reversed_joints_are_not_taken_for_a_third(shared):
    """If two joints are reversed, the error names both, although correcting only the torque of one joint also helps."""
    arm = load_arm(shared / "arms" / "doosan_m1013.urdf")
    wrong = flipped(flipped(recorded(arm, 0), 1, True, False), 4, True, True)
    error = told(arm, wrong)
    assert "'joints: {joint2: {sign: -1, gain: -1}, joint5: {sign: -1}}'" in error
    assert "torques of either sense" in error


def test_four_reversed_torques_are_named_and_no_others(robots):
    """Correcting the three other joints of seven would make the torques consistent, too, but of the opposite sense."""
    arm = load_arm(robots / "panda.urdf")
    log, sign, reversed_joints = recorded(arm, 0), np.ones(7), [1, 2, 3, 5]
    sign[reversed_joints] = -1.0
    lines = ", ".join(f"panda_joint{k + 1}: {{gain: -1}}" for k in reversed_joints)
    assert f"write 'joints: {{{lines}}}' under" in told(arm, replace(log, tau=log.tau * sign))


@pytest.mark.parametrize("arm", ["ur10e", "panda"], indirect=True)
@pytest.mark.parametrize("factor", [0.5, 2.0])
def test_torques_of_one_joint_that_are_half_or_twice_as_large_are_named(arm, factor):
    """Other joints carry the same links: their torques and the inertials show the factor of one joint's torques."""
    log = recorded(arm, 4, excitation, 0.01)
    tau = log.tau.copy()
    tau[:, 2] *= factor
    report = check_logs([replace(log, tau=tau)], arm)
    (warning,) = [x for x in report.findings if x.code == "torque-scale"]
    name = arm.chain.joint_names[2]
    assert (
        f"joint {name!r}" in warning.where and f"torques about {factor:g} times as large" in warning.message
    )
    assert f"write 'joints: {{{name}: {{gain: {1 / factor:g}}}}}' under 'logs'" in warning.message
    assert report.errors == ()


def slowly(arm, rng):
    """Return 8 s of motion at up to 0.15 Hz: torques contain hardly any inertia."""
    t = np.arange(0.0, 8.0, 1 / RATE)
    omega = 2 * np.pi * rng.uniform(0.06, 0.15, (2, len(arm.chain.coordinates)))
    phase = rng.uniform(0, 6, 2)
    return t, sum(0.4 * np.sin(x * t[:, None] + y) for x, y in zip(omega, phase, strict=True))


@pytest.mark.parametrize("arm", ["rpr"], indirect=True)
def test_a_reversed_torque_that_another_link_explains_is_named_with_the_link(arm):
    log = flipped(recorded(arm, 2, slowly, 0.01), 2, False, True)
    report = check_logs([log], arm)
    (message,) = [x.message for x in report.findings if x.code == "urdf-inertials"]
    assert "torques of the opposite sense at joint 'joint3' would explain it" in message
    assert "write 'joints: {joint3: {gain: -1}}' under 'logs'" in message


def test_friction_with_hysteresis_does_not_hide_a_reversed_torque(shared):
    """The last joint of the xArm6 carries no gravity: only friction and inertia show the sign of its torque."""
    arm = load_arm(shared / "arms" / "xarm6.urdf")
    log = recorded(arm, 0, excitation, 0.01)
    assert check_logs([log], arm).errors == ()
    assert "joint 'joint6': got torques of the opposite sense" in told(arm, flipped(log, 5, False, True))


@pytest.mark.parametrize("angle", [90, 180, -90, 37])
def test_a_zero_offset_is_named_to_a_tenth_of_a_radian(arm, angle, tmp_path):
    rng = np.random.default_rng(angle % 360)
    turning = [k for k, x in enumerate(arm.chain.coordinates) if x.joint_type == "revolute"]
    k = turning[1] if len(turning) > 2 else 2
    log = recorded(arm, int(rng.integers(1000)))
    # zero offsets of rpr cannot be found: the same torques also result from other inertials without offset
    if arm.chain.name == "rpr":
        assert check_logs([turned(log, k, np.deg2rad(angle))], arm).errors == ()
        return
    wrong = turned(log, k, np.deg2rad(angle))
    error = told(arm, wrong)
    assert "--accept joint-zero" in error
    write_logs(tmp_path / "log.csv", [wrong], arm.chain.joint_names)
    _, (read,) = mended(arm, error, tmp_path / "log.csv")
    # offsets that differ by a whole turn are equal
    assert np.abs(np.angle(np.exp(1j * (read.q - log.q)))).max() < 0.1


def turned(log, k, angle):
    q = log.q.copy()
    q[:, k] -= angle
    return replace(log, q=q)


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_the_direction_of_gravity_is_found(arm, seed, tmp_path):
    """The direction of gravity is found for a base on a wall, on a ceiling, and in a random orientation."""
    rng = np.random.default_rng(seed)
    direction = [np.array([0.0, 1.0, 0.0]), np.array([0.0, 0.0, 1.0]), rng.standard_normal(3)][seed]
    gravity = 9.81 * direction / np.linalg.norm(direction)
    mounted = replace(arm, chain=replace(arm.chain, gravity=tuple(gravity.tolist())))
    log = recorded(mounted, seed)
    write_logs(tmp_path / "log.csv", [log], arm.chain.joint_names)
    error = told(arm, log)
    lines = re.findall(r"'gravity: \[(.*?)\]'", error)
    # The error may list several corrections. Only its directions of gravity are tested: for rpr on a ceiling, it may
    # first advise a joint of opposite sense, which explains the torques equally well.
    assert lines, error
    np.testing.assert_allclose(list(map(float, lines[0].split(","))), gravity, atol=0.3)


def test_a_reversed_joint_with_another_zero_is_named_with_its_offset(arm):
    """The error names only this joint, and its offset."""
    log = recorded(arm, 12)
    is_wrong = np.arange(log.q.shape[1]) == 2
    sign = np.where(is_wrong, -1.0, 1.0)
    wrong = replace(log, q=sign * log.q + is_wrong * np.pi / 2, qd=sign * log.qd, tau=sign * log.tau)
    error = told(arm, wrong)
    assert "all joints" not in error and "by 0 degrees" not in error and "sign: -1" in error


def test_a_small_tilt_of_the_base_is_a_warning(arm):
    """A base that is tilted by five degrees is a warning, as the mounting of a robot may have this error."""
    tilted = replace(arm, chain=replace(arm.chain, gravity=(0.0, 0.85, -9.77)))
    report = check_logs([recorded(tilted, 16, noise=0.01)], arm)
    assert report.errors == ()
    (note,) = (x for x in report.findings if x.code == "gravity")
    gravity = list(map(float, re.search(r"write 'gravity: \[(.*?)\]'", note.message)[1].split(",")))
    np.testing.assert_allclose(gravity, [0.0, 0.85, -9.77], atol=0.3)


@pytest.mark.parametrize("part", [0.0, -0.12, 0.2])
def test_compensated_gravity_is_called_so(arm, part):
    error = told(arm, recorded(arm, 5, gravity=part))
    assert "gravity is compensated" in error and "--accept gravity-compensated" in error
    assert "sign:" not in error and "gain:" not in error


def test_another_unit_is_offered_as_gain(arm):
    """For torques in another unit, the error advises a gain for each joint, within a factor of 2 of the true gain.

    Gains are found from gravity torques, so their relative errors are the errors of the masses in the URDF.
    """
    log = recorded(arm, 6)
    error = told(arm, replace(log, tau=log.tau / 0.003))
    gains = list(map(float, re.findall(r"gain: ([\d.e-]+)", error)))
    assert "--accept torque-unit" in error and len(gains) == log.q.shape[1]
    np.testing.assert_allclose(np.log(gains), np.log(0.003), atol=np.log(2))


@pytest.mark.parametrize("arm", ["ur10e"], indirect=True)
@pytest.mark.parametrize("masses", ["none", "some", "copied"])
def test_the_size_of_an_arm_shows_mnm_if_its_urdf_lacks_masses_or_has_copied_ones(arm, masses):
    """Copied masses do not show the unit of torques: true masses are 100 times as large here, torques are in Nm."""
    copied = (0.05, 0, 0, 0.005, 0.05, 0, 0, 0.05, 0, 0.05)
    inertias = {"none": [None] * 6, "copied": [copied] * 6}
    inertias["some"] = [arm.chain.bodies[0].inertia, copied, *[None] * 4]
    bodies = tuple(replace(x, inertia=y) for x, y in zip(arm.chain.bodies, inertias[masses], strict=True))
    unknown = replace(arm, chain=replace(arm.chain, bodies=bodies))
    log = recorded(arm, 3)
    report = check_logs([log], unknown)
    assert report.errors == () and "torque-scale" not in [x.code for x in report.findings]
    (error,) = check_logs([replace(log, tau=1000 * log.tau)], unknown).errors
    assert "gain: 0.001" in str(error) and "by the arm's size" in str(error)
    (error,) = check_logs([flipped(log, 1, motion=True, torque=False)], unknown).errors
    name = arm.chain.joint_names[1]
    assert str(error).startswith(f"joint {name!r}: got positions and velocities of the opposite sense")
    assert f"write 'joints: {{{name}: {{sign: -1, gain: -1}}}}'" in str(error)


@pytest.mark.parametrize("arm", ["ur10e"], indirect=True)
def test_effort_limits_of_a_draft_are_no_evidence_of_another_unit(arm):
    """Torques that agree with the URDF's gravity are in Nm, although the URDF states an effort limit of 1 Nm."""
    coordinates = tuple(x._replace(effort=1.0) for x in arm.chain.coordinates)
    draft = replace(arm, chain=replace(arm.chain, coordinates=coordinates))
    assert check_logs([recorded(arm, 3)], draft).errors == ()


def tracked(arm, log, rng):
    """Return the log of proportional servos that move the arm: commands u with kp (u - q) equal to the torques."""
    kp = log.tau.std(axis=0) / rng.uniform(0.02, 0.06, log.q.shape[1])
    u = log.q + log.tau / kp + 0.03 * log.qd
    return replace(log, u=u, tau=np.zeros((len(u), 0)), mapping=LogMapping(input="position"))


@pytest.mark.parametrize("arm", ["four_dof", "ur10e"], indirect=True)
@pytest.mark.parametrize("joint", [1, 2])
def test_a_reversed_joint_of_servos_is_named_although_nothing_explains_the_unchanged_log(arm, joint):
    log = tracked(arm, recorded(arm, 7), np.random.default_rng(7))
    servos = replace(arm, settings=arm.settings.model_copy(update={"input": "position"}))
    assert check_logs([log], servos).errors == ()
    sign = 1.0 - 2.0 * (np.arange(log.q.shape[1]) == joint)
    error = told(servos, replace(log, q=log.q * sign, qd=log.qd * sign, u=log.u * sign))
    assert f"'joints: {{{arm.chain.joint_names[joint]}: {{sign: -1}}}}'" in error


def test_a_link_with_a_mistyped_mass_is_named(arm):
    """A link whose mass in the URDF is six times too large is named; its tensor about the centre of mass is right."""
    moments = [np.linalg.norm(np.array(body.inertia[1:4], dtype=float)) for body in arm.chain.bodies]
    # never body 1: the axis of joint 1 is vertical, so that the body's first moment has no effect
    k = 1 + int(np.argmax(moments[1:]))
    body = arm.chain.bodies[k]
    heavy = replace(body, inertia=(*(6 * float(x) for x in body.inertia[:4]), *body.inertia[4:]))
    mistyped = replace(arm.chain, bodies=(*arm.chain.bodies[:k], heavy, *arm.chain.bodies[k + 1 :]))
    log = recorded(arm, 10)
    report = check_logs([log], replace(arm, chain=mistyped))
    assert report.errors == ()
    (note,) = (x for x in report.findings if x.code == "urdf-inertials")
    assert note.where == f"link {body.link!r}"
    assert not [x for x in check_logs([log], arm).findings if x.code == "urdf-inertials"]


def exact_log_and_mistyped_arm(arm, k, factor):
    """Return the exact log of an arm, and the arm with another mass of body k in its URDF."""
    t, q = excitation(arm, np.random.default_rng(17))
    motion = q, np.gradient(q, t, axis=0), np.gradient(np.gradient(q, t, axis=0), t, axis=0)
    log = Trajectory(t, *motion[:2], regressor(arm.chain, *motion) @ urdf_parameters(arm.chain), "exact")
    bodies = list(arm.chain.bodies)
    inertia = bodies[k].inertia
    bodies[k] = replace(bodies[k], inertia=(*(factor * x for x in inertia[:4]), *inertia[4:]))
    return log, replace(arm, chain=replace(arm.chain, bodies=tuple(bodies))), f"link {bodies[k].link!r}"


@pytest.mark.parametrize(("arm", "k"), [("ur10e", 3), ("ur10e", 5), ("rpr", 2)], indirect=["arm"])
def test_a_mistyped_mass_at_the_wrist_is_named(arm, k):
    """A wrist link with ten times its mass in the URDF is named, also if its own joint sees little of its weight."""
    log, mistyped, link = exact_log_and_mistyped_arm(arm, k, 10)
    report = check_logs([log], mistyped)
    assert report.errors == ()
    found = [(x.code, x.where) for x in report.findings if not x.code.startswith("beyond")]
    assert found == [("urdf-inertials", link)]


@pytest.mark.parametrize("arm", ["rpr"], indirect=True)
def test_a_last_link_that_is_too_light_is_wrong_or_carries_a_tool(arm):
    """If the URDF's last link is too light, the link is named with its mass ratio, and the log is not refused."""
    log, mistyped, link = exact_log_and_mistyped_arm(arm, 2, Fraction(1, 10))
    report = check_logs([log], mistyped)
    assert report.errors == ()
    (note,) = [x for x in report.findings if x.code == "urdf-inertials"]
    ratio, width = map(float, re.search(r"is (\S+) \+- (\S+) times", note.message).groups())
    assert abs(ratio - 10) < 2 * width < 1 and "or add the tool" in note.message
    found = [(x.code, x.where) for x in report.findings if not x.code.startswith("beyond")]
    assert found == [("urdf-inertials", link)]


@pytest.mark.parametrize(("name", "seed"), [("six_dof", 18), ("rpr", 19)])
def test_the_torque_of_a_joint_at_rest_refuses_no_log(robots, name, seed):
    """Dry friction carries the load of the first joint, except for a part of the peaks.

    The torque of this joint then differs from the rigid-body torque, which is reported, but is no error. The prismatic
    joint of "rpr" moves beyond its limits, so its unit is tested, also in the columns of the joint at rest.
    """

    def held(arm, rng):
        t, q = excitation(arm, rng)
        q[:, 0] = 0.3 + 1e-4 * np.sin(5 * t) * np.sin(t)
        return t, q

    arm = load_arm(robots / f"{name}.urdf")
    log, rng = recorded(arm, seed, held), np.random.default_rng(0)
    load = log.tau[:, 0] - log.tau[:, 0].mean()
    peaks = np.sign(load) * np.maximum(np.abs(load) - 0.8 * load.std(), 0.0)
    log.tau[:, 0] = 0.1 * peaks + 0.02 * load.std() * rng.standard_normal(len(load))
    report = check_logs([log], arm)
    assert "torque-unexplained" not in [code for error in report.errors for code in error.codes]


def test_unexplained_torques_of_an_arm_with_one_joint_are_reported(robots):
    arm = load_arm(robots / "two_link.urdf", joints=["joint2"])
    log = recorded(arm, 18)
    noise = log.tau.std() * np.random.default_rng(18).standard_normal(log.tau.shape)
    report = check_logs([replace(log, tau=noise)], arm)
    assert "no hypothesis" in " ".join(map(str, (*report.errors, *report.findings)))


@pytest.mark.parametrize("arm", ["rpr"], indirect=True)
@pytest.mark.parametrize("form", ["noise", "one joint", "late", "load register"])
def test_torques_that_no_hypothesis_explains_are_asked_for(arm, form):
    """Torque columns that contain another signal give one finding, which advises the user to check the columns.

    It has no settings line, since none would correct them. A finding that is an error names the option to accept it.
    """
    log, rng = recorded(arm, 18), np.random.default_rng(18)
    other = log.tau.std(axis=0) * lfilter([0.2], [1, -0.98], rng.standard_normal(log.tau.shape), axis=0)
    tau = {
        "noise": rng.standard_normal(log.tau.shape),
        "one joint": np.where(np.arange(3) == 1, other, log.tau),
        "late": np.roll(log.tau, 300, axis=0),
        "load register": np.round(100 * np.abs(other) / log.tau.std(axis=0)),
    }[form]
    report = check_logs([replace(log, tau=tau)], arm)
    found = [str(x) for x in (*report.errors, *report.findings) if "no hypothesis" in str(x)]
    assert len(found) == 1 and "write '" not in found[0]
    if report.errors:
        assert "--accept torque-unexplained" in found[0]
        mapping = LogMapping.model_validate({"accept": ["torque-unexplained"]})
        assert check_logs([replace(log, tau=tau)], arm, mapping).errors == ()


def test_torques_of_opposite_sense_are_named_although_friction_dominates_one_of_them(robots):
    """The reversal changes no residual: the one of the first joint, which carries no load, remains large."""
    arm = load_arm(robots / "ur10e.urdf")
    log, rng = recorded(arm, 0), np.random.default_rng(0)
    other = lfilter([0.2], [1, -0.98], rng.standard_normal(len(log)))
    first = log.tau[:, 0] + 0.7 * log.tau[:, 0].std() * other / other.std()
    error = told(arm, replace(log, tau=-np.column_stack([first, log.tau[:, 1:]])))
    assert "all joints: got torques of the opposite sense" in error


def test_the_geometry_of_a_log_with_too_little_motion_is_not_tested(arm):
    """A log with too little motion is not tested for faults such as a reversed joint: a remark states the small motion.

    Its torques are mostly friction before sliding, which a wrong hypothesis may explain better than the right one.
    """
    log = recorded(arm, 18)
    small = replace(log, q=log.q[0] + 0.002 * (log.q - log.q[0]), qd=0.002 * log.qd)
    for logged in (small, flipped(small, 1, True, False)):
        report = check_logs([logged], arm)
        assert report.errors == () and "small-motion" in [x.code for x in report.findings]


def test_the_geometry_of_motions_in_one_direction_is_not_tested(arm):
    """Most joints move one way in synchronous motions between two positions: their friction is a constant torque.

    Wrong hypotheses, such as exchanged columns and another torque unit at once, can explain such torques better.
    """

    def one_way(arm, rng):
        t = np.arange(0.0, SECONDS, 1 / RATE)
        s = (t / SECONDS)[:, None]
        return t, rng.uniform(0.5, 1.5, len(arm.chain.coordinates)) * (10 * s**3 - 15 * s**4 + 6 * s**5)

    log = recorded(arm, 18, one_way)
    for logged in (log, flipped(log, 1, False, True)):
        report = check_logs([logged], arm)
        assert report.errors == () and "small-motion" in [x.code for x in report.findings]


@pytest.mark.parametrize("arm", ["four_dof"], indirect=True)
def test_a_held_joint_does_not_prevent_the_tests_of_the_others(arm):
    """A reversed joint is found although a controller holds the last joint.

    The velocities of the last joint are smaller than the resolution of velocities in the log.
    """

    def held(arm, rng):
        t, q = excitation(arm, rng)
        q[:, -1] = 0.004 * np.sin(2 * t)
        return t, q

    log = recorded(arm, 4, held)
    rng = np.random.default_rng(1)
    qd = log.qd.copy()
    qd[:, -1] = 0.0147 * rng.integers(-2, 3, len(qd))
    sound = replace(log, qd=qd)
    assert "velocity-is-no-derivative" not in [x.code for x in check_logs([sound], arm).findings]
    assert "--accept joint-sense" in told(arm, flipped(sound, 1, True, False))


@pytest.mark.parametrize("joint", [0, 1])
def test_wrong_velocities_of_one_joint_do_not_prevent_the_tests(arm, joint):
    """If velocities of a joint contradict its positions, the checks of geometry use derivatives of the positions.

    Here the velocities are 1.5 times too large, or noise. A warning names them, and a reversed joint is still found.
    """
    log, rng = recorded(arm, 21), np.random.default_rng(21)
    noise = rng.normal(size=len(log.t)) * log.qd[:, joint].std()
    for velocity in (1.5 * log.qd[:, joint], noise):
        sound = replace(log, qd=np.where(np.arange(log.q.shape[1]) == joint, velocity[:, None], log.qd))
        report = check_logs([sound], arm)
        assert report.errors == ()
        assert "velocity-is-no-derivative" in [x.code for x in report.findings]
        for k in range(2):
            assert "--accept joint-sense" in told(arm, flipped(sound, k, True, False))


def test_the_sense_of_a_joint_is_more_likely_than_an_exchange_that_explains_little_more(arm):
    """A reversed joint is listed before exchanged columns, even if the cost of exchanged columns is somewhat lower.

    Exchanged columns may also explain errors of the friction model. The reversed joint is omitted if it lowers the cost
    only a little. Costs are relative to the unchanged log.
    """
    order, _, _, _, sense, *_ = kinds_of_faults(arm.chain)
    present = Hypothesis.unchanged(arm.chain)
    sign = np.ones_like(present.scale)
    sign[1, 0] = -1.0
    hypotheses = (
        present,
        present.changed(order, source=present.source[:, ::-1]),
        present.changed(sense, scale=sign),
    )
    fits = [
        HypothesisFit(x, cost, 0.0, *np.zeros((3, 1)))
        for x, cost in zip(hypotheses, (0, -30, -14), strict=True)
    ]
    assert [x.hypothesis.faults for x in _likely(fits[0], fits)] == [(sense,), (order,)]
    assert [x.hypothesis.faults for x in _likely(fits[0], [fits[1], replace(fits[2], cost=-5.0)])] == [
        (order,)
    ]


@pytest.mark.parametrize("arm", ["rpr"], indirect=True)
def test_noise_of_joints_at_rest_is_no_wrong_torque(arm):
    log, rng = recorded(arm, 19), np.random.default_rng(19)
    q = np.where(np.arange(3) == 2, log.q, log.q[0])
    motion = q, np.gradient(q, log.t, axis=0), np.gradient(np.gradient(q, log.t, axis=0), log.t, axis=0)
    tau = regressor(arm.chain, *motion) @ urdf_parameters(arm.chain)
    tau = tau + 0.5 * tau.std(axis=0).max() * rng.standard_normal(q.shape) * [1, 1, 0.02]
    assert check_logs([Trajectory(log.t, *motion[:2], tau, "rest")], arm).errors == ()


def test_training_refuses_it_unless_it_is_accepted(arm):
    wrong = flipped(recorded(arm, 7), 1, True, False)
    with pytest.raises(SpelgenError, match="--accept joint-sense"):
        require_sound_logs([wrong], arm)
    require_sound_logs([wrong], arm, LogMapping.model_validate({"accept": ["joint-sense"]}))


def test_a_line_keeps_what_the_mapping_states(arm):
    """Advised gains and signs are the values in the mapping times the correction.

    Here the correction is -1: the sign -1 becomes 1, the gain 14.2 becomes -14.2.
    """
    joint = arm.chain.joint_names[1]
    mapping = LogMapping.model_validate({"joints": {joint: {"gain": 14.2, "sign": -1}}})
    error = told(arm, flipped(recorded(arm, 8), 1, True, False), mapping)
    assert f"'joints: {{{joint}: {{sign: 1, gain: -14.2}}}}' under 'logs'" in error


@pytest.mark.parametrize("arm", ["rpr", "six_dof"], indirect=True)
def test_a_slow_arm_with_right_torques_is_not_refused(arm):
    """A slow arm with right torques is accepted, although its accelerations are differences of noisy positions.

    The log has 12.5 Hz, and the motion an eighth of the speed of the other tests.
    """
    log = recorded(arm, 9)
    t, qd = 8.0 * log.t, log.qd / 8.0
    rigid = regressor(arm.chain, log.q, qd, np.gradient(qd, t, axis=0)) @ urdf_parameters(arm.chain)
    rng = np.random.default_rng(0)
    q = log.q + 1e-4 * rng.standard_normal(log.q.shape)
    tau = rigid + 0.1 * rigid.std(axis=0) * np.sign(qd) + 0.05 * rng.standard_normal(q.shape)
    slow = Trajectory(t, q, np.gradient(q, t, axis=0), tau, "motion")
    assert check_logs([slow], arm).errors == ()


def test_gravity_along_all_axes_is_called_compensated(tmp_path):
    """A log without gravity torques is reported as compensated gravity, not as gravity along the joint axes.

    Both explain the log: the axes of both joints are parallel, and gravity along them would cause no torques.
    """
    rows = (
        ("shoulder", "revolute", "base", "0 0 0", "0 1 0", -3, 3, 2),
        ("elbow", "revolute", "shoulder_link", "0.3 0 0", "0 1 0", -3, 3, 1),
    )
    arm = made_arm(tmp_path, rows)
    error = told(arm, recorded(arm, 5, gravity=0.0))
    assert "--accept gravity-compensated" in error and "'gravity: [0, 0, 0]' in the robot's YAML" in error
    assert "or 'gravity" not in error


def test_factors_of_torques_that_differ_are_stated_per_joint(robots, tmp_path):
    arm = load_arm(shutil.copy(robots / "two_link.urdf", tmp_path))
    upright = replace(arm, chain=replace(arm.chain, gravity=(0.0, -9.81, 0.0)))
    log = recorded(upright, 6)
    error = told(upright, replace(log, tau=log.tau * [37.0, 11.0]))
    gains = np.array(list(map(float, re.findall(r"gain: ([\d.e-]+)", error))))
    assert "--accept torque-unit" in error
    # the ratio of both gains is determined by the coupling of the joints
    assert gains[1] / gains[0] == pytest.approx(37 / 11, rel=0.05)
    # the common factor of both gains follows only from the URDF's masses, so it is right only within a factor of 2
    np.testing.assert_allclose(np.log(gains * [37.0, 11.0]), 0.0, atol=np.log(2))


def test_magnitudes_of_a_torque_are_not_explained_by_factors(shared):
    """If the torque of one joint is logged without its sign, the error names this joint and advises no gains.

    Gains of all joints would lower the torque residual a little, but they are not the cause.
    """
    arm = load_arm(shared / "logs" / "airbot" / "airbot.urdf")
    (log,) = read_logs(shared / "logs" / "airbot" / "ga_N12T25.parquet", arm)
    tau = log.tau.copy()
    tau[:, 1] = np.abs(tau[:, 1])
    error = told(arm, replace(log, tau=tau))
    assert "joint 'joint2', tau: got torques without sign" in error and "gain" not in error
    assert "--accept torque-without-sign" in error


@pytest.mark.parametrize("of_all", [False, True])
def test_torques_that_were_logged_as_magnitudes_are_named(arm, of_all):
    """If torques of one joint or of all joints are logged as magnitudes |tau|, the error names these joints.

    Joints whose true torque has one sign in at least nine tenths of the samples are not named.
    """
    log = recorded(arm, 14)
    share = np.minimum((log.tau > 0).mean(axis=0), (log.tau < 0).mean(axis=0))
    unsigned = np.full(len(share), True) if of_all else share == share.max()
    error = told(arm, replace(log, tau=np.where(unsigned, np.abs(log.tau), log.tau)))
    assert "--accept torque-without-sign" in error
    named = [name in error for name in arm.chain.joint_names]
    np.testing.assert_array_equal(named, unsigned & (share > 0.1))


def test_torques_of_one_direction_by_gravity_are_accepted(robots, tmp_path):
    """Torques that never change sign, since gravity loads both joints to one side throughout, are accepted."""
    arm = load_arm(shutil.copy(robots / "two_link.urdf", tmp_path))
    upright = replace(arm, chain=replace(arm.chain, gravity=(0.0, -9.81, 0.0)))

    def level(arm, rng):
        t, q = excitation(arm, rng)
        return t, 0.3 * (q - q.mean(axis=0))

    log = recorded(upright, 15, level, noise=0.01)
    assert (log.tau > 0).all()
    assert check_logs([log], upright).errors == ()


ROBOT = """<robot name="made">
  <link name="base"/>
  {joints}
</robot>"""
JOINT = """<joint name="{name}" type="{kind}">
    <parent link="{parent}"/><child link="{name}_link"/><origin xyz="{xyz}"/><axis xyz="{axis}"/>
    <limit lower="{lower}" upper="{upper}" effort="0" velocity="0"/>
  </joint>
  <link name="{name}_link"><inertial><mass value="{mass}"/><origin xyz="0.15 0.01 -0.02"/>
    <inertia ixx="0.01" iyy="0.02" izz="0.02" ixy="0" ixz="0" iyz="0"/></inertial></link>"""


def made_arm(folder, rows):
    fields = ("name", "kind", "parent", "xyz", "axis", "lower", "upper", "mass")
    joints = "\n  ".join(JOINT.format(**dict(zip(fields, row, strict=True))) for row in rows)
    (folder / "made.urdf").write_text(ROBOT.format(joints=joints))
    return load_arm(folder / "made.urdf")


@pytest.fixture(scope="module")
def lift(tmp_path_factory):
    """Return an arm whose first joint is a vertical slide."""
    rows = (
        ("slide", "prismatic", "base", "0 0 0", "0 0 1", 0, 0.4, 3),
        ("shoulder", "revolute", "slide_link", "0.1 0 0", "0 0 1", -3, 3, 2),
        ("elbow", "revolute", "shoulder_link", "0.3 0 0", "0 0 1", -3, 3, 1),
    )
    return made_arm(tmp_path_factory.mktemp("lift"), rows)


def lifting(arm, rng):
    t, q = excitation(arm, rng)
    low, high = q[:, 0].min(), q[:, 0].max()
    q[:, 0] = 0.02 + 0.36 * (q[:, 0] - low) / (high - low)
    return t, q


def hysteresis(q, breakaway):
    """Return the normalised friction torque (T, n) of one bristle per joint along positions (T, n).

    breakaway: displacement at which the bristles slip [rad, m].
    """
    z = np.zeros_like(q)
    for k in range(1, len(q)):
        z[k] = np.clip(z[k - 1] + (q[k] - q[k - 1]) / breakaway, -1, 1)
    return z


@pytest.mark.parametrize("seed", [0, 1, 5])
def test_presliding_hysteresis_does_not_hide_exchanged_joints(seed, robots, tmp_path):
    """Exchanged joints are named although friction has a hysteresis: bristles slip at a displacement of 0.05 rad.

    The bristles cause torques of 0.3 standard deviations of the joint's torque, which must not be taken as a delay.
    """
    arm = load_arm(shutil.copy(robots / "two_link.urdf", tmp_path))
    log = recorded(arm, seed, noise=0.005)
    log = replace(log, tau=log.tau + 0.3 * log.tau.std(axis=0) * hysteresis(log.q, 0.05))
    assert check_logs([log], arm).errors == ()
    error = told(arm, replace(log, q=log.q[:, ::-1], qd=log.qd[:, ::-1], tau=log.tau[:, ::-1]))
    assert "{columns: {q: q_joint2, qd: qd_joint2, tau: tau_joint2}}" in error
    assert "delay" not in error


@pytest.mark.parametrize("arm", ["four_dof"], indirect=True)
@pytest.mark.parametrize(("seed", "angle"), [(0, -0.72), (5, -1.15), (8, 1.29)])
def test_presliding_hysteresis_does_not_change_a_zero_offset(arm, seed, angle):
    """The zero of a joint is named to 0.1 rad although its friction has a hysteresis of 0.05 rad.

    If the friction model had no hysteresis, the offset would be wrong by 0.4 rad, as it would compensate friction, or
    would not be found.
    """
    log = recorded(arm, seed, pick_and_place, noise=0.01)
    log = replace(log, tau=log.tau + 0.4 * log.tau.std(axis=0) * hysteresis(log.q, 0.05))
    assert check_logs([log], arm).errors == ()
    error = told(arm, replace(log, q=log.q - angle * np.eye(4)[2]))
    assert float(re.search(r"'joints: {joint3: {offset: (.*?)}}'", error)[1]) == pytest.approx(angle, abs=0.1)


def lifted(arm):
    """Return a log of the lift, whose friction has a hysteresis of 0.05 m and 0.05 rad."""
    log = recorded(arm, 0, lifting)
    return replace(log, tau=log.tau + 0.7 * log.tau.std(axis=0) * hysteresis(log.q, 0.05))


def test_a_lift_whose_position_runs_the_other_way_is_named(lift):
    """A vertical prismatic joint with the opposite sign of its position is found by its position limits and friction.

    Its gravity force does not depend on the position, and so does not show the sign.
    """
    log = lifted(lift)
    assert check_logs([log], lift).errors == ()
    assert "'joints: {slide: {sign: -1, gain: -1}}'" in told(lift, flipped(log, 0, True, False))


def test_an_order_with_a_prismatic_joint_is_named(lift):
    log, order = lifted(lift), [1, 2, 0]
    error = told(lift, replace(log, q=log.q[:, order], qd=log.qd[:, order], tau=log.tau[:, order]))
    for joint, source in (("slide", "elbow"), ("shoulder", "slide"), ("elbow", "shoulder")):
        assert f"{joint}: {{columns: {{q: q_{source}, qd: qd_{source}, tau: tau_{source}}}}}" in error
    assert "delay" not in error
