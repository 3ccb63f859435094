"""Levenberg-Marquardt steps lead to known minima, and every run states why it ended."""

import pkgutil
from dataclasses import replace
from itertools import pairwise

import pytest
import torch

from spelgen.fitting.fit import OBJECTIVES
from spelgen.fitting.levenberg_marquardt import (
    NormalEquations,
    Termination,
    initial_state,
    levenberg_marquardt,
)
from spelgen.settings.fits import CONFIGS


class Rosenbrock:
    """The Rosenbrock problem: residuals 10 (y - x^2) and 1 - x, whose sum of squares has its minimum at (1, 1)."""

    def residual(self, x):
        return torch.stack([10 * (x[1] - x[0] ** 2), 1 - x[0]])

    def cost(self, x, residual):
        return float(residual.square().sum() / 2)

    def normal_equations(self, x, residual):
        jacobian = torch.tensor([[-20 * x[0], 10.0], [-1.0, 0.0]]).double()
        return NormalEquations(jacobian.mT @ jacobian, -jacobian.mT @ residual)

    def candidates(self, x, step):
        yield x + step


def first_state(problem):
    return initial_state(problem, torch.tensor([-1.2, 1.0]).double())


def test_the_minimum_of_the_rosenbrock_function_is_found():
    """The solver finds the minimum: no step raises the cost, and from the minimum no step is made."""
    problem, states = Rosenbrock(), [first_state(Rosenbrock())]
    result = levenberg_marquardt(
        problem, states[0], max_steps=100, min_decrease=1e-20, callback=states.append
    )
    costs = [state.cost for state in states]
    assert all(after <= before for before, after in pairwise(costs))
    assert result.state is states[-1] and result.state.steps == len(costs) - 1
    torch.testing.assert_close(result.state.x, torch.ones(2).double(), rtol=0, atol=1e-8)
    assert result.termination in (Termination.SMALL_DECREASE, Termination.SMALL_PREDICTION)
    again = levenberg_marquardt(problem, result.state, max_steps=5, min_decrease=1e-20)
    assert again.termination is Termination.SMALL_PREDICTION
    assert again.state is result.state


def test_a_fit_is_resumed_from_any_of_its_states():
    problem, states = Rosenbrock(), []
    whole = levenberg_marquardt(problem, first_state(problem), max_steps=9, callback=states.append)
    again = levenberg_marquardt(problem, states[3], max_steps=5)
    assert whole.termination is again.termination is Termination.MAX_STEPS
    assert torch.equal(again.state.x, whole.state.x) and again.state.steps == whole.state.steps


def test_an_ascent_direction_ends_the_solver():
    """If steps have the wrong sign and no damping lowers the cost, the solver ends with the reason NO_DECREASE.

    If also the predicted reduction is negligible, it ends with SMALL_PREDICTION. Of small dampings with nearly equal
    steps, only one is tried.
    """
    tried = []

    class Ascending(Rosenbrock):
        def candidates(self, x, step):
            tried.append(step)
            yield x - step

    problem = Ascending()
    for damping, termination in ((1e-9, Termination.NO_DECREASE), (1.0, Termination.SMALL_PREDICTION)):
        first = replace(first_state(problem), damping=damping)
        result = levenberg_marquardt(problem, first, max_steps=5)
        assert result.termination is termination and result.state is first
    assert all((after - before).norm() > 1e-3 * before.norm() for before, after in pairwise(tried))


def test_systems_of_a_batch_have_their_own_damping():
    rows = torch.randn(3, 5, 2, generator=torch.Generator().manual_seed(0)).double()
    normal = NormalEquations(rows.mT @ rows, rows.sum(dim=1))
    damping = torch.tensor([0.0, 0.1, 10.0]).double()
    steps = normal.step(damping)
    for k in range(3):
        curvature, descent = normal.curvature[k], normal.descent[k]
        damped = curvature + damping[k] * torch.diag(curvature.diagonal())
        torch.testing.assert_close(damped @ steps[k], descent)


def test_the_second_candidate_is_taken_if_the_gain_ratio_of_the_first_is_low():
    class Short(Rosenbrock):
        def candidates(self, x, step):
            yield x + 1e-3 * step
            yield x + step

    problem, x = Short(), torch.tensor([0.9, 0.8]).double()
    found, direct = (
        levenberg_marquardt(each, initial_state(each, x, damping=1e-9), max_steps=1)
        for each in (problem, Rosenbrock())
    )
    assert torch.equal(found.state.x, direct.state.x)


@pytest.mark.parametrize("name", CONFIGS)
def test_every_configuration_has_its_objective(name):
    assert pkgutil.resolve_name(OBJECTIVES[name]).name == name == CONFIGS[name].objective
