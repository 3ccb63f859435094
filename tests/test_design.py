"""Each combination of design options gives a working model, or is refused with the two options in conflict."""

import itertools
from dataclasses import asdict, replace
from typing import get_args

import pytest
import torch

from spelgen.arm.configured_arm import load_arm
from spelgen.certificate.module_check import check
from spelgen.design import CHOICES, PRESETS, Design, Preset, load_design
from spelgen.emission.assemble import load_module
from spelgen.emission.build import build
from spelgen.emission.specify import generate
from spelgen.errors import SettingsError, SpelgenError

COMBINATIONS = [dict(zip(CHOICES, values, strict=True)) for values in itertools.product(*CHOICES.values())]


@pytest.fixture(scope="module")
def rpr(robots):
    return load_arm(robots / "rpr.urdf")


def made(values):
    try:
        return Design(**values)
    except SpelgenError:
        return None


def test_a_refused_combination_names_the_two_options():
    refused = [values for values in COMBINATIONS if made(values) is None]
    for values in refused:
        with pytest.raises(SpelgenError) as error:
            Design(**values)
        for line in str(error.value).splitlines():
            first, _, rest = line.partition(" with ")
            second = rest.partition(";")[0]
            named = dict(part.split(": ") for part in (first, second))
            assert len(named) == 2 and named.items() <= values.items()
    # accepted: 96 designs of networks only; 4 of rigid bodies, with or without friction state, with or without networks
    assert len(COMBINATIONS) - len(refused) == 96 + 2 * 2


@pytest.mark.parametrize("mass", CHOICES["mass"])
@pytest.mark.parametrize("dissipation", CHOICES["dissipation"])
def test_every_other_combination_is_a_model(rpr, mass, dissipation):
    generator = torch.Generator().manual_seed(0)
    q, qd, tau = torch.rand(3, 5, 3, dtype=torch.float64, generator=generator)
    for values in COMBINATIONS:
        design = made(values) if (values["mass"], values["dissipation"]) == (mass, dissipation) else None
        if design is None:
            continue
        model = build(rpr, design, width=8)
        qdd = model.forward_dynamics(q, qd, tau)
        assert (model.inverse_dynamics(q, qd, qdd) - tau).abs().max() < 1e-8, values
        assert torch.linalg.eigvalsh(model.mass_matrix(q)).min() > 0, values
        assert torch.linalg.eigvalsh(model.dissipation(q, qd)).min() > -1e-12, values
        model(torch.zeros(()), torch.cat([q, qd, tau], dim=-1)).square().sum().backward()
        assert all(each.grad is None or each.grad.isfinite().all() for each in model.parameters()), values


@pytest.mark.parametrize("preset", get_args(Preset))
def test_presets_are_the_files(preset):
    assert {path.stem for path in PRESETS.glob("*.yaml")} == set(get_args(Preset))
    design = load_design(preset)
    assert load_design(PRESETS / f"{preset}.yaml") == design == load_design(design)


def test_a_preset_of_your_own(rpr, robots, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    own = asdict(load_design("spel")) | {"dissipation": "dense-3n", "about": "Friction of all joints."}
    (tmp_path / "mine.yaml").write_text("".join(f"{key}: {value}\n" for key, value in own.items()))
    source = generate(rpr, "mine.yaml")
    options = load_module(source).spec.options
    assert (options.preset, options.design.dissipation) == ("mine", "dense-3n")
    (tmp_path / "module.py").write_text(source, encoding="utf-8")
    # the module states its own design, so that the file of the preset is not needed
    (tmp_path / "mine.yaml").unlink()
    assert check(tmp_path / "module.py", robots / "rpr.urdf").reasons == ()


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"memory": "all"}, "mine.yaml:5: memory: got 'all', expected one of bristles, none"),
        ({"memory": ["none"]}, "mine.yaml:5: memory: got ['none'], expected one of bristles, none"),
        ({"masss": "none"}, "mine.yaml:8: unknown key 'masss'; did you mean 'mass'?"),
        ({"net": None}, "mine.yaml:6: net: got None, expected one of mlp, kan, none"),
        (
            {"mass": "derived"},
            "mine.yaml:1: mass: derived with potential: closed-form; rigid bodies give both: name closed-form for "
            "both or for neither",
        ),
    ],
)
def test_a_wrong_preset_is_reported_with_its_line(tmp_path, monkeypatch, change, message):
    monkeypatch.chdir(tmp_path)
    values = asdict(load_design("hybrid")) | change
    text = "".join(f"{key}: {'null' if value is None else value}\n" for key, value in values.items())
    (tmp_path / "mine.yaml").write_text(text)
    with pytest.raises(SpelgenError) as error:
        load_design("mine.yaml")
    assert str(error.value).splitlines()[0] == message


def test_an_unknown_preset_names_the_presets():
    with pytest.raises(SettingsError) as error:
        load_design("minmal")
    expected = "hybrid, closed-form, minimal, spel, spel-kan, phnode, or a YAML file"
    assert str(error.value) == f"got the preset 'minmal', expected one of {expected}"
    with pytest.raises(SettingsError, match="mass: closed-form with net: kan; residual networks"):
        replace(load_design("hybrid"), net="kan")
