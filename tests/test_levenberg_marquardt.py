"""Damped Gauss-Newton steps: known ends, batches of systems, and the second way of a step."""

from itertools import pairwise

import pytest
import torch

from spelgen.fitting.levenberg_marquardt import NormalEquations, levenberg_marquardt, start
from spelgen.fitting.objectives import OBJECTIVES
from spelgen.settings.fits import CONFIGS


class Rosenbrock:
    """10 (y - x^2) and 1 - x, whose squares are least at (1, 1)."""

    def residuals(self, x):
        return torch.stack([10 * (x[1] - x[0] ** 2), 1 - x[0]])

    def cost(self, x, residuals):
        return float(residuals.square().sum() / 2)

    def normal_equations(self, x, residuals):
        slope = torch.tensor([[-20 * x[0], 10.0], [-1.0, 0.0]]).double()
        return NormalEquations(slope.mT @ slope, -slope.mT @ residuals)

    def moved(self, x, step):
        yield x + step


def test_the_valley_is_followed_to_its_end():
    problem = Rosenbrock()
    first = start(problem, torch.tensor([-1.2, 1.0]).double())
    states = list(levenberg_marquardt(problem, first, max_steps=100, least_gain=1e-20))
    costs = [first.cost, *(state.cost for state in states)]
    assert all(after <= before for before, after in pairwise(costs))
    torch.testing.assert_close(states[-1].x, torch.ones(2).double(), rtol=0, atol=1e-8)
    assert states[-1].converged
    assert list(levenberg_marquardt(problem, states[-1], max_steps=5)) == []


def test_a_fit_goes_on_from_any_of_its_states():
    problem = Rosenbrock()
    whole = list(
        levenberg_marquardt(problem, start(problem, torch.tensor([-1.2, 1.0]).double()), max_steps=9)
    )
    again = list(levenberg_marquardt(problem, whole[3], max_steps=5))
    assert torch.equal(again[-1].x, whole[-1].x) and again[-1].steps == whole[-1].steps


def test_systems_of_a_batch_have_their_own_damping():
    rows = torch.randn(3, 5, 2, generator=torch.Generator().manual_seed(0)).double()
    normal = NormalEquations(rows.mT @ rows, rows.sum(dim=1))
    damping = torch.tensor([0.0, 0.1, 10.0]).double()
    steps = normal.step(damping)
    for k in range(3):
        curvature, descent = normal.curvature[k], normal.descent[k]
        damped = curvature + damping[k] * torch.diag(curvature.diagonal())
        torch.testing.assert_close(damped @ steps[k], descent)


def test_the_second_way_is_taken_where_the_first_keeps_little():
    class Curved(Rosenbrock):
        def moved(self, x, step):
            yield x + 1e-3 * step
            yield x + step

    problem, x = Curved(), torch.tensor([0.9, 0.8]).double()
    (state,) = levenberg_marquardt(problem, start(problem, x, damping=1e-9), max_steps=1)
    (direct,) = levenberg_marquardt(Rosenbrock(), start(Rosenbrock(), x, damping=1e-9), max_steps=1)
    assert torch.equal(state.x, direct.x)


@pytest.mark.parametrize("name", CONFIGS)
def test_every_configuration_has_its_objective(name):
    assert OBJECTIVES[name].name == name == CONFIGS[name].objective
