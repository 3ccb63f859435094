"""If recordings have different loads, a warning names them with the masses: no single model fits all of them."""

import re
from dataclasses import replace

import numpy as np
import pytest
from test_log_geometry import arm, excitation, pick_and_place, recorded  # noqa: F401

from spelgen.arm.configured_arm import load_arm
from spelgen.dynamics.regressor_dynamics import regressor
from spelgen.errors import LogError
from spelgen.log_checks.check_logs import check_logs, require_sound_logs
from spelgen.logs.read import read_logs

CENTER = np.array([0.05, 0.02, 0.15])


def loaded(arm, log, mass):  # noqa: F811
    """Return the log of the same motion with a load: a point mass `mass` [kg] at `CENTER` [m] of the last link.

    log: log of the arm without a load; the torques of the load are added to its torques.
    """
    qdd = np.gradient(log.qd, log.t, axis=0)
    inertia = mass * (CENTER @ CENTER * np.eye(3) - np.outer(CENTER, CENTER))
    load = np.concatenate([[mass], mass * CENTER, inertia[np.triu_indices(3)]])
    return replace(log, tau=log.tau + regressor(arm.chain, log.q, log.qd, qdd)[..., -10:] @ load)


def parts(log, count=4):
    """Split a recording into `count` consecutive recordings of equal length, and so of different motions."""
    size = len(log.t) // count
    return [replace(log[k * size : (k + 1) * size], name=f"part {k}") for k in range(count)]


def warnings(arm, logs):  # noqa: F811
    """Return the warnings about different loads; there must be no error."""
    report = check_logs(logs, arm)
    assert report.errors == ()
    return [x.message for x in report.findings if x.code == "different-loads"]


def masses(text):
    """Return {recording: (mass [kg], half width of its interval)} from a warning."""
    found = re.findall(r"(part \d) \((\S+) \+- (\S+) kg\)", text)
    return {name: (float(mass), float(width)) for name, mass, width in found}


@pytest.mark.parametrize("arm", ["rpr", "four_dof"], indirect=True)
@pytest.mark.parametrize("mass", [1.0, 3.0])
def test_recordings_with_another_load_are_named_with_its_mass(arm, mass):  # noqa: F811
    logs = parts(recorded(arm, 3))
    for others in ((1,), (0, 3)):
        mixed = [loaded(arm, x, mass) if k in others else x for k, x in enumerate(logs)]
        (text,) = warnings(arm, mixed)
        found = masses(text)
        if len(others) == 1:
            assert found.keys() == {f"part {k}" for k in others}
        # of two equal groups, either may be the reference
        assert found.keys() in (
            {f"part {k}" for k in others},
            {f"part {k}" for k in {0, 1, 2, 3} - {*others}},
        )
        for value, width in found.values():
            assert abs(abs(value) - mass) < max(2 * width, 0.1 * mass)


@pytest.mark.parametrize("arm", ["rpr", "four_dof"], indirect=True)
@pytest.mark.parametrize("seed", [0, 1])
def test_recordings_with_one_load_are_not_doubted(arm, seed):  # noqa: F811
    """Different motions, or another friction or torque offset in one recording, are not reported as another load."""
    first, second, *others = parts(recorded(arm, seed))
    size = first.tau.std(axis=0)
    still = parts(recorded(arm, seed, pick_and_place))
    for logs in (
        [first, second, *others],
        [*others, replace(first, tau=first.tau + 0.1 * size), second],
        [*others, replace(first, tau=first.tau + 0.1 * size * np.sign(first.qd)), second],
        still,
    ):
        assert warnings(arm, logs) == []


def rests_first(joint):
    """Return a motion in which all joints move, but a joint begins to move after 70 % of the time only."""

    def motion(arm, rng):  # noqa: F811
        t, q = excitation(arm, rng)
        s = np.clip((t - 0.7 * t[-1]) / 2.0, 0.0, 1.0)
        q[:, joint] *= 10 * s**3 - 15 * s**4 + 6 * s**5
        return t, q

    return motion


@pytest.mark.parametrize("arm", ["rpr", "four_dof"], indirect=True)
@pytest.mark.parametrize("seed", [0, 1, 2])
def test_stiction_of_a_joint_at_rest_is_no_other_zero_of_its_torque(arm, seed):  # noqa: F811
    """Dry friction carries a part of the load of a joint until it moves: it is no change of the torque's zero."""
    log = recorded(arm, seed, rests_first(1), noise=0.01)
    at_rest = np.abs(log.qd[:, 1]) < 1e-6
    tau = log.tau.copy()
    tau[:, 1] += at_rest * 0.4 * tau[:, 1].std()
    assert check_logs([replace(log, tau=tau)], arm).errors == ()


@pytest.mark.parametrize("arm", ["four_dof"], indirect=True)
def test_one_load_among_many_recordings_is_named_once(arm):  # noqa: F811
    first, *others = parts(recorded(arm, 3), 25)
    (text,) = warnings(arm, [loaded(arm, first, 3.0), *others])
    assert masses(text).keys() == {"part 0"} and text.count("part 0 ") == 1


@pytest.mark.parametrize("arm", ["rpr"], indirect=True)
def test_a_tool_that_the_urdf_lacks_is_no_other_zero(arm):  # noqa: F811
    """A tool of 3 kg in all recordings is not mistaken for wrong zeros, senses, order, units or gravity."""
    assert warnings(arm, [loaded(arm, x, 3.0) for x in parts(recorded(arm, 3))]) == []


@pytest.mark.parametrize("arm", ["four_dof"], indirect=True)
def test_training_is_told_of_different_loads(arm):  # noqa: F811
    first, second, *_ = parts(recorded(arm, 5))
    notes = require_sound_logs([loaded(arm, first, 2.0), second], arm)
    assert "different-loads" in [note.code for note in notes]


@pytest.mark.parametrize("arm", ["rpr", "four_dof"], indirect=True)
@pytest.mark.parametrize("joint", [None, 0, 1])
@pytest.mark.parametrize("factor", [-1.0, 0.5, 0.7, 1.5])
def test_torques_whose_scale_changes_within_a_recording_are_an_error(arm, joint, factor):  # noqa: F811
    """The error names the joint and the time of the change, also in one of several recordings."""
    log = recorded(arm, 6)
    late = log.t[:, None] > 0.6 * log.t[-1]
    changed = late if joint is None else late & (np.arange(log.q.shape[1]) == joint)
    wrong = replace(log, tau=log.tau * np.where(changed, factor, 1.0))
    with pytest.raises(LogError, match="--accept torque-changed") as caught:
        require_sound_logs([wrong], arm)
    assert ("all joints" if joint is None else repr(arm.chain.joint_names[joint])) in str(caught.value)
    time, ratio = re.search(r"from about (\S+) s .* (\S+) times", str(caught.value)).groups()
    assert abs(float(time) - 12.0) <= 1.0 and abs(float(ratio) - factor) < 0.1 * abs(factor)


@pytest.mark.parametrize("arm", ["rpr", "four_dof"], indirect=True)
def test_another_zero_of_a_torque_within_a_recording_is_an_error(arm):  # noqa: F811
    log, k = recorded(arm, 7), 1
    late = (log.t[:, None] > 8.0) & (np.arange(log.q.shape[1]) == k)
    (error,) = check_logs([replace(log, tau=log.tau + late * log.tau[:, k].std())], arm).errors
    assert "another zero" in str(error) and repr(arm.chain.joint_names[k]) in str(error)


@pytest.mark.parametrize("arm", ["rpr", "four_dof"], indirect=True)
@pytest.mark.parametrize("seed", [8, 9])
def test_a_load_that_is_picked_up_or_warm_friction_is_no_change_of_torques(arm, seed):  # noqa: F811
    log = recorded(arm, seed)
    size, late = log.tau.std(axis=0), log.t[:, None] > 9.0
    warm = 0.15 * size * np.exp(-log.t / 6.0)[:, None]
    for tau in (
        log.tau,
        np.where(late, loaded(arm, log, 2.0).tau, log.tau),
        log.tau + warm * np.sign(log.qd),
        log.tau + 0.3 * size * log.t[:, None] / log.t[-1],
    ):
        assert not any("torque-changed" in str(x) for x in check_logs([replace(log, tau=tau)], arm).errors)


def test_recordings_of_a_ur10e_with_loads_are_found(shared):
    """Three of four recordings by Mamedov have loads; the authors state 2.6 kg for one of them."""
    folder = shared / "logs" / "ur10e"
    arm = load_arm(folder / "ur10e.urdf")  # noqa: F811
    names = ["20_02_10_30sec_12harm", "20_02_05_20sec_8harm", "20_02_12_40sec_12harm", "20_01_13_load_2600"]
    logs = read_logs([folder / f"{name}.parquet" for name in names], arm)
    assert warnings(arm, logs[:3]) == []
    (text,) = warnings(arm, logs)
    ((mass, width),) = [
        (float(a), float(b)) for a, b in re.findall(r"load_2600 \((\S+) \+- (\S+) kg\)", text)
    ]
    assert abs(mass - 2.6) < 2 * width < 0.6


def test_a_torque_in_another_unit_is_no_changed_zero_of_another_joint(shared):
    """The torque of a UR10e's elbow in kNm is not explained by another zero of the wrist's torque."""
    ur10e = load_arm(shared / "logs" / "ur10e" / "ur10e.urdf")
    (log,) = read_logs([shared / "logs" / "ur10e" / "20_02_05_20sec_12harm.parquet"], ur10e)
    scaled = replace(log, tau=log.tau * np.where(np.arange(6) == 2, 1e-3, 1.0))
    assert not any("torque-changed" in str(error) for error in check_logs([scaled], ur10e).errors)
