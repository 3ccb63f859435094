"""Forecasts: what the past tells of forces that a model lacks, and how far training windows show it to be trusted."""

import warnings
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from spelgen.building import build
from spelgen.dynamics.bristles import BristleReach, bristles_along
from spelgen.emission.loading import load_module
from spelgen.errors import RunError
from spelgen.evaluation.baselines import Predictor, of_dynamics
from spelgen.evaluation.disturbance import after_past, without_compensation, without_past
from spelgen.evaluation.evaluate import evaluate
from spelgen.evaluation.extrapolation import extrapolation
from spelgen.evaluation.forecast import forecast_of, past_steps, rolled, training_motion
from spelgen.evaluation.names import CONSTANT_VELOCITY, EXTRAPOLATION, MODEL
from spelgen.evaluation.rollout import rollout
from spelgen.evaluation.tables import result_tables
from spelgen.evaluation.trust import calibrated
from spelgen.fitting.calibration import calibration_windows, held_sources
from spelgen.fitting.fit import fit
from spelgen.fitting.fitted import load_run
from spelgen.logs.preprocessing import Preprocessing
from spelgen.logs.trajectory import Trajectory
from spelgen.logs.windows import cut_windows
from spelgen.settings.fits import Rollout

STAND_IN = Path(__file__).with_name("stand_in.py")
RATE = 100.0
OFFSET = torch.tensor([0.6, -0.4], dtype=torch.float64)  # Nm that logs do not tell of
HELD = Preprocessing(cutoff=0, decimation=1)
REACH = BristleReach(np.full((2, 1), 0.01))


def motions(count=4, seconds=3.0, seed=0, offset=0.0) -> list[Trajectory]:
    """Of the stand-in under smooth torques, and an offset that is not logged."""
    model = load_module(STAND_IN)
    generator = torch.Generator().manual_seed(seed)
    t = torch.arange(round(seconds * RATE) + 1) / RATE
    phases, speeds = (torch.rand(count, 1, 2, generator=generator, dtype=torch.float64) for _ in "ab")
    tau = 2 * torch.sin(6.28 * (phases + (0.5 + speeds) * t[:, None]))  # (count, T, 2)
    start = 2 * phases[:, 0] - 1
    with torch.no_grad():
        q, qd = rollout(model, start, torch.zeros_like(start), tau[:, :-1] + offset, 1 / RATE, substeps=2)
    return [Trajectory(t, q[k], qd[k], tau[k], f"motion_{seed}{k}") for k in range(count)]


def fitted(logs):
    """The stand-in, as it is, with a record of these logs."""
    config = Rollout(epochs=1, optimizer="adamw", batch=64, learning_rate=1e-12, momentum_steps=0)
    return fit(load_module(STAND_IN), logs, config, preprocessing=HELD, progress=False)


@pytest.fixture(scope="module")
def offset_logs():
    return motions(offset=OFFSET)


@pytest.fixture(scope="module")
def offset_fit(offset_logs):
    return fitted(offset_logs)


def test_a_constant_torque_that_nothing_tells_of_is_found_in_the_past_and_held(offset_logs):
    model, past = load_module(STAND_IN), past_steps(RATE)
    windows = cut_windows(offset_logs, past + 51, 20, measured=False)
    ahead, disturbance = after_past(model, windows, past)
    torch.testing.assert_close(disturbance, OFFSET.expand_as(disturbance), atol=0.01, rtol=0)
    torch.testing.assert_close(ahead.q, windows.q[:, past:])
    found = rolled(of_dynamics(MODEL, model, 2), windows, past)
    open_loop, held = (
        np.sqrt(np.square(x[1] - ahead.qd[:, 1:].numpy())[:, -1].mean())
        for x in (found.open_loop, found.held)
    )
    assert held < 0.05 * open_loop


def test_what_drives_add_by_velocity_is_held_with_the_rest_and_blows_nothing_up(offset_logs, robots):
    """A compensation larger than all friction makes the model's own rollouts leave all bounds, and forecasts not."""
    model, past = build(robots / "two_link.urdf", "closed-form"), past_steps(RATE)
    windows = cut_windows(offset_logs, past + 101, 20, measured=False)
    plain = rolled(of_dynamics(MODEL, model, 2), windows, past)
    speed = windows.qd[:, past // 2]
    model.get_buffer("raw_friction_compensation").fill_(300.0)
    _, before = after_past(without_compensation(model), windows, past)
    _, disturbance = after_past(model, windows, past)
    torch.testing.assert_close(disturbance, before)
    assert (model.friction_compensation * speed).abs().max() > 50
    found = rolled(of_dynamics(MODEL, model, 2), windows, past)
    np.testing.assert_allclose(found.held, plain.held)
    with torch.no_grad(), np.errstate(all="ignore"):
        q, _ = of_dynamics(MODEL, model, 2).states(without_past(windows, past))
    assert not (q.abs() < 1e3).all()


def test_what_has_velocities_as_its_state_lacks_an_acceleration(offset_logs):
    model, past = load_module(STAND_IN), past_steps(RATE)

    class Dynamics:
        """The stand-in without its momenta."""

        n = 2
        mass_matrix, forward_dynamics, inverse_dynamics = (
            model.mass_matrix, model.forward_dynamics, model.inverse_dynamics,
        )  # fmt: skip

    windows = cut_windows(offset_logs, past + 51, 20, measured=False)
    predictor = of_dynamics("other", Dynamics(), 2)
    found = rolled(predictor, windows, past)
    _, disturbance = after_past(predictor.form, windows, past)
    mass = model.mass_matrix(windows.q[:, past // 2])
    missing = torch.linalg.solve(mass, OFFSET.expand_as(disturbance).unsqueeze(-1)).squeeze(-1)
    torch.testing.assert_close(disturbance, missing, atol=0.1, rtol=0.1)
    errors = [
        np.abs(x - found.ahead.qd[:, 1:].numpy())[:, -1].mean() for x in (found.open_loop[1], found.held[1])
    ]
    assert errors[1] < 0.3 * errors[0]


def test_evaluation_tells_forecasts_and_open_loop_of_the_same_windows(offset_fit):
    result = evaluate(offset_fit, motions(seed=1, offset=OFFSET), steps=(), seconds=(0.1, 0.5))
    for horizon in result.horizons:
        assert horizon.errors[MODEL].mean_relative_rms < 0.1 * horizon.open_loop[MODEL].mean_relative_rms
        assert horizon.errors[CONSTANT_VELOCITY] == horizon.open_loop[CONSTANT_VELOCITY]
        extrapolated = horizon.errors[EXTRAPOLATION].mean_relative_rms
        assert horizon.errors[MODEL].mean_relative_rms < 0.1 * extrapolated
        still = horizon.errors[CONSTANT_VELOCITY].mean_relative_rms
        assert extrapolated < (0.5 if horizon.name == "0.1 s" else 1.001) * still
        assert EXTRAPOLATION not in horizon.open_loop
    assert result.forecasts[MODEL].good_for == 1.0
    text = " ".join(result.text().split())
    assert "extrapolated motion, and dynamics as far as training windows trust them" in text
    assert "The same without that: open loop" in text
    assert "predictions up to 1 s ahead" in result._repr_html_()
    alone = evaluate(offset_fit, motions(seed=1, offset=OFFSET), steps=(), seconds=(0.5,), disturbance="none")
    assert alone.forecasts == {} and alone.horizons[0].open_loop == {}
    assert alone.horizons[0].errors[MODEL].mean_relative_rms > 0.2
    assert "open loop" not in alone.text()
    far = evaluate(offset_fit, motions(seed=1, offset=OFFSET), steps=(), seconds=(0.5, 2.0))
    assert far.horizons[1].open_loop == {}
    table = result_tables(far.to_dict())[0]
    assert [row.label for row in table.rows] == ["0.5 s", "2 s, open loop"]
    assert "windows of the training logs are shorter" in table.note
    assert {x.message for x in far.diagnostics if x.code == "open-loop"} == {
        "no forecasts over 2 s, rollouts are open loop: windows of its training logs are shorter"
    }


def test_the_true_model_is_trusted_and_nonsense_is_not(offset_fit):
    calibration, kinds = offset_fit.calibration, ("revolute", "revolute")
    model = load_module(STAND_IN)
    noise = torch.Generator().manual_seed(0)

    def nonsense(windows, disturbance=None):
        shape = windows.q[:, 1:].shape
        q, qd = (torch.randn(shape, generator=noise, dtype=torch.float64) for _ in "ab")
        return windows.q[:, :1] + q, windows.qd[:, :1] + qd

    motion = training_motion(calibration, kinds)
    true = forecast_of(of_dynamics(MODEL, model, 2), motion)
    several = [forecast_of(Predictor("nonsense", nonsense, form=model), motion) for _ in range(5)]
    assert true.trust.trust[:, 2:].min() > 0.9  # from 0.05 s on
    assert true.trust.good_for == 1.0
    nothing = np.stack([none.trust.trust for none in several])
    assert np.mean(nothing != 0) < 0.1  # about what two standard errors let pass
    assert nothing.mean() < 0.01
    assert {none.trust.good_for for none in several} == {None}


def test_trust_is_one_for_what_is_measured_and_nothing_for_what_never_moves():
    generator = np.random.default_rng(0)
    measured = generator.normal(size=(2, 60, 3, 4))
    measured[:, :, :, 3] = 0.0
    blocks = np.arange(60) // 6
    times = np.array([0.1, 0.5, 1.0])
    trust = calibrated(0 * measured, measured, measured, blocks, times)
    np.testing.assert_allclose(trust.trust[..., :3], 1.0)
    np.testing.assert_allclose(trust.gains[0, 1], 0.0, atol=1e-7)
    assert (trust.held[..., :3] > 0).all()
    np.testing.assert_array_equal(trust.trust[..., 3], 0.0)
    other = calibrated(measured, generator.normal(size=measured.shape), measured, blocks, times)
    assert (other.held[..., :3] == 0).all()
    added = trust.added(0 * measured, measured, np.array([0.1, 0.2, 2.0]))
    np.testing.assert_allclose(added[:, :, 0, :3], measured[:, :, 0, :3], atol=1e-8)


def test_windows_that_overlap_count_as_one():
    """The same errors, told by many windows of few stretches of time, prove less than by many stretches."""
    generator = np.random.default_rng(1)
    once = generator.normal(size=(2, 6, 1, 3))
    noise = 0.7 * generator.normal(size=once.shape)
    several, error = (np.repeat(x, 10, axis=1) for x in (once, noise))
    times = np.array([1.0])
    few, many = (
        calibrated(several + error, several + error, several, blocks, times).trust
        for blocks in (np.repeat(np.arange(6), 10), np.arange(60))
    )
    assert few.mean() < 0.9 * many.mean()


def test_a_past_that_lacks_far_more_than_in_training_is_trusted_less():
    generator = np.random.default_rng(3)
    measured, noise, disturbed = generator.normal(size=(3, 2, 60, 1, 2))
    open_loop, times = measured + 0.5 * noise, np.array([0.5])
    trust = calibrated(open_loop, open_loop + 0.1 * disturbed, measured, np.arange(60) // 6, times)
    assert (trust.trust > 0.7).all() and (trust.trust < 0.9).all()
    usual = trust.added(open_loop, open_loop + 0.1 * np.sign(disturbed), times)
    followed = [open_loop + 0.1 * each[None, None] * np.sign(disturbed) for each in trust.held]
    plain = np.stack([(x * each[:, None]).sum(axis=0) for x, each in zip(followed, trust.gains, strict=True)])
    np.testing.assert_allclose(usual, plain)
    added = trust.added(open_loop, open_loop + 10 * np.sign(disturbed), times)
    assert np.abs(added).max() < 0.1 * np.abs(open_loop).max()
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        for wild in (np.nan, np.inf, 1e300):
            assert np.isfinite(
                trust.added(np.full_like(open_loop, wild), np.full_like(open_loop, -wild), times)
            ).all()


def test_what_position_and_velocity_tell_together_is_followed():
    """A missed force errs both alike: neither is worth much by itself, both together are."""
    generator = np.random.default_rng(5)
    measured = generator.normal(size=(2, 60, 1, 3))
    force = 5 * generator.normal(size=(60, 1, 3))
    open_loop, times = measured + np.stack([0.5 * force, force]), np.array([1.0])
    trust = calibrated(open_loop, open_loop, measured, np.arange(60) // 6, times)
    left = measured - trust.added(open_loop, open_loop, times)
    best = [np.sqrt(1 / (1 + c**2)) for c in (0.5, 2.0)]  # what the direction of the force leaves unknown
    for each, bound in zip(np.sqrt(np.square(left).mean(axis=(1, 2, 3))), best[::-1], strict=True):
        assert 0.9 * bound < each < 1.15 * bound


def test_few_stretches_bound_how_far_a_trusted_rollout_is_followed():
    """As many times as far as in training as there are stretches, in the direction in which it goes."""
    measured = np.random.default_rng(4).normal(size=(2, 60, 1, 1))
    far, times = np.full((2, 1, 1, 1), 1e5), np.array([0.5])
    reached = [
        calibrated(measured, measured, measured, np.arange(60) // (60 // count), times).added(far, far, times)
        for count in (3, 15)
    ]
    nearest = np.abs(measured).max(axis=1).min() * np.ones_like(far)
    np.testing.assert_allclose(reached, [3 * nearest, 15 * nearest], rtol=1e-6)


def waves(count=400, seed=0):
    """qd, its change over 0.1 s, and how q and qd differ from a constant velocity's 0.1 and 0.5 s on: of sines."""
    phases = 2 * np.pi * np.random.default_rng(seed).random((count, 2))
    times = np.array([0.1, 0.5])

    def motion(t):
        return np.sin(phases + 3 * t), 3 * np.cos(phases + 3 * t)

    (q, qd), (_, before) = motion(0.0), motion(-0.1)
    ahead = np.stack([motion(t) for t in times], axis=2)  # (2, W, T, n)
    still = np.stack([q[:, None] + qd[:, None] * times[:, None], qd[:, None] + 0 * times[:, None]])
    return qd, qd - before, ahead - still, np.arange(count) // 25, times


def test_motion_goes_on_as_in_training():
    """A sine is told by its velocity and acceleration; a few jumps change little of what is found."""
    qd, change, measured, blocks, times = waves()
    found = extrapolation(qd, change, measured, blocks, times, 0.1)
    added = found.added(qd, change, times)
    np.testing.assert_allclose(added[0], measured[0], atol=0.005)
    np.testing.assert_allclose(added[1], measured[1], atol=0.005)
    jumping = measured.copy()
    jumping[:, ::40] += 20.0
    robust = extrapolation(qd, change, jumping, blocks, times, 0.1).added(qd, change, times)
    columns = np.stack([qd[:, 0] * 0.1, change[:, 0] * 0.05], axis=1)
    squares = columns @ np.linalg.lstsq(columns, jumping[0, :, 0, 0], rcond=None)[0]
    error, plain = (np.abs(x - measured[0, :, 0, 0]).max() for x in (robust[0, :, 0, 0], squares))
    assert error < 0.02 < 0.2 < plain
    between = found.added(qd, change, np.array([0.3]))
    assert np.abs(between[0, :, 0]).mean() < np.abs(measured[0, :, 1]).mean()


def test_what_does_not_go_on_is_not_extrapolated():
    """Noise that no stretch of time shares with others, and a joint at rest, are left at a constant velocity."""
    generator = np.random.default_rng(2)
    qd, change, measured = (generator.normal(size=x) for x in ((60, 3), (60, 3), (2, 60, 2, 3)))
    measured[..., 2], qd[:, 2], change[:, 2] = 0.0, 0.0, 0.0
    times, blocks = np.array([0.1, 0.5]), np.arange(60) // 6
    parts = extrapolation(qd, change, measured, blocks, times, 0.1).parts
    assert (parts[..., 2] == 0).all()
    assert np.mean(parts[..., :2] == 0) > 0.5
    many = [
        extrapolation(
            *(generator.normal(size=x) for x in (qd.shape, change.shape, measured.shape)), blocks, times, 0.1
        )
        for _ in range(10)
    ]
    assert np.mean([x.parts == 0 for x in many]) > 0.5


def test_calibration_reads_no_test_windows(offset_fit):
    """Whatever is tested, the same training windows tell what is trusted; forecasts of one window need no other."""
    results = [
        evaluate(offset_fit, motions(seed=seed, count=count, offset=offset), steps=(), seconds=(0.5,))
        for seed, count, offset in ((1, 2, OFFSET), (2, 3, -OFFSET))
    ]
    assert results[0].forecasts == results[1].forecasts
    assert results[0].horizons[0].errors[MODEL] != results[1].horizons[0].errors[MODEL]
    predictor, past = of_dynamics(MODEL, offset_fit.model, 2), past_steps(RATE)
    forecast = forecast_of(predictor, training_motion(offset_fit.calibration, ("revolute", "revolute")))
    windows = cut_windows(motions(seed=3, count=1), past + 11, 40, measured=False)
    together = forecast.states(rolled(predictor, windows, past))
    alone = forecast.states(rolled(predictor, windows[:1], past))
    torch.testing.assert_close(together[1][:1], alone[1])


def test_a_run_folder_keeps_the_windows(offset_fit, tmp_path):
    offset_fit.save(tmp_path / "run")
    kept = load_run(tmp_path / "run").calibration
    for before, after in zip(offset_fit.calibration.windows.columns(), kept.windows.columns(), strict=True):
        torch.testing.assert_close(before, after, atol=0, rtol=0)
    np.testing.assert_array_equal(kept.blocks, offset_fit.calibration.blocks)
    assert kept.past == offset_fit.calibration.past == 10
    test = motions(seed=1, count=1)
    assert evaluate(tmp_path / "run", test, steps=(5,), seconds=()).forecasts.keys() == {MODEL}
    (tmp_path / "run" / "calibration.npz").write_bytes(b"PK broken")
    with pytest.raises(RunError, match=r"calibration\.npz: got unreadable"):
        load_run(tmp_path / "run")
    (tmp_path / "run" / "calibration.npz").unlink()
    result = evaluate(tmp_path / "run", test, steps=(5,), seconds=())
    assert result.forecasts == {} and result.horizons[0].open_loop == {}
    assert "no forecasts, rollouts are open loop: no windows of its training logs are known" in {
        x.message for x in result.diagnostics
    }


def test_windows_are_spread_evenly_and_stretches_of_time_share_no_recording(offset_logs):
    long, short = offset_logs[0], offset_logs[1][:151]
    found = calibration_windows(held_sources([long, short]), HELD, REACH)
    assert found.past == 10
    assert found.windows.q.shape[1:] == (111, 2)
    of_long = np.isin(found.windows.q[:, 0, 0].numpy(), long.q[:, 0])
    assert (
        0.6 < of_long.mean() < 0.85
    )  # two thirds of all samples, and the ends of the short one are too short
    assert not set(found.blocks[of_long]) & set(found.blocks[~of_long])
    assert sorted(set(found.blocks)) == list(range(found.blocks.max() + 1))
    first = int(np.flatnonzero(long.q[:, 0] == found.windows.q[5, 0, 0].item())[0])
    np.testing.assert_allclose(found.windows.z[5], bristles_along(long.q, REACH)[first])


def test_samples_of_windows_are_not_denser_than_needed():
    t = np.arange(3001) / 1000
    dense = Trajectory(t, np.sin(t)[:, None], np.cos(t)[:, None], -np.sin(t)[:, None], "dense")
    found = calibration_windows(held_sources([dense]), HELD, BristleReach(REACH.values[:1]))
    np.testing.assert_allclose(found.windows.dt, 0.01)
    assert found.past == 10
    assert calibration_windows(held_sources([dense[:60]]), HELD, BristleReach(REACH.values[:1])) is None


def test_a_window_whose_numbers_blow_up_spoils_no_other(offset_logs):
    model, past = load_module(STAND_IN), past_steps(RATE)
    windows = cut_windows(offset_logs, past + 11, 60, measured=False)
    sound = of_dynamics(MODEL, model, 1)

    def fragile(part, disturbance=None):
        if (part.q[:, 0] == windows.q[3, past]).all(dim=-1).any():
            raise torch.linalg.LinAlgError("singular")
        return sound.states(part, disturbance)

    found = rolled(replace(sound, states=fragile), windows, past)
    expected = rolled(sound, windows, past)
    kept = np.isfinite(found.held).all(axis=(0, 2, 3))
    assert not kept[3] and kept.sum() >= 0.9 * len(windows)
    np.testing.assert_allclose(found.held[:, kept], expected.held[:, kept])


def test_without_a_past_windows_are_what_follows(offset_logs):
    windows = cut_windows(offset_logs, 21, 60, measured=False)
    ahead = without_past(windows, 10)
    torch.testing.assert_close(ahead.tau, windows.tau[:, 10:])
    assert ahead.q.shape[1] == 11 and ahead.dt.shape[1] == 10
