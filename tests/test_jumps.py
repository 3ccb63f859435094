"""Jumps in logs: each kind of random fault is named, and the advised line restores the log without the fault."""

import re

import numpy as np
import pyarrow as pa
import pyarrow.csv
import pyarrow.parquet
import pytest
import yaml
from servo_arm import write_servo_arm

from spelgen.arm.configured_arm import load_arm
from spelgen.errors import LogError, SpelgenError
from spelgen.log_checks.check_logs import check_logs
from spelgen.logs.checks import check
from spelgen.logs.jumps import is_outlier
from spelgen.logs.read import read_logs
from spelgen.logs.trajectory import Trajectory
from spelgen.settings.log_mapping import LogMapping

ROBOTS = ("two_link", "scara", "six_dof")
FORMATS = ("csv", "parquet", "npz")


@pytest.fixture(params=ROBOTS)
def arm(robots, request):
    return load_arm(robots / f"{request.param}.urdf")


def motion(arm, seed: int, rate: float = 100.0, seconds: float = 20.0) -> dict[str, np.ndarray]:
    """Return the columns of a log in SI units: a smooth motion with encoder noise."""
    random = np.random.default_rng(seed)
    t = np.arange(round(seconds * rate)) / rate
    columns = {"t": t}
    for joint in arm.chain.joint_names:
        w, phase = random.uniform(0.5, 1.5), random.uniform(0, 6)
        size, middle = random.uniform(0.3, 0.8), random.uniform(-0.2, 0.2)
        columns[f"q_{joint}"] = middle + size * np.sin(w * t + phase) + 1e-5 * random.standard_normal(len(t))
        columns[f"qd_{joint}"] = size * w * np.cos(w * t + phase)
        columns[f"tau_{joint}"] = 8 * np.sin(w * t + phase) + 0.1 * random.standard_normal(len(t))
    return columns


def written(columns, path):
    """Write a log file of these columns in the format of its suffix; return its path."""
    if path.suffix == ".npz":
        np.savez(path, **columns)
    elif path.suffix == ".csv":
        pa.csv.write_csv(pa.table(columns), path)
    else:
        pa.parquet.write_table(pa.table(columns), path)
    return path


def errors(logs, arm) -> str:
    try:
        check(logs, arm.chain.joint_names, arm.chain.joint_types)
    except SpelgenError as error:
        return str(error)
    return ""


def advised(text: str) -> LogMapping:
    """Return the log mapping that an error advises; the error must contain exactly one advised line."""
    (line,) = re.findall(r"write '(.*)' under 'logs'", text)
    return LogMapping.model_validate(yaml.safe_load(line))


@pytest.mark.parametrize("form", FORMATS)
@pytest.mark.parametrize("kind", ["-180..180", "0..360", "differentiated"])
def test_wraps_of_angles_without_limits_are_removed_before_anything_else(robots, tmp_path, form, kind):
    for number, name in enumerate(ROBOTS):
        text = (robots / f"{name}.urdf").read_text().replace('type="revolute"', 'type="continuous"')
        (tmp_path / f"{name}.urdf").write_text(text)
        arm = load_arm(tmp_path / f"{name}.urdf")
        columns = motion(arm, number)
        turning = [
            x
            for x, kind in zip(arm.chain.joint_names, arm.chain.joint_types, strict=True)
            if kind == "revolute"
        ]
        joint = turning[number % len(turning)]
        columns[f"q_{joint}"] = 0.2 + 0.9 * columns["t"] + 0.5 * np.sin(columns["t"])
        columns[f"qd_{joint}"] = 0.9 + 0.5 * np.cos(columns["t"])
        wrapped = columns | {f"q_{joint}": columns[f"q_{joint}"] % (2 * np.pi)}
        if kind == "-180..180":
            wrapped[f"q_{joint}"] = (columns[f"q_{joint}"] + np.pi) % (2 * np.pi) - np.pi
        mapping = LogMapping(velocity="differentiated" if kind == "differentiated" else "logged")
        (sound,) = read_logs(written(columns, tmp_path / f"sound{number}.{form}"), arm, mapping.model_dump())
        (log,) = read_logs(written(wrapped, tmp_path / f"wrapped{number}.{form}"), arm, mapping.model_dump())
        turns = (log.q - sound.q) / (2 * np.pi)
        assert turns == pytest.approx(np.broadcast_to(turns[0].round(), turns.shape), abs=1e-9)
        assert log.qd == pytest.approx(sound.qd, abs=1e-6)
        assert any(joint in remark and "wraps" in remark for remark in log.remarks)
        for read in (log, sound):
            assert errors([read], arm) == ""


def test_wraps_in_degrees_are_no_jumps_once_the_unit_is_stated(robots, tmp_path):
    """Positions in degrees that wrap around at 360 give one error, which names the unit and advises a settings line.

    With this line, the log has no errors. The joints with wrapped positions have no limits; the others have limits.
    """
    text = (robots / "six_dof.urdf").read_text()
    joints = load_arm(robots / "six_dof.urdf").chain.joint_names
    for joint in joints[::2]:
        text = re.sub(rf'(<joint name="{joint}" type=)"revolute"', r'\1"continuous"', text)
    (tmp_path / "arm.urdf").write_text(text)
    arm = load_arm(tmp_path / "arm.urdf")
    columns = motion(arm, 0)
    for joint in joints:
        columns[f"qd_{joint}"] = np.degrees(columns[f"qd_{joint}"])
        columns[f"q_{joint}"] = np.degrees(columns[f"q_{joint}"])
        if joint in joints[::2]:
            columns[f"q_{joint}"] %= 360
    file = written(columns, tmp_path / "log.csv")
    (error,) = check_logs(read_logs([file], arm), arm).errors
    assert "degrees" in str(error) and "check the encoder" not in str(error)
    mapping = advised(str(error))
    assert not errors(read_logs([file], arm, mapping=mapping), arm)


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("form", ["sign bit", "overflow", "unsigned", "turn", "degrees"])
def test_words_of_a_register_are_named_and_the_line_to_write_decodes_them(arm, tmp_path, form, seed):
    random = np.random.default_rng(seed)
    columns, joints = motion(arm, seed), arm.chain.joint_names
    joint = joints[random.integers(len(joints))]
    turning = arm.chain.joint_types[joints.index(joint)] == "revolute"
    counts, per_turn = 2 ** int(random.integers(12, 17)), int(random.choice([4096, 16384]))
    if form == "turn" and not turning:
        pytest.skip("a joint that slides has no turns")
    unit, scale = (
        ("deg", 180 / np.pi) if form in ("degrees", "turn") and turning else ("counts", per_turn / 6.2832)
    )
    size = {"degrees": counts * 360 / per_turn, "turn": 360.0}.get(form, counts)
    if unit == "counts" or form == "degrees":
        grid = 360 / per_turn if unit == "deg" else 1
        values = np.round(columns[f"q_{joint}"] * scale / grid) * grid
        size = size if unit == "deg" else counts
    else:
        values = columns[f"q_{joint}"] * scale
    words = {
        "sign bit": np.where(values < 0, size - values, values),
        "degrees": np.where(values < 0, size - values, values),
        "overflow": (values + 0.3 * size) % size - 0.3 * size if form == "overflow" else values,
        "unsigned": values % size,
        "turn": values % size,
    }[form]
    # A register with `size` values wraps around at -size/2 and size/2. Here its zero is such that it wraps at the mean
    # position of the motion.
    if form == "overflow":
        words = (values - values.mean() + size) % size - size / 2
        values = values - values.mean() + size / 2
    base = {"joints": {joint: {"counts_per_turn" if turning else "counts_per_metre": per_turn}}}
    if unit == "counts":
        base["joints"][joint]["units"] = {"q": "counts"}
    else:
        base["joints"][joint]["units"] = {"q": "deg"}
    file = written(columns | {f"q_{joint}": words.astype(float)}, tmp_path / "log.csv")
    (log,) = read_logs(file, joints, base)
    told = errors([log], arm)
    count = int(np.count_nonzero(np.abs(np.diff(words)) > size / 2))
    assert f"joint {joint!r}: got q that jumps by " in told and f", {count} time" in told
    line = advised(told).joints[joint].model_dump(exclude_unset=True)
    fixed = base | {"joints": {joint: base["joints"][joint] | line}}
    (decoded,) = read_logs(file, joints, fixed)
    factor = LogMapping.model_validate(base).scale("q", joint)
    expected = values * factor
    difference = decoded.q[:, joints.index(joint)] - expected
    assert np.ptp(difference) < 1e-6
    if form != "overflow":  # after an overflow, the number of whole revolutions at the start is unknown
        assert difference[0] == pytest.approx(0, abs=1e-6)
    assert "jumps" not in errors([decoded], arm)


def test_the_first_jump_of_a_joint_that_rests_at_zero_is_counted(arm, tmp_path):
    columns, joints = motion(arm, 0), arm.chain.joint_names
    counts = np.round(4096 / 6.2832 * 0.8 * np.sin(np.maximum(columns["t"] - 0.05, 0.0)))
    words = np.where(counts > 0, 32768 + counts, -counts)
    file = written(columns | {f"q_{joints[0]}": words}, tmp_path / "log.csv")
    mapping = {"joints": {joints[0]: {"counts_per_turn": 4096, "units": {"q": "counts"}}}}
    (log,) = read_logs(file, joints, mapping)
    count = int(np.count_nonzero(np.abs(np.diff(words)) > 16384))
    assert not words[:5].any() and f"jumps by 32768 (counts), {count} times" in errors([log], arm)


def test_sign_bits_and_outliers_of_half_a_turn_of_angles_without_limits(robots, tmp_path):
    """At joints without position limits, sign-and-magnitude words of an encoder are not mistaken for wrapped angles.

    An outlier of half a turn does not shift the samples after it.
    """
    text = (robots / "two_link.urdf").read_text().replace('type="revolute"', 'type="continuous"')
    (tmp_path / "x.urdf").write_text(text)
    arm = load_arm(tmp_path / "x.urdf")
    columns = motion(arm, 3)
    counts = np.round(columns["q_joint1"] * 4096 / (2 * np.pi))
    words = columns | {"q_joint1": np.where(counts < 0, 32768 - counts, counts)}
    base = {"units": {"q": "counts"}, "counts_per_turn": 4096}
    stated = {"velocity": "differentiated", "joints": {"joint1": base}}
    told = errors(read_logs(written(words, tmp_path / "words.csv"), arm, stated), arm)
    assert "write 'joints: {joint1: {sign_bit: {q: 32768}}}'" in told
    stated["joints"]["joint1"] |= {"sign_bit": {"q": 32768}}
    (decoded,) = read_logs(tmp_path / "words.csv", arm, stated)
    assert decoded.q[:, 0] == pytest.approx(counts * 2 * np.pi / 4096, abs=1e-9)
    columns["q_joint2"][700] += np.pi
    (kept,) = read_logs(written(columns, tmp_path / "half.csv"), arm, {"dropouts": "dropped"})
    assert kept.q[:, 1] == pytest.approx(np.delete(columns["q_joint2"], 700), abs=1e-9)


def test_small_outliers_of_the_motion_of_a_joint_at_rest_are_no_fault(robots, tmp_path):
    arm = load_arm(robots / "two_link.urdf")
    columns = motion(arm, 3)
    noise = np.random.default_rng(1).normal(size=(2, len(columns["t"])))
    noise[:, [500, 900]] = 100.0
    columns["q_joint2"], columns["qd_joint2"] = 0.4 + 3e-8 * noise[0], 1e-5 * noise[1]
    assert errors(read_logs(written(columns, tmp_path / "log.csv"), arm), arm) == ""
    columns["qd_joint2"][700] = 3.0
    assert "qd that deviates" in errors(read_logs(written(columns, tmp_path / "spike.csv"), arm), arm)


@pytest.mark.parametrize("limit", [12.5, 4.0, 95.5])
def test_registers_of_joints_without_limits_overflow_at_another_period_than_a_turn(robots, tmp_path, limit):
    """A word of 16 bits represents -limit .. limit. Twice the limit may be close to whole turns, such as 25 rad."""
    text = (robots / "two_link.urdf").read_text().replace('type="revolute"', 'type="continuous"')
    (tmp_path / "x.urdf").write_text(text)
    arm = load_arm(tmp_path / "x.urdf")
    columns = motion(arm, 3)
    t, step = columns["t"], 2 * limit / 65535
    q = 4.5 * limit * np.sin(0.8 * t)
    columns["qd_joint1"] = 3.6 * limit * np.cos(0.8 * t)
    columns["q_joint1"] = np.floor((q + limit) / step) % 65536 * step - limit
    (log,) = read_logs(written(columns, tmp_path / "log.csv"), arm)
    assert np.ptp(log.q[:, 0] - q) < 3 * step
    assert any("wraps at" in remark for remark in log.remarks)


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("form", ["sign bit", "unsigned"])
def test_words_of_a_load_register_are_named_too(arm, tmp_path, form, seed):
    columns, joints = motion(arm, seed), arm.chain.joint_names
    joint = joints[seed % len(joints)]
    load, size = np.round(columns[f"tau_{joint}"] * 100 / 3), {"sign bit": 1024, "unsigned": 65536}[form]
    words = np.where(load < 0, size - load, load) if form == "sign bit" else load % size
    file = written(columns | {f"tau_{joint}": words}, tmp_path / "log.csv")
    base = {"gain": 0.03}
    (log,) = read_logs(file, joints, {"joints": {joint: base}})
    told = errors([log], arm)
    assert f"joint {joint!r}: got tau that jumps by {size} " in told
    line = advised(told).joints[joint].model_dump(exclude_unset=True)
    (decoded,) = read_logs(file, joints, {"joints": {joint: base | line}})
    assert decoded.tau[:, joints.index(joint)] == pytest.approx(0.03 * load, abs=1e-9)
    assert errors([decoded], arm) == ""


def test_the_line_of_a_period_keeps_the_stated_periods_of_other_signals(arm, tmp_path):
    columns, joint = motion(arm, 0), arm.chain.joint_names[0]
    load, counts = (
        np.round(columns[f"tau_{joint}"] * 100 / 3),
        np.round(columns[f"q_{joint}"] * 4096 / (2 * np.pi)),
    )
    words = columns | {f"tau_{joint}": load % 65536, f"q_{joint}": counts % 65536}
    base = {"gain": 0.03, "counts_per_turn": 4096, "units": {"q": "counts"}, "period": {"tau": 65536}}
    (log,) = read_logs(written(words, tmp_path / "log.csv"), arm.chain.joint_names, {"joints": {joint: base}})
    line = advised(errors([log], arm)).joints[joint].model_dump(exclude_unset=True)
    assert line["period"] == {"tau": 65536.0, "q": 65536.0}


@pytest.mark.parametrize("form", FORMATS)
@pytest.mark.parametrize("quantity", ["q", "qd", "tau"])
def test_outliers_of_any_size_are_named_and_dropped_on_request(arm, tmp_path, form, quantity):
    random = np.random.default_rng(len(form) + len(quantity))
    joints = arm.chain.joint_names
    for size in (0.3, 2 * np.pi, 1e5) if quantity == "q" else (1e2, 1e5):
        columns = motion(arm, int(random.integers(1000)))
        joint = joints[random.integers(len(joints))]
        rows = np.sort(random.choice(np.arange(25, 1970, 20), 4, replace=False))
        # some recordings have outliers at the first or the last sample, too
        rows[[0, -1]] = random.choice([[0, 1999], [1, 1970], [25, 1998]])
        name = f"{quantity}_{joint}"
        wrong = columns | {name: columns[name].copy()}
        wrong[name][rows] += size * random.choice([-1, 1], 4)
        file = written(wrong, tmp_path / f"log.{form}")
        (log,) = read_logs(file, joints)
        told = errors([log], arm)
        times = ", ".join(f"{x:.4g}" for x in columns["t"][rows])
        assert f"joint {joint!r}: got {quantity} that deviates from its neighbours by " in told
        assert f"in 4 samples, at t = {times} s" in told
        (kept,) = read_logs(file, joints, {"dropouts": "dropped"})
        assert np.setdiff1d(columns["t"], kept.t) == pytest.approx(columns["t"][rows])
        assert kept.repairs == (f"4 rows left out as dropouts: {quantity} of {joint!r} at t = {times} s",)
        assert errors([kept], arm) == ""


@pytest.mark.parametrize("often", [2, 5, 25])
def test_rows_that_are_written_several_times_are_read_once_with_their_own_rate(arm, tmp_path, often):
    columns, joints = motion(arm, often, rate=250.0), arm.chain.joint_names
    held = np.arange(len(columns["t"])) // often * often
    all_held = {name: x if name == "t" else x[held] for name, x in columns.items()}
    (log,) = read_logs(written(all_held, tmp_path / "all.csv"), joints)
    assert log.sample_rate == pytest.approx(250 / often, rel=0.01)
    assert log.repairs[0].startswith(f"every row is written {often} times: ")
    assert log.q == pytest.approx(columns_of(columns, "q", joints)[::often])
    # rows in which only some columns repeat their values cannot be removed
    some = {name: x[held] if name.startswith("tau") else x for name, x in columns.items()}
    (log,) = read_logs(written(some, tmp_path / "some.csv"), joints)
    told = f"tau that changes {250 / often:.3g} times a second in rows at 250 Hz: each value lasts {often} samples"
    if 250 / often < 24:
        assert told in errors([log], arm)
    else:
        notes = check([log], joints, arm.chain.joint_types)
        assert [x.message for x in notes] == [told] * len(joints)


@pytest.mark.parametrize("rate", [100.0, 60.0, 27.0])
def test_the_newest_state_written_at_a_rate_that_is_no_multiple_of_its_own(arm, tmp_path, rate):
    """If a logger writes the newest state at a higher rate than states change, each state is read once.

    The rate of the logger is no multiple of the rate of the states, so that the number of repeats varies.
    """
    columns, joints = motion(arm, 5, rate=250.0), arm.chain.joint_names
    newest = np.floor(np.arange(len(columns["t"])) * rate / 250 + 1e-9)
    first = np.searchsorted(newest, newest)
    log = {name: x if name == "t" else x[first] for name, x in columns.items()}
    (found,) = read_logs(written(log, tmp_path / "log.csv"), joints)
    assert len(found) == pytest.approx(len(np.unique(newest)), rel=0.02)
    # tolerance: where all joints reverse, positions hardly change, so that a repeated state may not be recognised
    assert np.mean((np.diff(found.q, axis=0) != 0).any(axis=1)) > 0.98


def test_frames_that_are_written_twice_now_and_then_are_counted_and_dropped_on_request(arm, tmp_path):
    columns, joints = motion(arm, 5, rate=30.0, seconds=60), arm.chain.joint_names
    random = np.random.default_rng(0)
    rows = np.arange(len(columns["t"]))
    repeats = np.sort(random.choice(np.arange(10, len(rows) - 10, 3), 150, replace=False))
    rows[repeats] -= 1
    log = {name: x if name == "t" else x[rows] for name, x in columns.items()}
    file = written(log, tmp_path / "log.csv")
    (kept,) = read_logs(file, joints)
    (note,) = kept.repairs
    assert "rows repeat the row before in motion: 'dropouts: dropped' under 'logs' removes them" in note
    # tolerance: where all joints reverse, positions hardly change, and a repeated row cannot be recognised
    count = int(note.split(" rows ")[0])
    assert 0.95 * len(repeats) < count <= len(repeats)
    (dropped,) = read_logs(file, joints, {"dropouts": "dropped"})
    assert len(dropped) == len(rows) - count


@pytest.mark.parametrize("sign", [1, -1])
def test_velocities_that_are_magnitudes_are_an_error_and_differentiating_remedies_it(arm, tmp_path, sign):
    columns, joints = motion(arm, 7), arm.chain.joint_names
    joint = joints[-1]
    random = np.random.default_rng(1)
    columns[f"qd_{joint}"] = sign * np.abs(columns[f"qd_{joint}"] + 0.005 * random.standard_normal(2000))
    file = written(columns, tmp_path / "log.csv")
    (log,) = read_logs(file, joints)
    told = errors([log], arm)
    assert f"joint {joint!r}: got qd that is the magnitude of dq/dt" in told
    assert not any("one way" in note.message for note in check_logs([log], arm).findings)
    (log,) = read_logs(file, joints, advised(told).model_dump())
    assert errors([log], arm) == ""


def test_noise_of_coarse_positions_does_not_make_velocities_magnitudes(arm, tmp_path):
    """A joint that moves one way and stops has negative dq/dt at single samples: positions are coarse."""
    columns, joints = motion(arm, 7), arm.chain.joint_names
    joint, t = joints[-1], np.asarray(columns["t"])
    random, dt = np.random.default_rng(1), t[1] - t[0]
    s = np.clip(t / (0.6 * t[-1]), 0.0, 1.0)
    q = 1900 * dt * 0.02 * (10 * s**3 - 15 * s**4 + 6 * s**5)
    columns[f"qd_{joint}"] = np.gradient(q, t)
    step = 0.01 * dt
    columns[f"q_{joint}"] = step * np.round(q / step + 0.5 * random.standard_normal(len(t)))
    (log,) = read_logs(written(columns, tmp_path / "log.csv"), joints)
    assert "magnitude" not in errors([log], arm)


def test_quick_but_sound_signals_have_no_jumps():
    t = 0.02 * np.arange(3000)
    random = np.random.default_rng(0)
    steps = np.repeat(random.uniform(-1, 1, 60), 50)
    q = np.zeros_like(t)
    for k in range(1, len(t)):  # the simulated servo reaches a step of its command within some samples
        q[k] = q[k - 1] + 0.4 * (steps[k - 1] - q[k - 1])
    counts = 2 * np.pi / 4096
    q = np.round(q / counts) * counts
    log = Trajectory(t, q[:, None], np.gradient(q, t)[:, None], np.zeros((len(t), 0)), u=steps[:, None])
    assert check([log], ["a"], ["revolute"]) == []
    bang = np.where(np.sin(t) > 0, 260.0, 0.0) + np.round(random.uniform(0, 8, len(t)))
    smooth = np.sin(t)[:, None]
    log = Trajectory(t, smooth, np.cos(t)[:, None], bang[:, None])
    codes = [x.code for x in check([log], ["a"], ["revolute"])]
    assert codes == []
    with pytest.raises(LogError, match=r"q that jumps by 3.003 between two samples, 1 time, at t = 30 s"):
        check(
            [Trajectory(t, smooth + 3 * (t > 30)[:, None], np.cos(t)[:, None], bang[:, None])],
            ["a"],
            ["revolute"],
        )


def test_velocities_of_single_encoder_steps_are_no_outliers():
    # Slow motion of a coarse encoder, differentiated at 1 kHz: the velocity is 0 or one encoder step per sample, apart
    # from rounding errors.
    t = 0.001 * np.arange(1500)
    random = np.random.default_rng(0)
    step = 2 * np.pi / 8192
    q = step * np.round((0.02 * t + 0.05 * np.sin(2 * t)) / step)
    qd = np.diff(q, append=q[-1]) / 0.001
    qd[random.choice(len(t), 20, replace=False)] += 1.4e-14
    log = Trajectory(t, q[:, None], qd[:, None], random.normal(size=(len(t), 1)))
    assert not is_outlier(qd, smooth=False).any()
    assert check([log], ["a"], ["revolute"]) == []
    qd[700] = 1e6
    assert np.flatnonzero(is_outlier(qd, smooth=False)).tolist() == [700]


def columns_of(columns, quantity, joints):
    return np.stack([columns[f"{quantity}_{joint}"] for joint in joints], axis=1)


@pytest.mark.parametrize("form", FORMATS)
def test_wrapped_commands_of_servos_are_unwrapped_with_their_positions(robots, tmp_path, form):
    """Wrapped servo commands and positions are unwrapped together.

    Commands and positions wrap at different rows, and their first values may differ by a revolution.
    """
    for number, name in enumerate(ROBOTS):
        text = (robots / f"{name}.urdf").read_text().replace('type="revolute"', 'type="continuous"')
        (tmp_path / f"{name}.urdf").write_text(text)
        (tmp_path / f"{name}.yaml").write_text("input: position\n")
        arm = load_arm(tmp_path / f"{name}.urdf")
        t = 0.02 * np.arange(1500)
        columns = {"t": t}
        for k, joint in enumerate(arm.chain.joint_names):
            u = 3.0 + 0.8 * (k + number) * t + 0.4 * np.sin(t + k)
            columns |= {f"u_{joint}": u, f"q_{joint}": u - 0.1 * np.cos(t)}
        wrapped = dict(columns)
        for joint, kind in zip(arm.chain.joint_names, arm.chain.joint_types, strict=True):
            if kind == "revolute":
                for quantity in ("q", "u"):
                    angle = columns[f"{quantity}_{joint}"]
                    wrapped[f"{quantity}_{joint}"] = (angle + np.pi) % (2 * np.pi) - np.pi
        (log,) = read_logs(written(wrapped, tmp_path / f"log{number}.{form}"), arm)
        followed = columns_of(columns, "u", arm.chain.joint_names) - columns_of(
            columns, "q", arm.chain.joint_names
        )
        assert log.u is not None
        assert log.u - log.q == pytest.approx(followed, abs=1e-9)
        assert np.abs(np.diff(log.q, axis=0)).max() < 0.2


@pytest.mark.parametrize("form", ["degrees", "two's complement", "sign and magnitude"])
def test_registers_of_all_joints_and_of_commands_have_one_line(tmp_path, form):
    """Positions q and commands u that are logged as raw register values are one error with one line for all joints.

    form: encoding of negative values in the registers. The elbow stays near 0, so that only changes of sign show it.
    """
    arm = load_arm(write_servo_arm(tmp_path))
    t, rng = 0.02 * np.arange(1500), np.random.default_rng(0)
    motion = {"shoulder": 0.9 * np.sin(t), "elbow": -0.004 * (t > 15) + 0.003 * rng.standard_normal(len(t))}
    counts = {joint: np.round(4096 / (2 * np.pi) * q) for joint, q in motion.items()}
    words = {
        "degrees": lambda x: 360 / 4096 * x % 360,
        "two's complement": lambda x: x % 65536,
        "sign and magnitude": lambda x: np.where(x < 0, 32768 - x, x),
    }[form]
    columns = {"t": t}
    for joint, x in counts.items():
        late = np.concatenate([x[:1].repeat(4), x[:-4]])
        columns |= {f"q_{joint}": words(late), f"u_{joint}": words(x)}
    base = {"units": {"q": "deg" if form == "degrees" else "counts"}}
    if form != "degrees":
        base["joints"] = {joint: {"counts_per_turn": 4096} for joint in motion}
    file = written(columns, tmp_path / "log.csv")
    told = errors(read_logs(file, arm, base), arm)
    assert told.count("write '") == 1 and "joint 'shoulder', 'elbow': got q that jumps" in told
    lines = advised(told).model_dump(exclude_unset=True)["joints"]
    joints = {joint: base.get("joints", {}).get(joint, {}) | line for joint, line in lines.items()}
    (log,) = read_logs(file, arm, base | {"joints": joints})
    assert errors([log], arm) == ""
    for k, joint in enumerate(motion):
        assert log.u[:, k] == pytest.approx(2 * np.pi / 4096 * counts[joint], abs=1e-9)


def test_a_joint_whose_limits_are_more_than_two_turns_apart_may_turn_so_far(robots, tmp_path):
    """Wrists of some arms turn by 450 degrees to both sides: positions of 2.4 turns have no wrong unit.

    The logged velocities are estimates, and 17 % too small.
    """
    text = (robots / "six_dof.urdf").read_text()
    last = re.compile(r'(<joint name="joint6".*?lower=")[^"]*(" upper=")[^"]*"', re.DOTALL)
    (tmp_path / "arm.urdf").write_text(last.sub(r'\g<1>-7.86\g<2>7.86"', text))
    arm = load_arm(tmp_path / "arm.urdf")
    columns = motion(arm, 0)
    columns |= {"q_joint6": 7.7 * np.sin(columns["t"]), "qd_joint6": 0.83 * 7.7 * np.cos(columns["t"])}
    (log,) = read_logs(written(columns, tmp_path / "log.csv"), arm)
    assert errors([log], arm) == ""
    assert log.q[:, -1] == pytest.approx(columns["q_joint6"], abs=1e-9)
