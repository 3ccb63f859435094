"""The momentum observer estimates constant and changing external torques from past samples only."""

import numpy as np
import pytest
import torch
from planar_model import Model

from spelgen.baselines.predictor import Solver
from spelgen.dynamics.protocol import VelocityState
from spelgen.evaluation import horizons
from spelgen.evaluation.evaluate import evaluate
from spelgen.evaluation.horizons import observe, past_steps, without_past
from spelgen.evaluation.rollout import rollout
from spelgen.evaluation.tuning import EvaluationTuning
from spelgen.labels import CONSTANT_VELOCITY, MODEL, observed
from spelgen.logs.preprocessing import Preprocessing
from spelgen.logs.trajectory import Trajectory
from spelgen.logs.windows import cut_windows

RATE = 100.0
OFFSET = torch.tensor([0.6, -0.4], dtype=torch.float64)  # [Nm] external torques that are not in the log
UNFILTERED = Preprocessing(cutoff=0, decimation=1)


def motions(count=4, seconds=3.0, offset=OFFSET, after=0.0) -> list[Trajectory]:
    """Simulate the planar model under smooth torques, plus `offset` [Nm] from time `after` [s] on; return the logs.

    The offset is not in the logged torques.
    """
    model = Model()
    generator = torch.Generator().manual_seed(0)
    t = torch.arange(round(seconds * RATE) + 1) / RATE
    phases, speeds = (torch.rand(count, 1, 2, generator=generator, dtype=torch.float64) for _ in "ab")
    tau = 2 * torch.sin(6.28 * (phases + (0.5 + speeds) * t[:, None]))  # torques of each log, (count, T, 2)
    start = 2 * phases[:, 0] - 1
    driven = tau[:, :-1] + offset * (t[:-1, None] >= after)
    with torch.no_grad():
        q, qd = rollout(model, start, torch.zeros_like(start), driven, 1 / RATE, substeps=2)
    return [Trajectory(t, q[k], qd[k], tau[k], f"motion_{k}") for k in range(count)]


def test_a_constant_torque_is_found():
    model, past = Model(), past_steps(RATE)
    windows = cut_windows(motions(), past + 51, 20, measured=False)
    ahead, disturbance = observe(model, windows, past)
    torch.testing.assert_close(disturbance, OFFSET.expand_as(disturbance), atol=0.01, rtol=0)
    torch.testing.assert_close(ahead.q, windows.q[:, past:])


@pytest.mark.parametrize("time_constant", [0.02, 0.05])
def test_a_step_is_followed_with_the_time_constant(monkeypatch, time_constant):
    """A constant torque that began t seconds ago is estimated as 1 - exp(-t / time constant) of its value.

    The observer has run for two seconds before.
    """
    tuning = EvaluationTuning(observer_time_constant=time_constant)
    monkeypatch.setattr(horizons, "TUNING", tuning)
    model, log = Model(), motions(count=1, after=2.0)[0]
    for since in (0.02, 0.05, 0.1):
        past = round((2.0 + since) * RATE)
        windows = cut_windows([log[: past + 2]], past + 2, measured=False)
        _, disturbance = observe(model, windows, past)
        expected = OFFSET * (1 - np.exp(-since / time_constant))
        torch.testing.assert_close(disturbance[0], expected, atol=0.02, rtol=0)


def test_it_depends_only_on_past_samples():
    model, past = Model(), past_steps(RATE)
    windows = cut_windows(motions(), past + 21, 20, measured=False)
    _, before = observe(model, windows, past)
    for values in (windows.q, windows.qd):
        values[:, past + 1 :] = torch.nan
    windows.tau[:, past:] = torch.nan
    torch.testing.assert_close(observe(model, windows, past)[1], before)


class InVelocities:
    """Dynamics of the planar model with `forward_dynamics` only, like user-defined dynamics that have no momenta."""

    def __init__(self) -> None:
        self.model = Model()

    def forward_dynamics(self, *state: torch.Tensor) -> torch.Tensor:
        return self.model.forward_dynamics(*torch.broadcast_tensors(*state))


def test_models_in_velocities_are_observed():
    model, past = Model(), past_steps(RATE)
    windows = cut_windows(motions(), past + 51, 20, measured=False)
    ahead, disturbance = observe(VelocityState(InVelocities()), windows, past)
    mass = model.mass_matrix(ahead.q[:, 0])
    missing = torch.linalg.solve(mass, OFFSET.expand_as(disturbance).unsqueeze(-1)).squeeze(-1)
    torch.testing.assert_close(disturbance, missing, atol=0.15, rtol=0.15)


def test_rollouts_with_the_estimate_are_compared_with_open_loop():
    result = evaluate(Model(), motions(), preprocessing=UNFILTERED, steps=(), seconds=(0.1, 0.5))
    for horizon in result.horizons:
        error = {name: x.mean_relative_rms for name, x in horizon.errors.items()}
        assert list(error) == [MODEL, observed(MODEL), CONSTANT_VELOCITY]
        assert error[observed(MODEL)] < 0.1 * error[MODEL]
        assert error[MODEL] < error[CONSTANT_VELOCITY]
    text = " ".join(result.text().split())
    assert "+ observer: with the constant disturbance" in text
    whole = evaluate(Model(), motions(seconds=0.5), preprocessing=UNFILTERED, steps=(), seconds=(0.45,))
    assert list(whole.horizons[0].errors) == [MODEL, CONSTANT_VELOCITY]
    assert "no observer over 0.45 s: the longest trajectory has 50 steps" in {
        x.message for x in whole.diagnostics
    }


def test_a_diverged_window_affects_no_other():
    model = Model()
    windows = cut_windows(motions(), 11, 60, measured=False)
    solver = Solver(model, windows)
    sound = solver(windows)
    disturbance = torch.zeros_like(windows.q[:, 0])
    disturbance[3] = 1e12  # a disturbance torque at which the rollout diverges
    q, qd = solver(windows, disturbance)
    others = torch.arange(len(windows)) != 3
    assert q[3].isnan().all() and qd[3].isnan().all()
    torch.testing.assert_close((q[others], qd[others]), (sound[0][others], sound[1][others]))


def test_the_steps_before_a_window_are_removed():
    windows = cut_windows(motions(), 21, 60, measured=False)
    ahead = without_past(windows, 10)
    torch.testing.assert_close(ahead.tau, windows.tau[:, 10:])
    assert ahead.q.shape[1] == 11 and ahead.dt.shape[1] == 10
