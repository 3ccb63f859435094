"""Networks fitted to torques: the torques of an arm that they can be, met to many digits."""

from types import SimpleNamespace

import torch
from emitted import built, import_source

from spelgen.fitting.dataset import TrainingConfig
from spelgen.fitting.torque_networks import fit_networks
from spelgen.fitting.torque_start import start_from_torque
from spelgen.identification.samples import DynamicsSamples


def recorded(model, seed, count=300):
    random = torch.Generator().manual_seed(seed)
    q, qd, qdd = torch.randn(3, count, model.n, dtype=torch.float64, generator=random)
    with torch.no_grad():
        tau = model.inverse_dynamics(q, qd, qdd)
    return DynamicsSamples("drawn", *(x.numpy() for x in (q, qd, qdd, tau)))


def missed(model, samples):
    q, qd, qdd, tau = (torch.from_numpy(getattr(samples, x)) for x in ("q", "qd", "qdd", "tau"))
    with torch.no_grad():
        return float((model.inverse_dynamics(q, qd, qdd) - tau).square().mean() / tau.var(dim=0).mean())


def test_another_arms_torques_are_met(tmp_path):
    """Of an arm with other masses, rotors and friction, on positions that were not seen."""
    module = import_source(built("two_link")[0], tmp_path / "two_link_spel.py")
    true, model = module.Model(seed=0), module.Model(seed=1)
    with torch.no_grad():
        true.mass_series.factors *= 1.3
        true.potential_series.factors *= 0.8
        true.constants *= 1.5
        true.rotor += 0.5
        true.friction.viscous += 1.0
    start = missed(model, recorded(true, 7))
    steps = fit_networks(model, [recorded(true, 5), recorded(true, 6)], 1e-6)
    assert steps % 20 == 0
    assert start > 1e-3
    assert missed(model, recorded(true, 7)) < 1e-6


def test_the_objective_torque_fits_and_leaves_no_windows(tmp_path, monkeypatch):
    module = import_source(built("two_link")[0], tmp_path / "two_link_spel.py")
    true, model = module.Model(seed=0), module.Model(seed=0)
    with torch.no_grad():
        true.constants *= 1.5
    monkeypatch.setattr(
        "spelgen.fitting.torque_start.dynamics_samples", lambda recordings: [recorded(true, 5)]
    )
    config = TrainingConfig(objective="torque")
    left, notes = start_from_torque(model, SimpleNamespace(recordings=()), config, fit=True)
    assert (left.epochs, left.momentum_steps) == (0, 0)
    assert [note.code for note in notes] == ["torque-fit"]
    assert missed(model, recorded(true, 7)) < 1e-6


def test_what_pulls_is_weighed(tmp_path):
    """A pull away from the torques leaves an error that nothing else would."""
    module = import_source(built("two_link")[0], tmp_path / "two_link_spel.py")
    true, model = module.Model(seed=0), module.Model(seed=0)
    with torch.no_grad():
        true.constants *= 1.5
    fit_networks(model, [recorded(true, 5)], 1e-6, lambda: 1e3 * (model.constants - 1).square().sum())
    assert (model.constants - 1).abs().max() < 0.01


def test_networks_are_fitted_to_torques_only_where_that_is_asked_for(tmp_path):
    """Without a word on it windows are predicted; the objective momentum leaves its own steps alone."""
    model = import_source(built("two_link")[0], tmp_path / "two_link_spel.py").Model()
    weights = {name: value.clone() for name, value in model.state_dict().items()}
    samples = SimpleNamespace(recordings=())
    for objective, epochs in ((None, 200), ("rollout", 200), ("momentum", 0)):
        config = TrainingConfig(epochs=200, objective=objective)
        left, notes = start_from_torque(model, samples, config, fit=True)
        assert (left.epochs, left.momentum_steps, notes) == (epochs, config.momentum_steps, [])
    assert all(torch.equal(value, weights[name]) for name, value in model.state_dict().items())
