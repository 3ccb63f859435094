"""Friction states depend on the displacement and not on the time steps, are passive, and ignore encoder jitter."""

import numpy as np
import pytest
import torch
from emitted import ROBOTS, built, import_source
from exported_runs import arm_of

from spelgen.arm.configured_arm import load_arm
from spelgen.dynamics.bristles import (
    BristleReach,
    bristle_reach,
    bristles_along,
    encoder_step,
    moved_bristles,
    reach_of,
)
from spelgen.dynamics.friction import FrictionModel
from spelgen.emission.assemble import load_module
from spelgen.emission.build import build
from spelgen.fitting.rollout import loss_scales, momentum_loss, roll_out
from spelgen.identification.identification import LeastSquares
from spelgen.identification.identify import least_squares
from spelgen.logs.dynamics_samples import DynamicsSamples
from spelgen.logs.trajectory import Trajectory
from spelgen.logs.windows import Windows, cut_windows
from spelgen.runtime.friction_laws import FrictionLaws, SlidingFriction
from spelgen.runtime.rows import Joint

REACH = [[3e-4, 3e-3, 3e-2], [3e-5, 3e-4, 3e-3]]
JOINTS = (
    Joint("a", "revolute", lower=-3.0, upper=3.0, speed=2.0, friction=1.5, armature=0.1),
    Joint("b", "prismatic", lower=0.0, upper=1.0, speed=0.5, friction=4.0, armature=0.1),
)


def swings(samples: int, seed: int = 0) -> np.ndarray:
    """Return a smooth path of two joints with many reversals, (samples, 2) [rad, m]."""
    t = np.linspace(0.0, 4.0, samples)[:, None]
    phase = np.random.default_rng(seed).uniform(0, 6, (2, 3))
    waves = [np.sin((1.0 + 2.3 * k) * t + phase[:, k]) / (1 + k) for k in range(3)]
    return 0.05 * np.sum(waves, axis=0) * [1.0, 0.2]


def test_one_pass_over_positions_solves_the_differential_equation():
    model, q = build(arm_of("two_link"), "closed-form"), torch.from_numpy(swings(100_001))
    model.friction.reach = reach = torch.tensor(REACH).double()
    z = torch.zeros(2, 3).double()
    qd = q.diff(dim=0)
    for moved in qd:  # reference: explicit Euler, with steps far below the smallest break-away displacement
        z = z + model.memory_rate(z, moved)
    found = bristles_along(q[::1000].numpy(), BristleReach(np.array(REACH)))[-1]
    # The states z at every 10th position are compared with the reference. Every 1000th position (`found`) is too coarse
    # for this, since reversals between samples are lost: only the bound |z| <= reach is tested there.
    finer = bristles_along(q[::10].numpy(), BristleReach(np.array(REACH)))[-1]
    assert np.abs(finer / REACH - (z / reach).numpy()).max() < 1e-2
    assert np.abs(found / REACH).max() <= 1.0


def test_a_step_of_any_length_is_exact_in_one_direction():
    reach = torch.tensor(REACH).double()
    z = torch.randn(2, 3).double().clamp(-1, 1) * reach
    way = torch.tensor([0.02, -0.003]).double()
    parts = z
    for part in torch.rand(50, 1).double().softmax(dim=0):
        parts = moved_bristles(parts, (part * way).unsqueeze(-1), reach)
    # An absolute tolerance is needed, since the exact deflection may be zero. Fifty displacements of 20 mrad in total
    # accumulate rounding errors of about 1e-17 rad.
    torch.testing.assert_close(parts, moved_bristles(z, way.unsqueeze(-1), reach), rtol=1e-12, atol=1e-15)


def test_load_dependent_friction_is_smooth_at_right_angles():
    laws = SlidingFriction(JOINTS)
    constants = laws.prepare()
    still = torch.ones(2).double()

    def dry(gravity: torch.Tensor) -> torch.Tensor:
        return constants.dry(still, gravity)

    slopes = [torch.func.jacrev(dry)(x * still).diagonal() for x in (-1e-13, 0.0, 1e-13)]
    torch.testing.assert_close(slopes[0], slopes[2], rtol=0, atol=1e-9)
    assert slopes[1].abs().max() < 1e-9
    # far from zero load, the derivative of friction with respect to the load has the magnitude of the load dependence
    far = torch.func.jacrev(dry)(-5 * still).diagonal()
    torch.testing.assert_close(far, -constants.load_dependence, rtol=1e-3, atol=0)


def test_bristles_are_passive():
    """Bristles are passive: supplied power minus the rate of stored energy, the dissipation, is never negative."""
    laws = FrictionLaws(JOINTS, breakaway={"revolute": REACH[0], "prismatic": REACH[1]})
    with torch.no_grad():
        for weight in laws.parameters():
            weight += torch.randn(weight.shape, generator=torch.Generator().manual_seed(1)).double()
        # without Stribeck effect and load dependence the maximum bristle torques are constant
        laws.raw_stribeck -= 100.0
        laws.raw_load_dependence -= 100.0
        constants = laws.prepare()
        qd = torch.randn(500, 2, generator=torch.Generator().manual_seed(2)).double()
        z = (2 * torch.rand(500, 2, 3, generator=torch.Generator().manual_seed(3)).double() - 1) * laws.reach
        rate = qd.unsqueeze(-1) * (qd.sign().unsqueeze(-1) * z < laws.reach)
        stored = constants.coulomb.unsqueeze(-1) * constants.bristle_fractions * z / laws.reach * rate
        power = (constants.torque(qd, torch.zeros_like(qd), z) * qd).sum(dim=-1)
        lost = power - stored.sum(dim=(-2, -1))
        assert lost.min() >= -1e-12
        assert power.min() < 0  # some supplied power is negative, when bristles release stored energy
        energy = constants.stored_energy(z)
        assert energy.min() > 0


def test_energy_of_an_unforced_arm_never_rises(tmp_path):
    """The energy H of the arm rpr, stored energy of the bristles included, never increases while no torque acts."""
    model = import_source(built("rpr", preset="closed-form")[0], tmp_path / "rpr.py").Model(seed=1)
    with torch.no_grad():
        model.friction.raw_stribeck -= 100.0
        model.friction.raw_load_dependence -= 100.0
        q, qd = torch.tensor([[0.3, 0.1, -0.4]]).double(), torch.tensor([[1.0, 0.2, -1.5]]).double()
        steps = torch.full((1, 500), 2e-3).double()
        still = Windows(
            steps, q[:, None], qd[:, None], torch.zeros(1, 500, 3).double(), torch.zeros(1, 3, 6).double()
        )
        q, qd = (
            torch.cat([x[:, None], y], dim=1)[0] for x, y in zip((q, qd), roll_out(model, still), strict=True)
        )
        z = torch.from_numpy(bristles_along(q.numpy(), bristle_reach(model)))
        energies = model.hamiltonian(q, model.momentum(q, qd), z).numpy()
        rises = np.diff(energies)
        assert rises.max() < 1e-6 * energies[0]
        assert energies[-1] < energies[0] - 0.1


def test_jitter_of_an_encoder_is_no_motion():
    rng, step = np.random.default_rng(0), 1e-4
    still = np.round(rng.normal(0.3, 0.2 * step, (4000, 1)) / step) * step
    path = np.concatenate([np.linspace(0.0, 0.3, 1000)[:, None], still])
    path = np.round(path / step) * step
    assert encoder_step(path) == pytest.approx(step)
    z = bristles_along(path, BristleReach(np.array([[3e-4, 3e-3, 3e-2]])))
    # 4000 samples of encoder jitter have not relaxed the bristles
    assert z[-1, 0] == pytest.approx(z[1005, 0], rel=0.4)
    assert encoder_step(rng.normal(size=(500, 1))) == 0


def test_a_window_starts_with_the_bristles_of_its_past():
    q = swings(300)
    t = np.linspace(0.0, 3.0, 300)
    qd = np.gradient(q, t, axis=0)
    piece = trajectory(t, q, qd)
    windows = cut_windows([piece], 5, 3, measured=True, reach=BristleReach(np.array(REACH)))
    along = bristles_along(q, BristleReach(np.array(REACH)))
    assert windows.z is not None and np.array_equal(windows.z.numpy(), along[: 300 - 4 : 3])
    assert windows[2:4].z.shape == (2, 2, 3)


def trajectory(t: np.ndarray, q: np.ndarray, qd: np.ndarray) -> Trajectory:
    return Trajectory(t, q, qd, np.zeros_like(q))


def test_least_squares_finds_the_strengths_of_bristles():
    arm = load_arm(ROBOTS / "two_link.urdf").chain
    rng = np.random.default_rng(0)
    q = 0.3 * swings(3000) / 0.05
    qd, qdd = np.gradient(q, 0.002, axis=0), np.gradient(np.gradient(q, 0.002, axis=0), 0.002, axis=0)
    reach = reach_of(["revolute", "revolute"])
    z = bristles_along(q, reach)
    strengths = rng.uniform(0.2, 1.0, (2, 6))
    model = LeastSquares(friction=FrictionModel(memory=True))
    tau = (strengths * z / reach.values).sum(axis=-1)
    found = least_squares(arm, [DynamicsSamples("x", q, qd, qdd, tau, z)], model)
    names = [name for name in found.base.names if name.startswith("bristle")]
    assert len(names) == 12
    values = dict(zip(found.base.names, found.values, strict=True))
    for k in range(6):
        for joint in range(2):
            assert values[f"bristle {k + 1}, joint {joint + 1}"] == pytest.approx(
                strengths[joint, k], abs=1e-6
            )
    torque = found.torque(q, qd, qdd, z)
    np.testing.assert_allclose(torque, tau, atol=1e-6)


def test_the_weak_form_includes_all_work_of_the_drives():
    """The weak form of the momentum balance includes the torque offset and the friction compensation of drives.

    Otherwise their work would be attributed to the rigid bodies.
    """
    model = load_module(built("rpr", preset="closed-form")[0])
    dynamics = model
    with torch.no_grad():
        dynamics.raw_offset += 2.0
        dynamics.raw_friction_compensation += 1.0
    q, qd, tau = (torch.rand(3, 20, 1, 3, generator=torch.Generator().manual_seed(4)).double() - 0.5).unbind()
    held = Windows(
        torch.full((20, 8), 2e-3).double(),
        *(x.expand(-1, 9, -1) for x in (q, qd)),
        20 * tau.expand(-1, 8, -1),
    )
    with torch.no_grad():
        after = roll_out(model, held, 4)
    columns = [torch.cat([x[:, :1], y], dim=1) for x, y in zip((held.q, held.qd), after, strict=True)]
    windows = Windows(held.dt, *columns, held.tau)
    scales = loss_scales(windows, model.joint_types)
    true = momentum_loss(model, windows, scales).item()
    for changed in (dynamics.raw_offset.data, dynamics.raw_friction_compensation):
        kept = changed.clone()
        changed.zero_()
        assert momentum_loss(model, windows, scales).item() > 100 * true
        changed.copy_(kept)
