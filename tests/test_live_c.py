"""The C estimator equals the Python estimator along logs, is fast enough, and gives finite results for any sample."""

import shutil
from pathlib import Path

import numpy as np
import pytest
import torch
from compiled_estimator import Columns, CompiledEstimator, differences, nominal_levels
from exported_runs import COUPLED, MOTORS, moved_model, saved_run
from motions import smooth_motion

from spelgen.arm.configured_arm import Arm, load_arm
from spelgen.dynamics.bristles import bristle_reach, bristles_along
from spelgen.emission.build import build
from spelgen.exporting.export import export
from spelgen.fitting.fitted import load_run
from spelgen.live.estimator import Estimator, EstimatorState
from spelgen.logs.read import read_logs
from spelgen.logs.trajectory import Trajectory

pytestmark = pytest.mark.skipif(shutil.which("gcc") is None, reason="no gcc on this machine")
PACKAGE = Path(__file__).parents[1] / "spelgen"
SHARED = Path(__file__).parents[1] / ".." / "shared"
RECORDED = ("ur10e", "panda", "shanghai", "xmate3", "ar5", "airbot", "tx40")
"""Arms with measured torques: logs of position commands have no estimator."""
SAMPLES = 2000
PLAIN = "-O0"
"""Compiled in a quarter of the time; users compile with -O2, as some of the tests do."""


def randomised(urdf, preset="hybrid"):
    """Return a model with small random numbers added to all parameters, so that no term is zero."""
    model = build(urdf, preset).double()
    random = torch.Generator().manual_seed(0)
    with torch.no_grad():
        for parameter in model.parameters():
            parameter += 0.05 * torch.randn(parameter.shape, dtype=torch.float64, generator=random)
    return model.requires_grad_(False)


def levels_of(model, log, noise_ratio=2e-3, delay=0.0):
    effort = 2.0 * np.abs(log.tau).max(axis=0) + 1e-3
    levels = nominal_levels(effort, np.abs(log.qd).max(axis=0) + 1e-3, model.coulomb.numpy(), noise_ratio)
    return levels.model_copy(update={"encoder": np.full(model.n, 1e-5), "delay": delay})


def require_equal(found: Columns, states: list[EstimatorState], tolerance: float) -> None:
    for name, difference in differences(found, states).items():
        assert difference <= tolerance, name


def segments(files: list[Path], arm: Arm) -> Trajectory:
    """Return one log of segments of several recordings, about SAMPLES samples in total, with gaps of a second."""
    columns: list[list[np.ndarray]] = []
    end, count = 0.0, SAMPLES // len(files)
    for (log,) in (read_logs([file], arm) for file in files):
        start = max(len(log) - count, 0) // 2
        part = log[start : start + count]
        columns.append([part.t - part.t[0] + end, part.q, part.qd, part.tau])
        end = columns[-1][0][-1] + 1.0
    return Trajectory(*map(np.concatenate, zip(*columns, strict=True)))


@pytest.mark.parametrize("name", RECORDED)
def test_c_equals_python_along_recordings(name, tmp_path):
    """C and Python estimators give equal outputs along recordings, in conditions that use each part of the estimator.

    The model is not fitted to the recordings, so the noise levels are as large as its torque residuals. The noise
    levels state that torques are delayed.
    """
    urdf = SHARED / ("arms/panda_erd.urdf" if name == "panda" else f"logs/{name}/{name}.urdf")
    files = sorted((SHARED / "logs" / name).glob("*.parquet"))
    if not files:
        pytest.skip(f"no logs of {name}: the folder of recordings is not here")
    model, arm = randomised(urdf), load_arm(urdf)
    log = segments(files, arm)
    levels = levels_of(model, log, 0.02, delay=0.015)
    estimator = Estimator(load_run(saved_run(model, urdf, tmp_path).path), levels=levels)
    compiled = CompiledEstimator(model, arm, levels, *([PLAIN] if name != "ur10e" else []))
    found = compiled.run(log.t, log.q, log.qd, log.tau)
    # Rounding differs between processors: on one of them, the difference is 1.2e-11 for the AR5.
    require_equal(found, estimator.replay(log), 1e-10)
    at = log.q[-1], log.qd[-1], 0.5 * log.qd[-1]
    for ahead, external in ((0.0, False), (0.1, False), (0.1, True), (1.0, True)):
        estimator.compensate_external = external
        compiled.compensate_external(external)
        expected = estimator.torque(*at, ahead)
        np.testing.assert_allclose(compiled.torque(*at, ahead), expected, atol=1e-9 * np.abs(expected).max())


def test_c_equals_python_with_couplings_and_hostile_samples(tmp_path):
    """C and Python estimators give equal outputs with mimic and prismatic joints, coupled motors and a passive joint.

    Some samples are unusable, the noise levels state that torques precede the motion by 25 ms, and the torque limits of
    some joints are unknown.
    """
    (tmp_path / "arm.urdf").write_text(COUPLED)
    (tmp_path / "arm.yaml").write_text(MOTORS)
    model = randomised(tmp_path / "arm.urdf", "closed-form")
    log = hostile(motion_of(model, 20.0))
    levels = levels_of(model, motion_of(model, 20.0), 0.02, delay=-0.025)
    levels = levels.model_copy(update={"saturation": np.linspace(1.0, 10.0, model.n)})
    compiled = CompiledEstimator(model, load_arm(tmp_path / "arm.urdf"), levels)
    found = compiled.run(*log)
    fit = load_run(saved_run(model, tmp_path / "arm.urdf", tmp_path / "run").path)
    estimator = Estimator(fit, levels=levels)
    require_equal(found, list(estimator.steps(*log)), 1e-10)
    assert compiled.refused() == estimator.intake.counts
    assert min(estimator.intake.counts.values()) > 0


def test_c_equals_python_for_friction_without_a_state(tmp_path):
    preset = (PACKAGE / "presets" / "closed-form.yaml").read_text()
    (tmp_path / "plain.yaml").write_text(preset.replace("memory: bristles", "memory: none"))
    urdf = Path(__file__).parents[1] / "robots" / "six_dof.urdf"
    model = randomised(urdf, tmp_path / "plain.yaml")
    log = motion_of(model, 8.0)
    levels = levels_of(model, log, 0.02)
    found = CompiledEstimator(model, load_arm(urdf), levels, PLAIN).run(log.t, log.q, log.qd, log.tau)
    estimator = Estimator(load_run(saved_run(model, urdf, tmp_path / "run").path), levels=levels)
    require_equal(found, estimator.replay(log), 1e-11)


@pytest.mark.skipif(shutil.which("clang") is None, reason="no clang on this machine")
@pytest.mark.parametrize("memory", ["bristles", "none"])
def test_clang_compiles_the_estimator_without_warnings(memory, tmp_path):
    """The export makes warnings errors; on machines whose only compiler is clang, one warning prevents the export."""
    preset = (PACKAGE / "presets" / "closed-form.yaml").read_text()
    (tmp_path / "preset.yaml").write_text(preset.replace("memory: bristles", f"memory: {memory}"))
    model = randomised(
        urdf := Path(__file__).parents[1] / "robots" / "six_dof.urdf", tmp_path / "preset.yaml"
    )
    levels = levels_of(model, motion_of(model, 2.0))
    assert CompiledEstimator(model, load_arm(urdf), levels, PLAIN, program="clang").refused()


def motion_of(model, seconds: float) -> Trajectory:
    """Return a log of a smooth motion with the torques of the model."""
    q, qd, qdd = smooth_motion(model.n, seconds, np.random.default_rng(3))
    state = [bristles_along(q, bristle_reach(model))] if model.elements else []
    with torch.no_grad():
        tau = model.inverse_dynamics(*map(torch.from_numpy, (q, qd, qdd, *state))).numpy()
    return Trajectory(
        0.01 * np.arange(len(q)), q, qd, tau + 0.01 * np.random.default_rng(0).standard_normal(q.shape)
    )


def hostile(log: Trajectory, count: int | None = None) -> tuple[np.ndarray, ...]:
    """Return times and samples of a log, repeated up to `count` samples, of which one in five is unusable."""
    random = np.random.default_rng(5)
    rows = np.arange(count or len(log)) % len(log)
    laps = np.arange(len(rows)) // len(log)
    t = log.t[rows] + laps * (log.duration + 0.01)
    q, qd, tau = (x[rows].copy() for x in (log.q, log.qd, log.tau))
    kinds = random.integers(0, 40, len(t))
    kinds[:100] = 99
    q[kinds == 0, 0] = np.nan
    qd[kinds == 1, -1] = -np.inf
    tau[kinds == 2] = np.nan
    q[kinds == 3] += 1e3 * random.standard_normal((int((kinds == 3).sum()), q.shape[1]))
    qd[kinds == 4] = 1e6
    t[kinds == 5] -= 0.5
    t[1:][kinds[1:] == 6] = t[:-1][kinds[1:] == 6]
    tau[kinds == 7] = 1e9
    t[len(t) // 2 :] += 3.0  # a gap of 3 s in the times
    t[2 * len(t) // 3 :] -= 5.0  # the clock is set back by 5 s
    return t, q, qd, tau


def test_a_million_hostile_samples_give_finite_estimates():
    model = moved_model("six_dof", "closed-form", 0.1).double()
    log = motion_of(model, 30.0)
    levels = levels_of(model, log)
    from exported_runs import arm_of

    compiled = CompiledEstimator(model, arm_of("six_dof"), levels)
    t, q, qd, tau = hostile(log, 10**6)
    total = 0
    for start in range(0, len(t), 10**5):
        rows = slice(start, start + 10**5)
        found = compiled.run(t[rows], q[rows], qd[rows], tau[rows])
        for name, values in vars(found).items():
            # the upper limit of the mass is infinite before the first report
            assert np.isfinite(values[found.limit < np.inf] if name == "limit" else values).all(), name
        total += len(found.mass)
    counts = compiled.refused()
    assert sum(counts.values()) == total == 10**6
    assert counts["not finite"] > 5e4
    assert min(counts[reason] for reason in ("repeated", "reversed", "jump", "saturated")) > 1e4


def test_float_is_close_to_double():
    model = moved_model("six_dof", "closed-form", 0.1).double()
    log = motion_of(model, 10.0)
    levels = levels_of(model, log)
    from exported_runs import arm_of

    double, single = (
        CompiledEstimator(model, arm_of("six_dof"), levels, *flags).run(log.t, log.q, log.qd, log.tau)
        for flags in ((PLAIN,), (PLAIN, "-DSIX_DOF_FLOAT"))
    )
    scale = np.abs(double.threshold).mean(axis=0)
    assert (np.abs(double.external_torque - single.external_torque).max(axis=0) < 0.1 * scale).all()
    np.testing.assert_array_equal(double.status, single.status)


def test_a_state_saved_during_a_contact_is_restored_and_a_damaged_one_is_not():
    model = moved_model("six_dof", "closed-form", 0.1).double()
    log = motion_of(model, 10.0)
    from exported_runs import arm_of

    compiled = CompiledEstimator(model, arm_of("six_dof"), levels_of(model, log), PLAIN)
    push = 0.5 * np.abs(log.tau).max(axis=0) * (np.arange(model.n) == 1)
    tau = log.tau - push * (log.t > log.t[-1] - 0.5)[:, None]
    before = compiled.run(log.t, log.q, log.qd, tau)
    assert (np.abs(before.external_torque) > before.threshold)[-40:, 1].all()
    state = compiled.saved()
    compiled.start()
    assert compiled.restore(state)
    # after `restore`, times may start at zero again, and all estimates are kept; the contact lasts for another second
    tau = log.tau - push * (log.t < log.t[0] + 1.0)[:, None]
    after = compiled.run(log.t[:300], log.q[:300], log.qd[:300], tau[:300])
    assert (after.refusal == 0).all()
    touched = np.abs(after.external_torque) > after.threshold
    assert touched[50:100, 1].all() and not touched[:, [0, 2, 3, 4, 5]].any() and not touched[120:].any()
    np.testing.assert_array_equal(after.status[0], before.status[-1])
    np.testing.assert_array_equal(after.friction_scale[0], before.friction_scale[-1])
    for position in (0, 9, 200, len(state) - 1):
        damaged = bytearray(state.raw)
        damaged[position] ^= 1
        state.raw = bytes(damaged)
        assert not compiled.restore(state)
        damaged[position] ^= 1
        state.raw = bytes(damaged)
    assert compiled.restore(state)


def test_a_run_with_noise_levels_exports_the_estimator(tmp_path):
    model = moved_model("six_dof", "closed-form", 0.1).double()
    folder = saved_run(model, Path(__file__).parents[1] / "robots" / "six_dof.urdf", tmp_path)
    plain = export(folder.path, "c")
    assert not any("estimator" in name for name in plain.files)
    folder.estimator.write_text(levels_of(model, motion_of(model, 5.0)).model_dump_json())
    files = export(folder.path, "c").files
    assert {"six_dof.h", "six_dof.c", "six_dof_estimator.h", "six_dof_estimator.c"} <= set(files)
    assert files == export(folder.path, "c").files


def test_step_and_report_take_microseconds(tmp_path):
    """For seven joints, a step of the C estimator takes less than 50 us (99 % of steps), and a report 10 ms (median).

    On an idle machine they take a tenth of these times; the bounds are for loaded machines.
    """
    urdf = Path(__file__).parents[1] / "robots" / "panda.urdf"
    model = randomised(urdf, "closed-form")
    log = motion_of(model, 20.0)
    t = np.arange(0, log.duration, 0.001)
    q, qd, tau = (np.stack([np.interp(t, log.t, x) for x in y.T], axis=1) for y in (log.q, log.qd, log.tau))
    found = CompiledEstimator(model, load_arm(urdf), levels_of(model, log)).run(t, q, qd, tau)
    assert np.quantile(found.step_seconds, 0.99) < 50e-6
    assert np.median(found.report_seconds[found.report_seconds > 0]) < 10e-3
