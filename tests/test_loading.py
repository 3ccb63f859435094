"""A module is loaded from its file or its text; text that is no emitted module is refused."""

from pathlib import Path

import pytest
import torch

from spelgen.emission.build import build
from spelgen.emission.loading import load_module
from spelgen.errors import ModuleError

ROBOTS = Path(__file__).parents[1] / "robots"
STAND_IN = Path(__file__).parent / "planar_model.py"


def test_a_file_and_its_text_give_the_same_model():
    source = STAND_IN.read_text(encoding="utf-8")
    models = [load_module(STAND_IN), load_module(str(STAND_IN)), load_module(source)]
    for model in models:
        assert model.source == source
        assert (model.facts.robot, model.joint_names) == ("stand_in", ("shoulder", "elbow"))
        assert torch.equal(model.inertia, models[0].inertia)
    assert not torch.equal(load_module(source, seed=1).inertia, models[0].inertia)


def test_a_traceback_shows_the_text_of_a_module_in_memory():
    model = load_module(STAND_IN.read_text(encoding="utf-8"))
    with pytest.raises(AttributeError) as caught:
        model.gravity(None)
    assert "torque = " in str(caught.traceback[-1].statement)


def test_what_is_no_module_is_refused(tmp_path):
    path = tmp_path / "module.py"
    with pytest.raises(ModuleError) as caught:
        load_module(path)
    assert str(caught.value) == f"{path}: no such file; build it with `spelgen build`"
    path.write_text("x = 1\n")
    with pytest.raises(ModuleError, match=r"got no facts of spelgen in it \(StopIteration\)"):
        load_module(path)
    facts = STAND_IN.read_text().split("class Model")[0]
    path.write_text(
        f"{facts}\nclass Model(nn.Module):\n    n = 1\n    def __init__(self, seed): super().__init__()\n"
    )
    with pytest.raises(ModuleError, match="got a class Model without joint_names, joint_types, mass_matrix"):
        load_module(path)
    path.write_text(f"{facts}\n1 / 0\n")
    message = r"import fails \(ZeroDivisionError: division by zero\); build it again"
    with pytest.raises(ModuleError, match=message):
        load_module(path)
    with pytest.raises(ModuleError, match=f"^{message}"):
        load_module(f"{facts}\n1 / 0\n")


def test_two_modules_of_the_same_name_do_not_meet(tmp_path):
    for folder, n in (("a", 3), ("b", 4)):
        (tmp_path / folder).mkdir()
        text = STAND_IN.read_text().replace("    n = 2\n", f"    n = {n}\n")
        (tmp_path / folder / "module.py").write_text(text)
    models = [load_module(tmp_path / folder / "module.py") for folder in ("a", "b")]
    assert [model.n for model in models] == [3, 4]
    assert not list(tmp_path.rglob("__pycache__"))


def test_a_model_is_shown_in_a_line_and_as_its_structure():
    model = build(ROBOTS / "rpr.urdf")
    count = sum(parameter.numel() for parameter in model.parameters())
    assert repr(model) == f"<Model of 'rpr' (hybrid): 3 joints, {count} parameters>"
    assert "2,3\n    3    C\n    2,3  .    C" in model._repr_html_()
    assert repr(build(ROBOTS / "rpr.urdf", preset="closed-form")).startswith(
        "<Model of 'rpr' (closed-form): "
    )


def test_a_module_written_before_says_what_to_rebuild(tmp_path):
    path = tmp_path / "module.py"
    text = STAND_IN.read_text(encoding="utf-8")
    line = '  "format": 8,\n'
    assert line in text
    path.write_text(text.replace(line, ""), encoding="utf-8")
    with pytest.raises(ModuleError) as caught:
        load_module(path)
    assert str(caught.value) == (
        f"{path}: got a module of another version of spelgen, expected a module written by this version of"
        " `spelgen build`; build it again from stand_in.urdf with `spelgen build`, and train it again"
    )
