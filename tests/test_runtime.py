"""Parts of the runtime: derivatives equal autograd's, units are right, modules contain the classes that they use."""

import ast
import json
import math
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from emitted import SIX, built, import_source
from exported_runs import arm_of
from torch import Tensor
from torch.func import jacrev, jvp, vjp

from spelgen.design import PRESET_NAMES, load_design
from spelgen.dynamics.body_regressor import pseudo_inertia
from spelgen.dynamics.parameters import parameter_table, parameters_of_kind
from spelgen.emission.build import build
from spelgen.emission.standalone import bundle, load_runtime
from spelgen.emission.text import names_in
from spelgen.fitting.torque.parameters import log_cholesky_parameters, upper_cholesky
from spelgen.runtime.body_chain import InertialParameters
from spelgen.runtime.derived_mass import DerivedMass
from spelgen.runtime.friction_laws import SlidingFriction, turning
from spelgen.runtime.networks import JointEncoding, MaskedKAN, MaskedMLP, hidden_units
from spelgen.runtime.parts import symmetric
from spelgen.runtime.residual_terms import HARMONICS, SPLINES, ResidualTerms
from spelgen.runtime.rows import Constant, Joint, Link, vector

NUMBERS = Path(__file__).parent / "golden" / "numbers.json"
# Replacements in the source that restore three formulas of friction of the first release: the load was |gravity
# torque|, the smooth sign was tanh, and the Stribeck curve was exp.
FIRST_STAGE = (
    ("load = 0.01 * torch.where", "load = 0.0 * torch.where"),
    ("torch.rsqrt(velocity * velocity + width**2)", "(velocity / width).tanh() / velocity"),
    ("slow.square().square().square()", "(-((qd / self.stribeck_velocity) ** 2)).exp()"),
)
JOINTS = (
    Joint("a", "revolute", lower=-3.0, upper=3.0, speed=1.0, friction=1.0, armature=0.1),
    Joint("b", "prismatic", lower=0.25, upper=0.75, speed=0.5, friction=2.0, armature=0.2, gear=10.0),
    Joint("c", "revolute", lower=-2.0, upper=2.0, speed=2.0, friction=0.0, armature=0.3, gear=101.0),
)


def draw(*shape: int, seed: int = 0) -> Tensor:
    """Return normal random numbers of this shape."""
    return torch.randn(*shape, dtype=torch.float64, generator=torch.Generator().manual_seed(seed))


def near(ours: Tensor, reference: Tensor, bound: float = 1e-12) -> None:
    assert ours.shape == reference.shape
    assert (ours - reference).abs().max() <= bound * max(1.0, reference.abs().max().item())


@pytest.mark.parametrize("joints", [JOINTS, [x._replace(joint_type="revolute") for x in JOINTS]])
def test_encoding_is_cos_sin_and_scaled_distance_with_its_derivatives(joints):
    encoding, q, qd = JointEncoding(joints), draw(4, 3), draw(4, 3, seed=1)
    encoded, rate = jvp(encoding, (q,), (qd,))
    near(encoded[:, 0], q[:, 0].cos())
    near(encoded[:, 5], q[:, 2].sin())
    if joints is JOINTS:
        near(encoded[:, 1], (q[:, 1] - 0.5) / 0.25)
    near(encoding.jvp(encoded, qd), rate)
    cotangent = draw(*encoded.shape, seed=2)
    near(encoding.vjp(encoded, cotangent), vjp(encoding, q)[1](cotangent)[0])


@pytest.mark.parametrize("kind", [MaskedMLP, MaskedKAN])
def test_derivatives_of_networks_equal_autograd_and_inputs_are_masked(kind):
    encoding = JointEncoding(JOINTS)
    outputs = [("a",), ("b", "c"), ("c",)]
    generator = torch.Generator().manual_seed(0)
    scales = [(1.0, 0.5, 2.0)] * 2
    network = kind(generator, JOINTS, scales=scales, outputs=outputs, width=9, min_units=2)
    for weight in network.parameters():
        weight.data = draw(*weight.shape, seed=weight.numel())
    layers = network.prepare(draw(5, 3), draw(5, seed=1))
    encoded, tangent = encoding(draw(4, 3)), draw(4, 6, seed=3)
    (rows, rate) = jvp(lambda x: network(x, layers)[0], (encoded,), (tangent,))
    residuals = network(encoded, layers)[1]
    near(network.jvp(residuals, tangent), rate, 1e-10)
    cotangent = draw(*rows.shape, seed=4)
    pulled = vjp(lambda x: network(x, layers)[0], encoded)[1](cotangent)[0]
    near(network.vjp(residuals, cotangent), pulled, 1e-10)
    plain = network.prepare(torch.eye(3, dtype=torch.float64), torch.zeros(3, dtype=torch.float64))
    slopes = jacrev(lambda q: network(encoding(q), plain)[0])(draw(3))
    assert (slopes != 0).tolist() == [[joint.name in names for joint in JOINTS] for names in outputs]


def test_hidden_units_are_shared_in_proportion_to_outputs():
    hidden = hidden_units([(2,), (1, 2), (1, 2)], width=64, min_units=4)
    assert hidden == [(2,)] * 21 + [(1, 2)] * 43
    crowded = hidden_units([(k,) for k in range(9)], width=8, min_units=2)
    assert crowded == [(k,) for k in range(9) for _ in range(2)], "each group has at least min_units"


def entries(f1, f2, c1):
    """Return M (..., 3, 3), like `mass_entries` of an emitted module.

    M11 is f1, M21 f1 - 2 f2, M22 c1, M31 0, M32 f2 and M33 3 f2. f1, f2: values (...) of two functions of q at a batch
    of states. c1: constant.
    """
    return symmetric([f1], [f1 - 2 * f2, c1], [0, f2, 3 * f2])


def residual_terms(joints=JOINTS, size: float = 0.0, *, networks: bool = True) -> ResidualTerms:
    """Return residual terms with normal random parameters of standard deviation `size`.

    networks: whether networks for M and V are added to the functions of single joints.
    """
    generator, parts = torch.Generator().manual_seed(0), {}
    if networks:
        scales = [(1.0, 1.0, 1.0)] * 2
        outputs, everything = [("a", "b"), ("c",)], [("a", "b", "c")]
        parts["network"] = MaskedMLP(generator, joints, scales=scales, outputs=outputs, width=8)
        parts["potential"] = MaskedMLP(generator, joints, scales=scales, outputs=everything, width=8, depth=1)
    terms = ResidualTerms(joints, entries, functions=2, constants=1, potential_scale=2.0, **parts)
    for weight in terms.parameters():
        weight.data = size * draw(*weight.shape, seed=weight.numel())
    return terms


def test_residual_terms_are_a_gradient_and_vanish_outside_the_range():
    joints = (*JOINTS[:2], JOINTS[2]._replace(friction=0.5))
    terms, armature = residual_terms(joints, 1.0), torch.diag(vector((0.1, 20.0, 3.0)))
    q, qd = draw(50, 3), draw(50, 3, seed=1)
    weights = terms.prepare(armature)
    pose = terms.at(q, weights)
    assert (pose.friction > 0).all()

    def added(at: Tensor) -> Tensor:
        """Return the Lagrangian 1/2 qd^T R qd - V of the residual terms, summed over 50 states.

        R is the residual term of the mass matrix, V of the potential. at: positions q, (50, 3); qd is not varied.
        """
        mass = terms.at(at, weights).mass
        return 0.5 * torch.einsum("ti,tij,tj->", qd, mass, qd) - terms.energy(terms.at(at, weights)).sum()

    gradient = vjp(added, q)[1](torch.ones((), dtype=torch.float64))[0]
    near(terms.gradient(pose, qd), gradient, 1e-10)
    rate = jvp(lambda at: terms.at(at, weights).mass, (q,), (qd,))[1]
    near(terms.nonlinear(pose, qd), torch.einsum("tij,tj->ti", rate, qd) - gradient, 1e-10)
    inside = torch.linspace(-3, 3, 20, dtype=torch.float64)[:, None] * torch.tensor([0.9, 0.075, 0.6])
    inside = inside + vector(joint.center for joint in JOINTS)
    near(terms.splines(inside).sum(dim=-1), torch.ones(20, 3).double(), 1e-12)
    far = 100 * torch.ones(1, 3, dtype=torch.float64)
    near(terms.splines(far), torch.zeros(1, 3, SPLINES).double())
    assert not weights.ripple[1].any(), "a prismatic joint has no turns"
    near(terms.waves(q)[:, 2, HARMONICS + 1], (202 * q[:, 2]).cos())


def test_friction_stays_between_a_tenth_and_ten_times_for_all_weights():
    terms, q, armature = residual_terms(networks=False), draw(50, 3), torch.diag(vector((0.1, 20.0, 3.0)))
    for size in (0.01, 1.0, 1e6):
        terms.raw_friction_splines.data = size * draw(*terms.raw_friction_splines.shape)
        factor = terms.at(q, terms.prepare(armature)).friction.detach()
        assert (factor > 0.1 - 1e-12).all() and (factor < 10 + 1e-12).all()
    assert factor.min() < 0.2 and factor.max() > 5


def test_the_residual_of_m_is_smaller_than_the_armature():
    motors = torch.tensor([[1.0, 0.0, 0.0], [0.0, 1.0, 0.8], [0.0, -0.7, 1.2]], dtype=torch.float64)
    for armature in (
        torch.diag(vector((0.1, 20.0, 3.0))),
        motors.mT @ torch.diag(vector((1.0, 0.2, 5.0))) @ motors,
    ):
        least = torch.linalg.eigvalsh(armature)[0]
        for size in (1.0, 1e3):
            terms = residual_terms(size=size)
            residual = terms.at(draw(200, 3), terms.prepare(armature)).mass
            near(residual, residual.mT)
            assert residual.abs().max() > 1e-3
            assert torch.linalg.eigvalsh(armature + residual).min() > 0.05 * least


def test_entries_of_a_symmetric_matrix():
    f, c = draw(7, 2), draw(7, 1)
    f1, f2, c1 = *f.unbind(-1), *c.unbind(-1)
    matrix = symmetric([f1], [f1 - 2 * f2, c1], [0, f2, 0])
    near(matrix, matrix.mT)
    assert (matrix[:, 2, 2] == 0).all()
    near(matrix[:, 1, 0], f[:, 0] - 2 * f[:, 1])
    near(matrix[:, 2, 1], f[:, 1])
    near(matrix[:, 1, 1], c[:, 0])


def test_the_bound_changes_only_matrices_that_are_not_positive_definite():
    center = torch.diag(torch.tensor([5.0, 1.0, 1e-3], dtype=torch.float64))
    mass = DerivedMass(
        JOINTS,
        lambda c1, c2, c3: symmetric([c1], [0, c2], [0, 0, c3]),
        functions=(),
        constants=[Constant(initial=value, scale=value) for value in center.diagonal().tolist()],
        network=torch.nn.Identity(),
        margin=1e-3,
    )

    def bound(matrix: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        fraction = mass.fraction(matrix)
        return torch.lerp(center, matrix, fraction[:, None, None]), fraction

    near(mass.center, center)
    root = draw(500, 3, 3)
    definite = root @ root.mT + 2e-3 * center
    kept, part = bound(definite)
    assert torch.equal(kept, definite)
    assert (part == 1).all()
    for size in (1e-6, 1.0, 1e12):
        broken = size * (root + root.mT)
        broken = broken[torch.linalg.eigvalsh(broken)[:, 0] < 0]
        mended, part = bound(broken)
        assert len(broken) > 400
        assert (part <= 0.5).all()
        near(mended, center + part[:, None, None] * (broken - center), 1e-12)
        root_center = center.diagonal().rsqrt()
        relative = root_center[:, None] * mended * root_center
        assert torch.linalg.eigvalsh(relative)[:, 0].min() >= 1e-3


def test_bodies_are_physically_consistent_for_all_parameters():
    mass, center, inertia = 2.0, (0.05, 0.1, 0.15), (0.4, 0.01, 0.02, 0.5, 0.03, 0.3)
    link = Link("a", None, "a", (0.0, 0.0, 0.0), mass, center, inertia)
    parameters = InertialParameters([link])
    xx, xy, xz, yy, yz, zz = inertia
    about_center = torch.tensor([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]], dtype=torch.float64)
    c = torch.tensor(center, dtype=torch.float64)
    eye = torch.eye(3, dtype=torch.float64)
    # the pseudo-inertia contains S = 1/2 tr(J) 1 - J, where J is the inertia about the frame's origin (Steiner)
    about_origin = about_center + mass * (c.dot(c) * eye - torch.outer(c, c))
    found = (parameters() @ parameters().mT)[0]
    near(found[:3, :3], about_origin.trace() / 2 * eye - about_origin)
    near(found[:3, 3], mass * c)
    assert found[3, 3].item() == pytest.approx(mass)
    for seed in range(100):
        parameters.raw.data = 2 * draw(1, 10, seed=seed)
        root = parameters()
        assert torch.linalg.eigvalsh(root @ root.mT)[0, 0] > 0


def test_friction_is_dissipative_and_equals_its_formula():
    laws = SlidingFriction(JOINTS)
    constants = laws.prepare()
    near(constants.coulomb, torch.tensor([1.0, 2.0, 0.0], dtype=torch.float64))
    gravity = torch.tensor([3.0, -4.0, 5.0], dtype=torch.float64)
    fast = 1e3 * torch.ones(3, dtype=torch.float64)
    dry = constants.coulomb + constants.load_dependence * torch.hypot(gravity, constants.min_load)
    dry += constants.stribeck / (1 + (fast / constants.stribeck_velocity) ** 2)
    expected = constants.viscous * fast + dry * fast * turning(fast, constants.coulomb_smoothing_velocity)
    expected += constants.saturation * fast * turning(fast, constants.saturation_velocity)
    near(constants.torque(fast, gravity), expected)
    assert expected.allclose(constants.viscous * fast + constants.saturation + dry, rtol=0, atol=1e-6)
    qd = draw(100, 3)
    assert (constants.torque(qd, gravity) * qd >= 0).all()
    near(constants.torque(-qd, gravity), -constants.torque(qd, gravity))
    x = torch.tensor([0.0, 1e-9, 0.75, -4e9], dtype=torch.float64)
    near(x * turning(x, torch.ones(4)), torch.tensor([0.0, 1e-9, 0.6, -1.0], dtype=torch.float64))


def test_a_standalone_module_contains_the_definitions_that_it_uses():
    """Each definition in a standalone module is the runtime's text, is used, and is listed in the module's contents."""
    runtime = load_runtime()
    for preset in PRESET_NAMES:
        source = built("rpr", preset=preset, standalone=True)[0]
        tree = ast.parse(source)
        defined = {node.name for node in tree.body if isinstance(node, ast.ClassDef | ast.FunctionDef)}
        contents = ast.get_docstring(tree).partition("Contents")[2].split()
        for name in defined - {"Model", "mass_entries"}:
            assert runtime.definitions[name].text in source
            assert name in contents or runtime.definitions[name].file == "rows"
            users = [
                node for node in tree.body if name in names_in(node) and getattr(node, "name", "") != name
            ]
            assert users, f"{name} is used by nothing in {preset}"
    assert not any(bundle("x = 1", "").values())


def test_a_thin_module_is_short_and_shows_the_entries():
    longest = {"hybrid": 120, "spel": 100}  # maximum lines of a module of rpr that imports spelgen.runtime
    for robot in SIX:
        for preset in PRESET_NAMES:
            lines = built(robot, preset=preset)[0].splitlines()
            most = (
                longest.get(preset, 110) if robot == "rpr" else 325
            )  # spel of the Panda has the longest module: 27 functions of 7 joints
            assert len(lines) <= most, f"{robot}, {preset}: {len(lines)} lines"
    assert "return symmetric([f3], [f1, c2], [f2, 0, c1])" in built("rpr")[0]
    assert "m22 = f9 + 2 * f12 - f5" in built("six_dof")[0]


def test_values_are_in_units(tmp_path):
    model = import_source(built("six_dof")[0], tmp_path / "six.py").Model()
    near(model.armature, torch.tensor([0.306, 0.306, 0.204, 0.0816, 0.0816, 0.0816], dtype=torch.float64))
    closed = import_source(built("rpr", preset="closed-form")[0], tmp_path / "closed.py").Model()
    closed.friction.raw_coulomb.data[:] = math.log(2)
    near(closed.coulomb, 2 * closed.friction.nominal)
    assert closed.inertial_parameters.shape == (3, 10)


def factors_of_first_stage(ten: Tensor, robot: str) -> Tensor:
    """Return upper triangular factors C, with the pseudo-inertias C C^T of bodies, as in modules of the first release.

    ten: inertial parameters, (bodies, 10). They are rounded to ten digits, as those modules stated them. Link 3 of rpr
    had six digits, since its inertia is at the limit of physical consistency.
    """
    digits = [6 if (robot, index) == ("rpr", 2) else 10 for index in range(len(ten))]
    rounded = [[float(f"{x:.{k}g}") for x in row] for row, k in zip(ten.tolist(), digits, strict=True)]
    pseudo = pseudo_inertia(torch.tensor(rounded, dtype=torch.float64))
    return torch.linalg.cholesky(pseudo.flip(-1, -2)).flip(-1, -2)


def weights_of_first_stage(bodies):
    """Return the log-Cholesky parameters with which the current bodies equal bodies of the first release.

    In the first release, the pseudo-inertia was L T T^T L^T with the lower triangular factor L of the nominal
    pseudo-inertia. All parameters are 0.01 here: the lower triangular T has exp(0.01) on the diagonal and 0.01 below
    it. bodies: `InertialParameters`, which have upper triangular factors instead.
    """
    nominal = bodies.factors @ bodies.factors.mT
    entries = 0.01 * torch.ones(4, 4).double().tril(-1)
    root = torch.linalg.cholesky(nominal) @ (entries + math.exp(0.01) * torch.eye(4).double())
    relative = torch.linalg.solve(bodies.factors, root)
    return log_cholesky_parameters(upper_cholesky(relative @ relative.mT))


def rotation_inputs(joint_types, axes):
    """Return (joint, index, sign, constant) for each input of the networks of the first release.

    The input equals sign * (current input `index`) + constant. joint: index of the position (0 to n - 1) or of the
    velocity (from 2 n) that it depends on. Inputs of a revolute joint were the nine entries of its rotation matrix, now
    cos q and sin q. axes: number of velocity inputs per joint (0: none), of which only the last one is not zero.
    """
    n, inputs = len(joint_types), []
    for joint, kind in enumerate(joint_types):
        cos, sin = (joint, 1.0, 0.0), (n + joint, 1.0, 0.0)
        zero, one = (joint, 0.0, 0.0), (joint, 0.0, 1.0)
        turned = [cos, (n + joint, -1.0, 0.0), zero, sin, cos, zero, zero, zero, one]
        inputs += [(joint, *x) for x in (turned if kind == "revolute" else [zero, zero, cos])]
    for joint in range(n):
        inputs += [(2 * n + joint, 2 * n + joint, float(axis == axes - 1), 0.0) for axis in range(axes)]
    return inputs


def network_of_first_stage(network, inputs, generator):
    """Set the parameters of `network` so that it equals a network of the first release, which had other inputs.

    The parameters of that network are random numbers from `generator`, plus 0.01: the change of all parameters with
    which the numbers of the first release were recorded. inputs: result of `rotation_inputs`.
    """
    sensitivity = network.mask0[0].flatten()
    for index, weight in enumerate(network.weights):
        first = index == 0
        units, below, *grid = weight.shape
        if first:
            below = len(inputs)
        drawn = torch.randn(units, below, *([1] if grid else []), dtype=torch.float64, generator=generator)
        if grid:
            drawn = drawn * torch.linspace(-1, 1, *grid, dtype=torch.float64)
        drawn = drawn / below**0.5
        if index == len(network.weights) - 1:
            drawn = 0 * drawn
        drawn = drawn + 0.01
        if first:
            weight.zero_()
            for (joint, now, sign, constant), column in zip(inputs, drawn.unbind(1), strict=True):
                if sign:
                    # The grid of the KAN's Gaussians is symmetric about 0: at the input -x, they have the values that
                    # they have at x in reverse order.
                    weight[:, now] += column.flip(-1) if grid and sign < 0 else column * (1 if grid else sign)
                elif grid:
                    bumps = torch.exp(-((constant / (2 / 3) - network.grid) ** 2))
                    network.biases[0].add_(sensitivity[joint] * column @ bumps)
                else:
                    network.biases[0].add_(sensitivity[joint] * column * constant)
        else:
            weight.copy_(drawn)


@pytest.mark.parametrize("case", json.loads(NUMBERS.read_text()))
def test_numbers_equal_those_of_the_first_release(case, tmp_path):
    """M and the forward and inverse dynamics equal the numbers that modules of the first release gave.

    Those modules had other parameters and network inputs. The functions above convert their parameters: random ones of
    the same seed, to each of which 0.01 is added.
    """
    robot, preset, _ = case.split()
    design = load_design("closed-form") if preset == "closed-form" else None
    design = design and replace(design, memory="none")
    source = built(robot, preset=preset, design=design, standalone=True)[0]
    for now, first in FIRST_STAGE:
        assert preset != "closed-form" or now in source
        source = source.replace(now, first)
    model = import_source(source, tmp_path / f"{robot}_numbers.py").Model(seed=3)
    generator = torch.Generator().manual_seed(1)
    q, qd, tau = (torch.randn(model.n, generator=generator, dtype=torch.float64) for _ in range(3))
    with torch.no_grad():
        nominal = model.inertial_parameters if preset == "closed-form" else None
        for weight in model.parameters():
            weight += 0.01
        if preset == "closed-form":
            model.bodies.factors.copy_(factors_of_first_stage(nominal, robot))
            model.bodies.raw.copy_(weights_of_first_stage(model.bodies))
        else:
            drawn = torch.Generator().manual_seed(3)
            axes = 3 if preset == "phnode" else 1
            inputs, moving = (rotation_inputs(model.joint_types, axes=x) for x in (0, axes))
            network_of_first_stage(model.mass.network, inputs, drawn)
            network_of_first_stage(model.potential, inputs, drawn)
            network_of_first_stage(model.friction.network, moving, drawn)
            if preset == "phnode":
                network_of_first_stage(model.input_network, inputs, drawn)
        found = {
            "mass_matrix": model.mass_matrix(q).diagonal(),
            "inverse_dynamics": model.inverse_dynamics(q, qd, tau),
            "forward_dynamics": model.forward_dynamics(q, qd, tau),
        }
    for name, expected in json.loads(NUMBERS.read_text())[case].items():
        near(found[name], torch.tensor(expected, dtype=torch.float64), 1e-12)


def test_every_parameter_has_a_kind():
    """Each parameter of each preset belongs to a group, by which fits, exports and reports find it.

    A parameter without a group would be treated as one of networks.
    """
    networks = (
        "network.",
        "residuals.mass.",
        "potential.",
        "friction.weight",
        "friction.bias",
        "friction.out",
        "friction.offset",
    )
    for preset in PRESET_NAMES:
        model = build(arm_of("rpr"), preset)
        table = parameter_table(model)
        assert list(table)[: len(list(model.parameters()))] == [name for name, _ in model.named_parameters()]
        for name, info in table.items():
            assert (info.kind == "network") == any(part in name for part in networks), name
    assert parameters_of_kind(build(arm_of("rpr"), "hybrid"), "bodies", "friction_compensation") == (
        "bodies.raw",
        "raw_friction_compensation",
    )
    assert table["friction.network.weights.0"].kind == "network"


@pytest.mark.parametrize("preset", ["closed-form", "minimal"])
def test_invalid_states_are_refused_with_a_remedy(preset):
    """The methods of a model refuse NumPy arrays, tensors that are not float64, and inconsistent shapes.

    The error states the expected type or shape.
    """
    model = build(arm_of("rpr"), preset)
    q = draw(5, 3)
    for call in (model.inverse_dynamics, model.forward_dynamics):
        with pytest.raises(TypeError, match=r"got ndarray, expected a torch.float64 tensor: .*as_tensor\("):
            call(q.numpy(), q.numpy(), q.numpy())
        with pytest.raises(TypeError, match=r"got torch.float32, expected a torch.float64 tensor"):
            call(q, q.float(), q)
        with pytest.raises(
            ValueError,
            match=r"got shapes \(5, 3\) and \(3,\) and \(5, 3\), expected the same shape \(..., 3\)",
        ):
            call(q, q[0], q)
        with pytest.raises(ValueError, match=r"got shapes \(5, 2\) and"):
            call(q[:, :2], q, q)
    with pytest.raises(TypeError, match="got list"):
        model.mass_matrix([0.0, 0.0, 0.0])
    with pytest.raises(ValueError, match=r"got shapes \(3,\) and \(2,\)"):
        model(torch.zeros(()), draw(5))
