"""Benchmarks: folds do not overlap, tables are correct, simulated errors have the specified level and correlation."""

import numpy as np
import pytest

from benchmarks import leaderboard, leaderboard_tables, real_errors, residual_statistics

RATE = 1000.0


def test_folds_use_every_recording_and_never_test_a_motion_that_was_trained(shared):
    folder = shared / "logs"
    tested, trained = {}, {}
    for fold in leaderboard.folds(folder):
        arm = fold.name.split("/")[0]
        tests = [log for logs in fold.tests.values() for log in logs]
        tested.setdefault(arm, set()).update(log.name for log in tests)
        trained.setdefault(arm, set()).update(log.name for log in fold.training)
        for log in fold.training:
            for test in tests:
                if log.name == test.name:  # training and test are parts of one recording
                    assert log.t[-1] < test.t[0] or test.t[-1] < log.t[0], fold.name
                else:
                    assert leaderboard.motion_of(log.name) != leaderboard.motion_of(test.name), fold.name
    for arm in ("ur10e", "airbot", "shanghai", "panda", "xmate3", "ar5", "tx40"):
        names = {path.stem for path in (folder / arm).glob("*.parquet")}
        loaded = {name for name in names if "load" in name.lower() and "unload" not in name}
        assert tested[arm] == trained[arm] == names - loaded


def test_first_seconds_are_taken_from_one_recording_after_the_other(shared):
    fold = next(fold for fold in leaderboard.folds(shared / "logs") if fold.name == "ur10e/split")
    assert [round(log.duration) for log in fold.first(3.0)] == [3]
    assert sum(log.duration for log in fold.first(40.0)) == pytest.approx(40.0, abs=0.1)
    assert len(fold.first(np.inf)) == 3


def rows(**errors):
    return [
        {"fold": "a/split", "seconds": "3", "method": name, "fit_s": 1.0, "nmse": {"rest": [nmse, nmse]}}
        for name, nmse in errors.items()
    ]


def test_the_default_is_compared_with_the_best_reference(tmp_path):
    results = rows(URDF=0.5, ridge=0.1, hybrid=0.13, GP=0.01)
    cells = leaderboard_tables.cells_of(results)
    assert leaderboard_tables.ratio_to_best(cells["a/split", "3", "rest"]) == pytest.approx(1.3)
    summary = leaderboard_tables.summary(cells)
    assert "at most 1.05 on 0 % of 1 cells" in summary[0]
    assert summary[-1].split() == ["above", "1.25:", "1.30", "a/split,", "3,", "rest"]
    page = tmp_path / "page.md"
    page.write_text("before\n<!-- leaderboard -->\nstale\n<!-- end of leaderboard -->\nafter\n")
    for _ in range(2):  # the second time the page already has the tables
        leaderboard_tables.write_page(page, results, cells, ["URDF", "ridge", "hybrid", "GP", "DeLaN"])
        text = page.read_text()
        assert text.startswith("before\n") and text.endswith("\nafter\n") and "stale" not in text
        assert text.count("|a/split|3|rest|0.5|0.1|0.13|0.01|1.30|") == 1


def test_changes_are_ratios_of_the_same_cells():
    before, now = (leaderboard_tables.cells_of(rows(hybrid=x, ridge=0.1)) for x in (0.2, 0.1))
    (changed, unchanged) = leaderboard_tables.changes(before, now, ["hybrid", "ridge", "URDF"])
    assert changed.startswith("hybrid / before: median 0.500") and "100% better" in changed
    assert unchanged.startswith("ridge / before: median 1.000") and "0% better" in unchanged


def test_noise_has_its_level_correlation_and_spectrum():
    """Torque noise of `ErrorProcess` has the given level, the autocorrelation exp(-lag / T) and an AR(1) spectrum.

    The level is the standard deviation of the noise divided by the standard deviation of the torque; T is the
    correlation time.
    """
    errors = real_errors.RealErrors(slow_noise=0.1, slow_correlation=0.5)
    process = real_errors.ErrorProcess(errors, np.ones(3), np.random.default_rng(0))
    torque = np.random.default_rng(1).normal(size=(400_000, 3))
    noise = (process.sensed(torque, 100.0, np.random.default_rng(2)) - torque) / torque.std(axis=0)
    np.testing.assert_allclose(noise.std(axis=0), 0.1, rtol=0.05)
    found = residual_statistics.residual_statistics([noise], [torque])
    expected = np.exp(-np.array(residual_statistics.LAGS) / 0.5)
    np.testing.assert_allclose(found.correlation, expected, atol=0.05)
    assert found.level == pytest.approx(0.1, rel=0.05)
    assert sum(found.power) == pytest.approx(1.0)
    # Spectrum of AR(1) noise: the share 2 / pi arctan(2 pi f T) of its power is below the frequency f, with the
    # correlation time T = 0.5 s.
    below = 2 / np.pi * np.arctan(np.pi * np.array(residual_statistics.BANDS[1:-1]))
    # A periodogram of 4 s resolves 0.25 Hz: power within 0.125 Hz of an edge may count in the wrong band. At the first
    # edge, 0.5 Hz, this is the power from 0.375 to 0.5 Hz, a share of 0.09: the tolerance.
    np.testing.assert_allclose(np.cumsum(found.power)[:-1], below, atol=0.09)


def test_errors_that_are_absent_change_nothing():
    process = real_errors.ErrorProcess(real_errors.RealErrors(), np.ones(2), np.random.default_rng(0))
    rng = np.random.default_rng(1)
    q, torque = rng.normal(size=(2, 500, 2))
    np.testing.assert_array_equal(process.sensed(torque, RATE, rng), torque)
    np.testing.assert_array_equal(process.encoded(q), q)
    np.testing.assert_array_equal(process.temperature_factor(np.arange(500) / RATE, rng), np.ones((500, 2)))
    np.testing.assert_array_equal(process.deflection(torque, np.ones(2)), np.zeros((500, 2)))
    for absent in (
        process.ripple(q),
        process.hysteresis(q),
        process.friction_factor(q) - 1,
        process.gain - 1,
        process.zero,
    ):
        np.testing.assert_array_equal(absent, np.zeros_like(absent))


def test_elastic_joints_resonate_and_teeth_change_flanks():
    errors = real_errors.RealErrors(resonance=10.0)
    process = real_errors.ErrorProcess(errors, np.ones(1), np.random.default_rng(0))
    # stiffness of a joint with a resonance of 10 Hz and a link inertia of 2 kg m^2
    stiffness = 2.0 * (2 * np.pi * 10.0) ** 2
    torque = np.linspace(-3.0, 3.0, 1001)[:, None]
    np.testing.assert_allclose(process.deflection(torque, np.array([2.0])), torque / stiffness)
    loose = real_errors.ErrorProcess(
        real_errors.RealErrors(backlash=0.01), np.ones(1), np.random.default_rng(0)
    )
    play = loose.deflection(torque, np.ones(1))
    np.testing.assert_allclose(play[[0, 500, -1], 0], [-0.005, 0.0, 0.005], atol=1e-6)


def test_play_sticks_and_slips():
    """The state of `play` is the bristle displacement divided by the break-away displacement, from -1 to 1.

    It is 1 from one break-away displacement after the start of a rising position, and -1 from two break-away
    displacements after the reversal.
    """
    q = np.concatenate([np.arange(0, 101), np.arange(99, -1, -1)])[:, None] * 0.01
    z = real_errors.play(q, np.array([0.1]))[:, 0]
    np.testing.assert_allclose(z[:11], np.linspace(0, 1, 11), atol=1e-9)
    np.testing.assert_allclose(z[11:101], 1.0)
    np.testing.assert_allclose(z[101:121], np.linspace(0.9, -1, 20), atol=1e-9)
    np.testing.assert_allclose(z[121:], -1.0)


def test_a_recording_s_friction_has_the_mean_of_its_arm():
    errors = real_errors.RealErrors(warm_up=0.3, warm_up_time=20.0)
    process = real_errors.ErrorProcess(errors, np.ones(2), np.random.default_rng(0))
    factor = process.temperature_factor(np.arange(0, 60, 0.01), np.random.default_rng(1))
    np.testing.assert_allclose(factor.mean(axis=0), 1.0)
    assert (np.diff(factor, axis=0) < 0).all() and factor[0, 0] - factor[-1, 0] == pytest.approx(
        0.3 * (1 - np.exp(-3)), rel=1e-3
    )
