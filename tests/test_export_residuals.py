"""Residual terms of hybrid models are exported if they are not zero, and omitted if they are zero."""

import shutil

import numpy as np
import pytest
import torch
from exported_runs import arm_of, moved_model

from spelgen.emission.build import build
from spelgen.exporting.c_export import called_by_c, compile_library
from spelgen.exporting.c_source import c_functions, c_texts, write_c
from spelgen.exporting.casadi_export import called_by_state, casadi_functions
from spelgen.exporting.describe import Trained, describe
from spelgen.exporting.parity import ENTRY_POINTS, check_parity

needs_gcc = pytest.mark.skipif(shutil.which("gcc") is None, reason="no gcc on this machine")
ENTRIES = {name: entry for name, entry in ENTRY_POINTS.items() if name != "servo_torque"}
PARTS = {
    "springs": "residuals.raw_torque_splines",
    "ripple": "residuals.raw_torque_ripple",
    "friction": "residuals.raw_friction_splines",
    "constants": "residuals.raw_constants",
    "mass": "residuals.mass.",
    "potential": "residuals.potential.",
}
RESIDUALS = "residuals."


def with_parts(robot, *parts):
    """Return a hybrid model with random parameters of bodies, drives and the residual terms that `parts` names."""
    model, moved = build(arm_of(robot), "hybrid"), moved_model(robot, "hybrid")
    names = tuple(PARTS[part] for part in parts)
    with torch.no_grad():
        for name, parameter in model.named_parameters():
            if name.startswith(names) or not name.startswith(RESIDUALS):
                parameter.copy_(moved.get_parameter(name))
    return model.requires_grad_(False)


def closed_form(model, robot):
    """Return the closed-form model of an arm with the inertial, friction and armature parameters of `model`.

    model: hybrid model of the arm, whose residual terms are omitted. robot: name of the arm, such as "rpr".
    """
    found = build(arm_of(robot), "closed-form").requires_grad_(False)
    found.load_state_dict(
        {key: value for key, value in model.state_dict().items() if key in found.state_dict()}
    )
    return found


def c_library(model, folder):
    """Compile the C of a model; return the function that calls its entry points."""
    functions = c_functions(model, ENTRIES)
    return called_by_c(compile_library(write_c(model, functions, folder), "gcc"), functions)


def test_zero_terms_are_omitted():
    """Without residual terms the C of a hybrid model equals the C of the closed-form model, byte for byte."""
    model = with_parts("rpr")
    ours = describe(model, arm_of("rpr"))
    other = describe(closed_form(model, "rpr"), arm_of("rpr"))
    assert not ours.residuals
    text, plain = (c_texts(each, c_functions(each, ENTRIES))[".c"] for each in (ours, other))
    assert text == plain


@needs_gcc
@pytest.mark.parametrize(
    "parts",
    [
        ["springs"],
        ["ripple"],
        ["friction"],
        ["mass", "constants"],
        ["potential"],
    ],
    ids="-".join,
)
def test_each_term_is_exported_by_itself(parts, tmp_path):
    """A single residual term is exported correctly, without unused functions or tables, which the compiler rejects."""
    trained = Trained(with_parts("scara", *parts), arm_of("scara"))
    model, names = trained.described, list(ENTRIES)
    check_parity(c_library(model, tmp_path), trained, names, 1e-12, states=20)
    casadi = called_by_state(casadi_functions(model, ENTRIES))
    check_parity(casadi, trained, names, 1e-12, states=20)


@needs_gcc
@pytest.mark.parametrize("name", ENTRIES)
def test_a_single_entry_is_exported_by_itself(name, tmp_path):
    """An export of a single entry has no function that only other entries call, which would be a compiler warning."""
    model = with_parts("rpr", *PARTS)
    described = describe(model, arm_of("rpr"))
    functions = c_functions(described, {name: ENTRIES[name]})
    compile_library(write_c(described, functions, tmp_path), "gcc")


def test_a_function_of_one_joint_is_exported_at_this_joint():
    model = with_parts("scara")
    functions = model.residuals
    functions.raw_torque_splines[1, 20] = 1.0
    # Amplitude k is of the cosine with k + 1 periods per revolution of the joint, up to k = 63. Amplitudes 64 and 65
    # are of the motor, with 80 (the gear ratio) and 160 periods. Set here: 3 periods (k = 2) and 160 (k = 65).
    functions.raw_torque_ripple[0, [2, 65]] = torch.tensor([1.0, 2.0], dtype=torch.float64)
    # a prismatic joint has no revolutions, and so no ripple is exported
    functions.raw_torque_ripple[2, 3] = 1.0
    found = describe(model, arm_of("scara")).residuals
    assert (list(found.torque), list(found.friction)) == ([1], [])
    assert [(each.joint, each.frequency, len(each.cosines)) for each in found.ripple] == [
        (0, 1, 3),
        (0, 80, 2),
    ]


@needs_gcc
def test_splines_at_their_ends_and_beyond(tmp_path):
    """C and CasADi equal torch on the knots of splines, at the end of the range and far outside of it."""
    model = with_parts("two_link", "springs", "friction")
    described, functions = describe(model, arm_of("two_link")), model.residuals
    center, spacing = functions.middles.mean(dim=1), functions.spacing.flatten()
    knots = center + spacing * torch.arange(-19.5, 20, 0.5, dtype=torch.float64)[:, None]
    q = torch.cat([knots, torch.tensor([[50.0, -50.0], [1e6, -1e6]], dtype=torch.float64)]).contiguous()
    inputs = {key: 0 * q.numpy() + 0.3 for key in ("qd", "qdd")} | {
        "q": q.numpy(),
        "z": np.zeros((len(q), 12)),
    }
    expected = model.inverse_dynamics(q, 0 * q + 0.3, 0 * q + 0.3, torch.zeros(len(q), 2, 6)).numpy()
    still = model.gravity(q).numpy()
    casadi = called_by_state(
        casadi_functions(described, {x: ENTRIES[x] for x in ("inverse_dynamics", "gravity", "energy")})
    )
    compiled = c_library(described, tmp_path)
    for called in (compiled, casadi):
        np.testing.assert_allclose(called("inverse_dynamics", inputs)["tau"], expected, rtol=1e-9, atol=1e-9)
        np.testing.assert_allclose(called("gravity", inputs)["gravity"], still, rtol=1e-9, atol=1e-9)
        energy = called("energy", inputs)["energy"][:, 1]
        np.testing.assert_allclose(energy, model.potential_energy(q).numpy(), rtol=1e-9, atol=1e-9)
