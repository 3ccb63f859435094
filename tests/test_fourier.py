"""The Fourier series that M and V are: against the recursion at random points, in the module against Pinocchio."""

import numpy as np
import pytest
import torch
from emitted import ROBOTS, built, import_source
from hypothesis import HealthCheck, given, settings
from random_arms import arms

from spelgen.arm.arm import make_arm
from spelgen.dynamics.pinocchio_arm import arm_dynamics
from spelgen.loaded_arm import load_arm
from spelgen.structure.fourier import fourier_expansion
from spelgen.structure.nominal import nominal_inertias, working_range
from spelgen.structure.recursion import triangle
from spelgen.structure.sampling import float_energies
from spelgen.structure.structure import derive
from spelgen.urdf.read import read_urdf


def values(arm, terms, functions, q):
    """Fourier series at q (points, n), (points, functions)."""
    ranges = np.array([working_range(coordinate) for coordinate in arm.coordinates])
    x = (q - ranges.mean(axis=1)) / (ranges[:, 1] - ranges[:, 0]) * 2
    columns = []
    for each in functions:
        total = np.full(len(q), each.offset)
        for place, a, b in each.terms:
            term = terms[place]
            angle = q @ np.array(term.frequencies)
            size = np.prod(x ** np.array(term.powers), axis=1)
            total = total + size * (a * np.cos(angle) + b * np.sin(angle))
        columns.append(total)
    return np.stack(columns, axis=-1)


def assert_exact(arm, structure, inertias):
    """The series are M's outputs and V, but for nine digits; returns which of the two are series at all."""
    found = fourier_expansion(arm, structure, inertias)
    rng = np.random.default_rng(1)
    q = rng.uniform(-3, 3, (40, len(arm.coordinates)))
    mass, potential = float_energies(arm, q, inertias)
    if found.outputs:
        keys = triangle(len(arm.coordinates))
        true = [
            sum(float(value) * mass[:, keys.index((i, j))] for i, j, value in output.reads)
            for output in structure.outputs
        ]
        size = max(1.0, np.abs(true).max())
        assert np.abs(values(arm, found.terms, found.outputs, q).T - true).max() < 1e-7 * size
    if found.potential:
        rise = values(arm, found.terms, [found.potential], q)[:, 0]
        true = potential - potential[0]
        assert np.abs(rise - rise[0] - true).max() < 1e-7 * max(1.0, np.abs(true).max())
    return found.outputs is not None, found.potential is not None


@pytest.mark.parametrize(
    ("robot", "sums"),
    [
        ("two_link", (True, True)),
        ("rpr", (True, True)),
        ("scara", (True, True)),
        ("six_dof", (False, True)),
        ("ur10e", (False, True)),
        ("panda", (False, False)),
    ],
)
def test_they_add_up_to_the_recursion(robot, sums):
    arm = load_arm(ROBOTS / f"{robot}.urdf").arm
    structure = derive(arm)
    rng = np.random.default_rng(0)
    assert assert_exact(arm, structure, [list(rng.normal(size=10)) for _ in arm.bodies]) == sums
    assert assert_exact(arm, structure, nominal_inertias(arm, True)) == sums


@settings(max_examples=30, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(drawn=arms())
def test_random_arms_are_sums_too(tmp_path, drawn):
    path = tmp_path / "arm.urdf"
    path.write_text(drawn.text)
    arm = make_arm(read_urdf(path), joints=drawn.joints)
    rng = np.random.default_rng(0)
    assert_exact(arm, derive(arm), [list(rng.normal(size=10)) for _ in arm.bodies])


def test_parallel_axes_turn_as_sums_of_angles():
    """V of two links in a plane is a cos(q1 + b) + c cos(q1 + q2 + d), whatever they weigh."""
    arm = load_arm(ROBOTS / "two_link.urdf").arm
    found = fourier_expansion(arm, derive(arm), nominal_inertias(arm, True))
    frequencies = [term.frequencies for term in found.terms]
    assert [frequencies[place] for place, *_ in found.potential.terms] == [(1, 0), (1, 1)]
    assert [frequencies[place] for place, *_ in found.outputs[0].terms] == [(0, 1)]


def test_the_urdfs_inertials_leave_fewer():
    """A centre of mass on its axis is not to be moved by training under --assume inertials."""
    arm = load_arm(ROBOTS / "scara.urdf").arm
    terms = [
        sum(
            len(x.terms)
            for x in fourier_expansion(arm, derive(arm, assume), nominal_inertias(arm, True)).outputs
        )
        for assume in ("kinematics", "inertials")
    ]
    assert terms[1] <= terms[0]


def test_followers_have_none(tmp_path):
    text = (ROBOTS / "two_link.urdf").read_text()
    path = tmp_path / "mimic.urdf"
    path.write_text(
        text.replace(
            '<joint name="joint2" type="revolute">',
            '<joint name="joint2" type="revolute"><mimic joint="joint1" multiplier="0.5"/>',
        )
    )
    arm = make_arm(read_urdf(path))
    found = fourier_expansion(arm, derive(arm), nominal_inertias(arm, True))
    assert (found.terms, found.outputs, found.potential) == ((), None, None)


@pytest.mark.parametrize("robot", ["two_link", "rpr", "scara"])
@pytest.mark.parametrize("net", ["mlp", "kan"])
def test_an_untrained_module_is_the_urdfs_arm(robot, net, tmp_path):
    """Its numbers are the URDF's to nine digits, where sums are short enough; nothing had to be trained."""
    pytest.importorskip("pinocchio")
    loaded = load_arm(ROBOTS / f"{robot}.urdf")
    bare = loaded.settings.model_copy(update={"joints": {}})
    engine = arm_dynamics(loaded.arm, bare)
    model = import_source(built(robot, net=net)[0], tmp_path / f"{robot}_spel.py").Model(seed=0)
    q = torch.randn(20, model.n, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    with torch.no_grad():
        model.dynamics.mass.armature.raw.fill_(-100.0)  # drives are no part of a URDF
        mass, load_torque = model.mass_matrix(q).numpy(), model.gravity(q).numpy()
    still = np.zeros(model.n)
    for at, found, torque in zip(q.numpy(), mass, load_torque, strict=True):
        true = engine.mass_matrix(at)
        assert np.abs(found - true).max() < 2e-6 * max(1.0, np.abs(true).max())
        assert np.abs(torque - engine.nonlinear_effects(at, still)).max() < 1e-7 * 100
