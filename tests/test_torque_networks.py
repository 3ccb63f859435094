"""If networks can represent an arm exactly, networks fitted to its torques reproduce it to many digits."""

import torch
from emitted import NETWORKS, ROBOTS, built, import_source

from spelgen.emission.specify import generate
from spelgen.fitting.fit import default_objective
from spelgen.fitting.torque import networks as torque_networks
from spelgen.fitting.torque.networks import fit_networks
from spelgen.fitting.torque.samples import TorqueSamples
from spelgen.logs.dynamics_samples import DynamicsSamples


def recorded(model, seed, count=150):
    random = torch.Generator().manual_seed(seed)
    q, qd, qdd = torch.randn(3, count, model.n, dtype=torch.float64, generator=random)
    with torch.no_grad():
        tau = model.inverse_dynamics(q, qd, qdd)
    return DynamicsSamples("drawn", *(x.numpy() for x in (q, qd, qdd, tau)))


def missed(model, samples):
    q, qd, qdd, tau = (torch.from_numpy(getattr(samples, x)) for x in ("q", "qd", "qdd", "tau"))
    with torch.no_grad():
        return float((model.inverse_dynamics(q, qd, qdd) - tau).square().mean() / tau.var(dim=0).mean())


def test_networks_predict_the_torques_of_another_arm(tmp_path):
    """Networks fitted to the torques of an arm with other masses, rotors and friction predict them at new positions."""
    source = generate(ROBOTS / "two_link.urdf", NETWORKS, width=16)
    module = import_source(source, tmp_path / "two_link_spel.py")
    true, model = module.Model(seed=0), module.Model(seed=1)
    with torch.no_grad():
        true.mass.raw_constants *= 1.5
        true.mass.raw_armature += 0.5
        true.friction.raw_viscous += 1.0
    start = missed(model, recorded(true, 7))
    steps = fit_networks(
        model, TorqueSamples.of([recorded(true, 5), recorded(true, 6)]), 1e-6, evaluations=500
    )
    assert steps % 20 == 0
    assert start > 1e-3
    assert missed(model, recorded(true, 7)) < 1e-6


def test_penalised_parameters_stay(tmp_path):
    """A strong penalty keeps parameters at their initial values, although the torques support other ones."""
    module = import_source(built("two_link", design=NETWORKS)[0], tmp_path / "two_link_spel.py")
    true, model = module.Model(seed=0), module.Model(seed=0)
    constants = model.mass.raw_constants
    with torch.no_grad():
        true.mass.raw_constants *= 1.5
    fit_networks(
        model, TorqueSamples.of([recorded(true, 5)]), 1e-6, lambda: 1e3 * (constants - 1).square().sum()
    )
    assert (constants - 1).abs().max() < 0.01


def test_blocks_equal_a_single_batch(tmp_path, monkeypatch):
    """The loss and its gradient over blocks of samples equal the loss and gradient of a single batch.

    A whole fit is not compared, as many steps would amplify rounding errors.
    """
    module = import_source(built("two_link", design=NETWORKS)[0], tmp_path / "two_link_spel.py")
    true = module.Model(seed=0)
    samples = TorqueSamples.of([recorded(true, 5), recorded(true, 6)])
    whole, parts = module.Model(seed=1), module.Model(seed=1)
    penalty = lambda model: lambda: 1e-3 * model.mass.raw_constants.square().sum()  # noqa: E731
    fit_networks(whole, samples, 1e-6, penalty(whole), evaluations=20)
    monkeypatch.setattr(torque_networks, "BLOCK", 128)
    fit_networks(parts, samples, 1e-6, penalty(parts), evaluations=20)
    for name, value in whole.state_dict().items():
        torch.testing.assert_close(parts.state_dict()[name], value, rtol=1e-5, atol=1e-7)


def test_networks_are_fitted_to_torques_only_on_request(tmp_path):
    """The default objective of networks is to predict windows; they are fitted to torques only by request."""
    model = import_source(built("two_link", design=NETWORKS)[0], tmp_path / "two_link_spel.py").Model()
    assert default_objective(model, lambda: [1000.0]) == "rollout"
