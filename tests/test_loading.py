"""Modules are read, never executed; text that `spelgen build` did not write is refused."""

import json
import sys
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from emitted import built, printed_without_structure
from planar_model import write_module

from spelgen.emission.assemble import load_module
from spelgen.emission.build import build
from spelgen.emission.text import module_text, read_spec
from spelgen.errors import ModuleError

ROBOTS = Path(__file__).parents[1] / "robots"
REMEDY = "expected a module written by this version of `spelgen build`; build it again"


@pytest.fixture
def module(tmp_path) -> Path:
    return write_module(tmp_path)


def refusal(path: Path | str) -> str:
    with pytest.raises(ModuleError) as caught:
        load_module(path)
    return str(caught.value)


def test_a_file_and_its_text_give_the_same_model(module):
    text = module.read_text(encoding="utf-8")
    models = [load_module(module), load_module(str(module)), load_module(text)]
    for model in models:
        assert (model.spec.robot, model.joint_names) == ("planar", ("shoulder", "elbow"))
        assert model.spec == read_spec(module)
        for name, weight in model.state_dict().items():
            assert torch.equal(weight, models[0].state_dict()[name])
    name = "potential.weights.0"
    assert not torch.equal(load_module(text, seed=1).state_dict()[name], models[0].state_dict()[name])


def test_both_forms_give_the_same_specification(tmp_path):
    specs = []
    for standalone in (False, True):
        path = tmp_path / f"{standalone}.py"
        path.write_text(built("rpr", standalone=standalone)[0], encoding="utf-8")
        specs.append(load_module(path).spec)
    assert specs[0] == specs[1]


def test_line_ends_of_another_system_are_accepted(module):
    module.write_bytes(module.read_bytes().replace(b"\n", b"\r\n"))
    assert load_module(module).n == 2


@pytest.mark.parametrize("standalone", [False, True])
@pytest.mark.parametrize("edit", ["append", "insert", "number"])
def test_an_edited_module_is_refused_and_not_executed(tmp_path, standalone, edit):
    """A module with an added statement or a changed number is refused, and its code is not executed."""
    path, mark = tmp_path / "module.py", tmp_path / "mark"
    text = built("rpr", standalone=standalone)[0]
    effect = f"open({str(mark)!r}, 'w').close()\n"
    changed = {
        "append": text + effect,
        "insert": text.replace("\nimport torch\n", f"\nimport torch\n{effect}", 1),
        "number": text.replace("mass=5.01", "mass=5.02", 1),
    }[edit]
    assert changed != text
    path.write_text(changed, encoding="utf-8")
    message = (
        f"got a module that was edited, or written by another version of spelgen, {REMEDY}, or use the edited one "
        "from Python: `from MODULE import Model; spelgen.fit(Model(), logs)`"
    )
    assert refusal(path) == f"{path}: {message}"
    assert refusal(changed) == message
    assert not mark.exists()


def test_the_remedy_for_an_edited_module_works(tmp_path):
    """The advised `from MODULE import Model` gives a model of an edited module that `spelgen.fit` accepts.

    But the fit of an edited module cannot be saved as a run folder.
    """
    import spelgen
    from spelgen.errors import RunError
    from spelgen.settings.fits import Rollout
    from tests.test_training import motions

    path = write_module(tmp_path, "edited.py")
    path.write_text(path.read_text().replace("width=4", "width=5"))
    sys.path.insert(0, str(tmp_path))
    try:
        from edited import Model
    finally:
        sys.path.remove(str(tmp_path))
    model = Model()
    before = torch.cat([x.detach().flatten() for x in model.parameters()])
    found = spelgen.fit(model, motions(), Rollout(epochs=1, momentum_steps=5))
    assert found.epochs == 1
    assert not torch.equal(before, torch.cat([x.detach().flatten() for x in model.parameters()]))
    with pytest.raises(RunError, match="a model without a specification, which a run folder cannot keep"):
        found.save(tmp_path / "run")


def test_what_is_no_module_is_refused(tmp_path):
    path = tmp_path / "module.py"
    assert refusal(path) == f"{path}: no such file; build it with `spelgen build`"
    for text in ("x = 1\n", "1 / 0\n", "def\n", "SPEC = f'{1}'\n", "(" * 10_000, "x = '\0'\n"):
        path.write_text(text)
        assert refusal(path) == f"{path}: got no specification of spelgen in it, {REMEDY}, or check the path"
    path.write_bytes(b"\xff\xfe")
    assert refusal(path).startswith(f"{path}: got no specification of spelgen in it (UnicodeDecodeError)")
    robot = ROBOTS / "rpr.urdf"
    assert refusal(robot).endswith(f"`spelgen build {robot}` writes its module")


def test_a_module_of_an_earlier_version_is_refused_with_a_remedy(module, tmp_path):
    """A module without specification, or with another format number, is refused: it must be built and trained again."""
    old = tmp_path / "old.py"
    old.write_text(f'open({str(tmp_path / "mark")!r}, "w")\nFACTS = """{{"format": 8}}"""\n')
    assert refusal(old) == f"{old}: got no specification of spelgen in it, {REMEDY}, or check the path"
    assert not (tmp_path / "mark").exists()
    text = module.read_text(encoding="utf-8")
    assert text.count('"format":9') == 1
    for version in ("8", "10", '"9"', "null"):
        module.write_text(text.replace('"format":9', f'"format":{version}'), encoding="utf-8")
        shown = version.replace('"', "'").replace("null", "None")
        assert refusal(module) == (
            f"{module}: got a specification of format {shown}, expected 9, of this version; build the module again "
            "with `spelgen build`, and train it again"
        )


def test_a_specification_is_checked_like_any_file(module):
    """A specification with invalid values is refused even if the module's text agrees with it."""
    spec = read_spec(module)
    joint = replace(spec.joints[0], armature=float("nan"))
    module.write_text(module_text(replace(spec, joints=(joint, *spec.joints[1:]))), encoding="utf-8")
    assert "NaN is no number of a specification" in refusal(module)
    content = json.loads(spec.to_json()) | {"mass": 1}
    text = module.read_text(encoding="utf-8").partition('SPEC = r"""')[0]
    module.write_text(f'{text}SPEC = r"""{json.dumps(content)}"""\n', encoding="utf-8")
    assert "got no specification of a model (keys or values of other types)" in refusal(module)


def test_loading_needs_no_symbolic_algebra(module):
    code = "import spelgen.emission.assemble as loading\nprint(loading.load_module(sys.argv[1]).n)"
    assert printed_without_structure(code, module) == "2\n"


def test_a_model_is_shown_in_a_line_and_as_its_structure():
    model = build(ROBOTS / "rpr.urdf")
    count = sum(parameter.numel() for parameter in model.parameters())
    assert repr(model) == f"<Model of 'rpr' (hybrid): 3 joints, {count} parameters>"
    assert "2,3\n     2  3    C\n     3  2,3  0    C" in model._repr_html_()
    assert repr(build(ROBOTS / "rpr.urdf", preset="closed-form")).startswith(
        "<Model of 'rpr' (closed-form): "
    )
