"""The input matrix G from transmissions, gears and couplings is right in report, simulation, module and training."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from emitted import import_source, randomise
from typer.testing import CliRunner

from spelgen.arm.configured_arm import load_arm
from spelgen.certificate.inspection import inspect
from spelgen.cli.main import app
from spelgen.dynamics.pinocchio_arm import arm_dynamics
from spelgen.dynamics.pinocchio_dynamics import urdf_dynamics
from spelgen.emission.specify import generate
from spelgen.errors import SettingsError, SpelgenError
from spelgen.fitting.rollout import loss_scales, momentum_loss, roll_out
from spelgen.logs.windows import Windows
from spelgen.simulation.protocol import make_friction
from spelgen.simulation.simulate import random_inputs

pytest.importorskip("pinocchio")

WRIST = (("j1", (("m1", 100.0),), "Simple"), ("pitch roll", (("m2", 60.0), ("m3", 60.0)), "Differential"))


def urdf(folder, *transmissions, sidecar=""):
    """Write the URDF of an arm with three turning joints (j1, pitch, roll) and transmissions; return its path.

    transmissions: for each, the names of its joints, (name, gear ratio) of each of its actuators, and its type, such as
    "Differential". sidecar: text of the settings file.
    """
    inertial = (
        '<inertial><origin xyz="0.2 0 0"/><mass value="2"/>'
        '<inertia ixx="0.02" iyy="0.03" izz="0.04" ixy="0" ixz="0" iyz="0"/></inertial>'
    )
    names = ("j1", "pitch", "roll")
    links = '<link name="l0"/>' + "".join(f'<link name="l{i}">{inertial}</link>' for i in (1, 2, 3))
    joints = "".join(
        f'<joint name="{name}" type="revolute"><parent link="l{i}"/><child link="l{i + 1}"/>'
        f'<origin xyz="{0.4 if i else 0} 0 0"/><axis xyz="{axis}"/>'
        '<limit lower="-2" upper="2" effort="9" velocity="3"/></joint>'
        for i, (name, axis) in enumerate(zip(names, ("0 1 0", "0 1 0", "1 0 0"), strict=True))
    )
    drives = "".join(
        f'<transmission name="t{i}"><type>transmission_interface/{kind}Transmission</type>'
        + "".join(f'<joint name="{name}"/>' for name in driven.split())
        + "".join(
            f'<actuator name="{name}"><mechanicalReduction>{value}</mechanicalReduction></actuator>'
            for name, value in actuators
        )
        + "</transmission>"
        for i, (driven, actuators, kind) in enumerate(transmissions)
    )
    path = folder / "arm.urdf"
    path.write_text(f'<robot name="arm">{links}{joints}{drives}</robot>')
    path.with_suffix(".yaml").write_text(sidecar)
    return path


def inputs(path):
    """Return {(row, column): (kind, value)} of the entries of the input matrix G that are not always zero.

    Rows and columns are counted from 1. value: joint torque per input. kind: "fixed"; "coupled" for motors that drive
    several joints; "gain" for a trained entry, with its initial value. path: a URDF.
    """
    found = inspect(path).to_dict()["input_matrix"]["entries"]
    assert len(found) == 9
    return {(x["row"], x["col"]): (x["kind"], x["value"]) for x in found if x["kind"] != "zero"}


MOTOR = "torque: motor\n"
COUPLED = MOTOR + "couplings:\n- {joints: [pitch, roll], matrix: [[50, 0], [-10, 40]]}\n"


@pytest.mark.parametrize(
    ("transmissions", "sidecar", "expected"),
    [
        # by default, logged torques are joint torques: gears have no effect, and G is the identity, except that
        # the diagonal entry of a passive joint is zero
        (WRIST, "", {(i, i): ("fixed", 1.0) for i in (1, 2, 3)}),
        (WRIST, "joints: {roll: {actuated: false}}", {(i, i): ("fixed", 1.0) for i in (1, 2)}),
        (
            WRIST,
            MOTOR,
            {
                (1, 1): ("fixed", 100.0),
                (2, 2): ("coupled", 60.0),
                (2, 3): ("coupled", 60.0),
                (3, 2): ("coupled", 60.0),
                (3, 3): ("coupled", -60.0),
            },
        ),
        # the coupling in the settings has precedence over the URDF's; j1 has a gear in neither: its gain is trained
        (
            WRIST[1:],
            COUPLED,
            {
                (1, 1): ("gain", 1.0),
                (2, 2): ("coupled", 50.0),
                (3, 2): ("coupled", -10.0),
                (3, 3): ("coupled", 40.0),
            },
        ),
        (
            WRIST[:1],
            MOTOR + "joints: {j1: {gear: 80, gain: trained}, pitch: {gear: 50}, roll: {actuated: false}}",
            {(1, 1): ("gain", 80.0), (2, 2): ("fixed", 50.0)},
        ),
    ],
)
def test_the_kinds_of_entries(tmp_path, transmissions, sidecar, expected):
    assert inputs(urdf(tmp_path, *transmissions, sidecar=sidecar)) == expected


def test_actuation_is_reported(tmp_path):
    told = CliRunner().invoke(app, ["inspect", str(urdf(tmp_path, *WRIST[1:], sidecar=MOTOR))]).output
    (line,) = [x for x in told.splitlines() if x.split()[:1] == ["G"]]
    assert line.split("G", 1)[1].strip() == "motor torques, gain trained at joint 1, coupled at joints 2,3"


def test_a_joint_without_a_transmission_is_reported(tmp_path):
    (found,) = [x for x in inspect(urdf(tmp_path, *WRIST[1:])).diagnostics if x.code == "no-transmission"]
    assert found.where == "joint 'j1'"


WRONG = {
    MOTOR + "couplings:\n- {joints: [pitch, rol], matrix: [[1, 0], [0, 1]]}\n": (
        "arm.yaml:3: couplings.0.joints: unknown joint 'rol'; did you mean 'roll'?"
    ),
    MOTOR + "couplings:\n- {joints: [pitch, roll], matrix: [[1, 2], [2, 4]]}\n": (
        "arm.yaml:3: couplings.0: got {'joints': ['pitch', 'roll'], 'matrix': [[1, 2], [2, 4]]}, expected a "
        "matrix with an inverse: as many independent motors as joints"
    ),
    MOTOR + "couplings:\n- {joints: [pitch, roll], matrix: [[1, 2]]}\n": (
        "arm.yaml:3: couplings.0: got {'joints': ['pitch', 'roll'], 'matrix': [[1, 2]]}, expected as many "
        "rows, and as many numbers in each, as joints"
    ),
    COUPLED + "- {joints: [j1, roll], matrix: [[1, 0], [0, 1]]}\n": (
        "arm.yaml:1: got these settings, expected the joint 'roll' once in all couplings"
    ),
    COUPLED + "joints: {roll: {actuated: false}}": (
        "arm.yaml:1: got these settings, expected the joint 'roll' coupled to motors or 'actuated: false', "
        "not both"
    ),
}


@pytest.mark.parametrize("sidecar", WRONG)
def test_wrong_couplings_are_refused(tmp_path, monkeypatch, sidecar):
    monkeypatch.chdir(tmp_path)
    urdf(tmp_path, sidecar=sidecar)
    with pytest.raises(SpelgenError) as error:
        load_arm("arm.urdf")
    assert str(error.value) == WRONG[sidecar]


def test_a_coupling_of_a_locked_joint_is_refused(tmp_path):
    with pytest.raises(SettingsError, match="got the joint 'roll', which is locked, expected joints of"):
        load_arm(urdf(tmp_path, sidecar=COUPLED), joints=["j1", "pitch"])


@pytest.fixture
def coupled(tmp_path):
    """Return the URDF and the emitted model of an arm with a known gear, a trained gain and couplings of motors."""
    path = urdf(tmp_path, sidecar=COUPLED + "joints: {j1: {gear: 80, gain: trained}}")
    model = import_source(generate(path), tmp_path / "arm_spel.py").Model(seed=1)
    randomise(model, 1)
    return path, model


G = torch.tensor([[80.0, 0, 0], [0, 50, 0], [0, -10, 40]], dtype=torch.float64)


def states(count=40):
    random = torch.Generator().manual_seed(3)
    return torch.randn(4, count, 3, dtype=torch.float64, generator=random)


class TestModule:
    def test_dynamics_both_ways(self, coupled):
        model = coupled[1]
        model.inputs.raw_gains.data.fill_(np.log(1.25))
        q, qd, _, tau = states()
        expected = G.clone()
        expected[0, 0] = 100
        assert torch.allclose(model.input_matrix(q), expected.expand(40, 3, 3), rtol=1e-14)
        qdd = model.forward_dynamics(q, qd, tau)
        assert torch.allclose(model.inverse_dynamics(q, qd, qdd), tau, rtol=0, atol=1e-10)
        p, none = model.momentum(q, qd), torch.zeros_like(tau)
        prepared = model.prepare()
        pushed, free = (model.port_hamiltonian_rhs(q, p, each, prepared)[1] for each in (tau, none))
        assert torch.allclose(pushed - free, tau @ expected.T, rtol=0, atol=1e-9)

    def test_the_gain_has_a_gradient(self, coupled):
        q, qd, _, tau = states()
        coupled[1].forward_dynamics(q, qd, tau).square().sum().backward()
        assert coupled[1].inputs.raw_gains.grad.abs().min() > 0

    def test_a_passive_joint_has_no_input(self, tmp_path):
        path = urdf(tmp_path, sidecar=MOTOR + "joints: {j1: {gear: 9}, roll: {actuated: false}}")
        model = import_source(generate(path), tmp_path / "passive_spel.py").Model(seed=1)
        q, qd, _, tau = states()
        qdd = model.forward_dynamics(q, qd, tau)
        assert torch.equal(qdd, model.forward_dynamics(q, qd, tau * torch.tensor([1.0, 1, 0])))
        back = model.inverse_dynamics(q, qd, qdd)
        assert torch.allclose(back[:, :2], tau[:, :2], atol=1e-10)
        assert back[:, 2].abs().max() < 1e-10


def test_the_simulation_moves_joints_by_motors(coupled):
    """Simulated logs contain motor torques: the rigid bodies move under G times these torques, minus the friction.

    G is the input matrix, joint torque per motor torque.
    """
    loaded = load_arm(coupled[0])
    short = {"trajectories": 2, "duration": 0.5, "rate": 20.0}
    settings = loaded.settings.model_copy(
        update={"simulation": loaded.settings.simulation.model_copy(update=short)}
    )
    assert np.array_equal(loaded.actuation.matrix(), G.numpy())
    drives = loaded.actuation.drives()
    log = random_inputs(loaded.chain, settings, drives).train[0]
    engine, friction = (
        arm_dynamics(loaded.chain, settings),
        make_friction(loaded.chain, settings, drives.speeds),
    )
    q, qd = log.q[0], log.qd[0]
    for _ in range(5000):  # explicit Euler over the first sampling interval, in steps of 10 us
        qdd = engine.forward_dynamics(q, qd, G.numpy() @ log.tau[0] - friction(qd))
        q, qd = q + 1e-5 * qd, qd + 1e-5 * qdd
    assert np.abs(q - log.q[1]).max() < 1e-2 * np.abs(log.q[1] - log.q[0]).max()
    assert np.abs(qd - log.qd[1]).max() < 1e-2 * np.abs(log.qd[1]).max()


def test_the_urdfs_dynamics_have_the_same_motors(coupled):
    baseline = urdf_dynamics(coupled[0], ["j1", "pitch", "roll"])
    q, qd, _, tau = states()
    qdd = baseline.forward_dynamics(q, qd, tau)
    assert torch.allclose(baseline.inverse_dynamics(q, qd, qdd), tau, rtol=0, atol=1e-9)
    loaded = load_arm(coupled[0])
    # rigid bodies without friction, as the URDF states none
    engine = arm_dynamics(loaded.chain, loaded.settings)
    wanted = [
        engine.forward_dynamics(q[i].numpy(), qd[i].numpy(), G.numpy() @ tau[i].numpy())
        for i in range(len(q))
    ]
    assert np.allclose(qdd.numpy(), wanted, rtol=0, atol=1e-9)


def test_a_gain_is_recovered(coupled):
    """A trained gain of initially 80 becomes the true 100 in a fit in which all other parameters are known."""
    model = coupled[1]
    model.inputs.raw_gains.data.fill_(np.log(1.25))
    start, speed, tau, _ = states(200)
    still = Windows(
        q=start[:, None].expand(-1, 5, -1),
        qd=0.1 * speed[:, None].expand(-1, 5, -1),
        tau=0.01 * tau[:, None].expand(-1, 4, -1),
        dt=torch.full((200, 4), 2e-3, dtype=torch.float64),
    )
    with torch.no_grad():
        q, qd = roll_out(model, still, 4)
    moved = replace(
        still, q=torch.cat([still.q[:, :1], q], dim=1), qd=torch.cat([still.qd[:, :1], qd], dim=1)
    )
    model.inputs.raw_gains.data.zero_()
    scales = loss_scales(moved, model.joint_types)
    optimizer = torch.optim.LBFGS([model.inputs.raw_gains], line_search_fn="strong_wolfe")

    def closure():
        optimizer.zero_grad()
        loss = momentum_loss(model, moved, scales)
        loss.backward()
        return loss

    optimizer.step(closure)
    assert model.inputs.raw_gains.exp().item() == pytest.approx(1.25, rel=1e-3)
