"""A model that is assembled in memory equals the model of a thin module and the model of a standalone module.

A thin module imports spelgen.runtime, a standalone module contains its code.
"""

from dataclasses import replace
from functools import cache

import pytest
import torch
from emitted import ROBOTS, SIX, import_source, randomise

from spelgen.design import PRESET_NAMES
from spelgen.emission.assemble import assemble
from spelgen.emission.specify import make_spec
from spelgen.emission.text import module_text
from spelgen.errors import ModuleError
from spelgen.spec import ModelSpec, spec_from_json

each_case = pytest.mark.parametrize(
    ("preset", "robot"), [(preset, robot) for preset in PRESET_NAMES for robot in SIX]
)


@cache
def spec_of(robot: str, preset: str) -> ModelSpec:
    return make_spec(ROBOTS / f"{robot}.urdf", preset)


@each_case
def test_three_forms_of_a_model_are_equal_to_the_bit(robot, preset, tmp_path):
    """Three forms of a model have bitwise equal initial parameters and, for equal random parameters, equal dynamics.

    The forms: assembled in memory, a thin module that imports spelgen.runtime, and a standalone module.
    """
    spec = spec_of(robot, preset)
    models = {"assembled": assemble(spec, seed=3)}
    for standalone in (False, True):
        path = tmp_path / f"{robot}_{standalone}.py"
        source = module_text(spec, standalone=standalone)
        models[path.stem] = import_source(source, path).Model(seed=3)
    generator = torch.Generator().manual_seed(0)
    q, qd, qdd = torch.randn(3, 7, len(spec.joints), dtype=torch.float64, generator=generator)
    found = {}
    for name, model in models.items():
        initial = {key: value.clone() for key, value in model.state_dict().items()}
        randomise(model, seed=5)
        with torch.no_grad():
            found[name] = initial, model.inverse_dynamics(q, qd, qdd), model.forward_dynamics(q, qd, qdd)
    expected_weights, *expected = found.pop("assembled")
    for name, (weights, *dynamics) in found.items():
        assert list(weights) == list(expected_weights)
        for key, value in weights.items():
            assert torch.equal(value, expected_weights[key]), (name, key)
        for ours, reference in zip(dynamics, expected, strict=True):
            assert reference.isfinite().all()
            assert torch.equal(ours, reference), name


@each_case
def test_a_specification_is_its_json(robot, preset):
    spec = spec_of(robot, preset)
    text = spec.to_json()
    again = spec_from_json(text)
    assert again == spec
    assert again.to_json() == text
    assert again.sha256 == spec.sha256
    assert 1_000 < len(text) < 9_000
    assert text.isascii() and "\n" not in text


def test_the_seed_draws_the_weights_of_networks():
    spec = spec_of("rpr", "hybrid")
    first, same, other = (assemble(spec, seed=seed).state_dict() for seed in (0, 0, 1))
    name = "residuals.mass.weights.0"
    assert torch.equal(first[name], same[name]) and not torch.equal(first[name], other[name])


def test_a_specification_of_no_model_is_refused():
    """A specification of an arm that cannot exist, such as one with a negative mass, is refused by a one-line error."""
    spec = spec_of("rpr", "closed-form")
    link = spec.links[1]
    for change in ({"mass": -1.0}, {"inertia": (1.0, 0.0, 0.0, 1.0, 0.0, 3.0)}):
        broken = replace(spec, links=(spec.links[0], replace(link, **change), spec.links[2]))
        with pytest.raises(ModuleError, match="a specification of no model") as caught:
            assemble(broken)
        assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    "change",
    [
        {"potential": (3,)},
        {"joints": ()},
        {"motor_speeds": ((1.0,),)},
        {"entries": ((0, 0, "varying", (9,)),)},
    ],
    ids=lambda change: next(iter(change)),
)
def test_indices_of_a_specification_are_checked(change):
    with pytest.raises(ModuleError, match="indices contradict each other"):
        replace(spec_of("rpr", "closed-form"), **change)
