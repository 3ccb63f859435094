"""The settings file: valid values are read, wrong ones are refused with line, expectation and advice."""

import re
import subprocess
import sys

import numpy as np
import pytest
from pydantic import ValidationError
from typer.testing import CliRunner

from spelgen.arm.configured_arm import load_arm
from spelgen.cli.main import app
from spelgen.errors import SettingsError, SpelgenErrors
from spelgen.excitation.bounds import read_surroundings
from spelgen.settings.settings import OF_A_STEP, JointSettings, Settings, load_mapping, load_settings
from spelgen.simulation.protocol import make_friction


@pytest.fixture
def urdf(tmp_path, monkeypatch):
    """Return a function that writes a settings file and returns the relative path of its URDF, which need not exist."""
    monkeypatch.chdir(tmp_path)

    def write(text):
        data = text if isinstance(text, bytes) else text.encode()
        (tmp_path / "arm.yaml").write_bytes(data)
        return "arm.urdf"

    return write


def told(path):
    """Return the text of the errors of a settings file, which must have errors.

    Errors of a group that only one step uses (`OF_A_STEP`) are raised when the group is read, so each group is read.
    """
    with pytest.raises(SettingsError) as error:
        settings = load_settings(path)
        for group in OF_A_STEP:
            repr(getattr(settings, group).model_fields_set)
    return str(error.value)


def test_without_a_file_everything_has_its_default(tmp_path):
    assert load_settings(tmp_path / "arm.urdf") == Settings()


@pytest.mark.parametrize("text", ["", "# nothing\n"])
def test_an_empty_file_is_no_settings(urdf, text):
    assert load_settings(urdf(text)) == Settings()


def test_values_are_read(urdf):
    settings = load_settings(
        urdf(
            "gravity: [0, -9.81, 0]\n"
            "joints:\n"
            "  a: {rotor_inertia: 1e-4, gear: 101, viscous: 2, coulomb: [0.4, -0.5], inputs: [-1, 1]}\n"
            "  b: {actuated: false}\n"
            "simulation: {inputs: [-3, 3], positions: {a: [-1, 2]}, seed: 7}\n"
            "training: {window: 9}\n"
        )
    )
    assert settings.gravity == (0.0, -9.81, 0.0)
    assert settings.joint("a") == JointSettings(
        rotor_inertia=1e-4, gear=101.0, viscous=2.0, coulomb=(0.4, -0.5), inputs=(-1.0, 1.0)
    )
    assert not settings.joint("b").actuated
    assert settings.joint("not in the file") == JointSettings()
    assert settings.simulation.inputs == (-3.0, 3.0)
    assert settings.simulation.positions == {"a": (-1.0, 2.0)}
    assert settings.simulation.seed == 7
    assert settings.simulation.sample_rate == 20.0
    assert settings.training.window == 9


def test_settings_do_not_change(urdf):
    settings = load_settings(urdf("gravity: [0, 0, 0]\n"))
    with pytest.raises(ValidationError, match="frozen"):
        settings.gravity = (0.0, 0.0, -1.6)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (
            "joints:\n\ta: {}",
            "arm.yaml:2: not plain YAML: found character '\\t' that cannot start any token; "
            "write spaces in place of tabs",
        ),
        (
            "logs:\n  columns:\n    q: {joint}_q",
            "arm.yaml:3: not plain YAML: expected <block end>, but found '<scalar>'; "
            "write a text that begins with { or [ in quotes",
        ),
        (
            "joints:\n  a: {rotor_inertia: 1 kg m2}",
            "arm.yaml:2: joints.a.rotor_inertia: got '1 kg m2', expected a number; "
            "write the number only, with a decimal point; docs/settings.md has its unit",
        ),
        (
            "joints:\n  a:{gear: 1}",
            "arm.yaml:2: joints.a:{gear: got '1}', expected keys with values; write a space after the colon",
        ),
        ("gravty: [0, 0, 0]", "arm.yaml:1: unknown key 'gravty'; did you mean 'gravity'?"),
        (
            "joints:\n  a:\n    gear: 2\n    viscus: 1",
            "arm.yaml:4: joints.a: unknown key 'viscus'; did you mean 'viscous'?",
        ),
        (
            "tracking:\n  x: 1",
            "arm.yaml:2: tracking: unknown key 'x'; known are 'amplitude', 'frequency', 'paths', 'control', "
            "'bandwidths', 'control_rate', 'resolution', 'cutoff'",
        ),
        (
            "joints:\n  a: {viscous: -1}",
            "arm.yaml:2: joints.a.viscous: got -1, expected greater than or equal to 0",
        ),
        (
            "gravity:\n  - 0\n  - 0\n  - up",
            "arm.yaml:4: gravity.2: got 'up', expected a number",
        ),
        ("columns: {q: a}", "arm.yaml:1: unknown key 'columns'; write it under 'logs'"),
        (
            "logs: {columns: {joints: {}}}",
            "arm.yaml:1: logs.columns: unknown key 'joints'; write it under 'logs'",
        ),
        (
            "logs:\n  q: pos_{joint}",
            "arm.yaml:2: logs: unknown key 'q'; write it under 'logs.columns' or under 'logs.units'",
        ),
        (
            "training: {gravity: 9}",
            "arm.yaml:1: training: unknown key 'gravity'; write it without indentation",
        ),
        (
            "joints: {a: {gear:9}}",
            "arm.yaml:1: joints.a: unknown key 'gear:9'; write a space after the colon",
        ),
        ("tip:a", "arm.yaml:1: got 'tip:a', expected keys with values; write a space after the colon"),
        (
            "joints: {a: {coulomb: 0.4}}",
            "arm.yaml:1: joints.a.coulomb: got 0.4, expected a list of 2 numbers",
        ),
        ("gravity: 9.81", "arm.yaml:1: gravity: got 9.81, expected a list of 3 numbers"),
        ("moving_joints: []", "arm.yaml:1: moving_joints: got [], expected a longer list"),
        ("simulation: {sample_rate: yes}", "arm.yaml:1: simulation.sample_rate: got True, expected a number"),
        (
            "simulation: {sample_rate: .nan}",
            "arm.yaml:1: simulation.sample_rate: got nan, expected a finite number",
        ),
        (
            "simulation: {trajectories: 0}",
            "arm.yaml:1: simulation.trajectories: got 0, expected greater than or equal to 1",
        ),
        (
            "simulation:\n  protocol: pid",
            "arm.yaml:2: simulation.protocol: got 'pid', expected 'random-inputs', 'tracking' or 'prescribed'",
        ),
        (
            "joints:\n  a: {coulomb: [0.4, 0.5]}",
            "arm.yaml:2: joints.a.coulomb: got [0.4, 0.5], expected the torque for qd > 0 (not negative), "
            "then for qd < 0 (not positive)",
        ),
        (
            "simulation:\n  positions: {a: [1, -1]}",
            "arm.yaml:2: simulation.positions: got {'a': [1, -1]}, expected the lowest position of 'a' "
            "first, then the highest",
        ),
        ("joints:\n  2: {}", "arm.yaml:2: joints.2: got 2, expected a name; write it in quotes"),
        (
            "joints: {a: {gear: 1,5}}",
            "arm.yaml:1: joints.a.5: got 5, expected a name as key; in braces, write numbers with a decimal point, 1.5",
        ),
        (
            "gravity: [0, 0, -9810]",
            "arm.yaml:1: gravity: got [0, 0, -9810], expected m/s^2, such as [0, 0, -9.81], and not mm/s^2",
        ),
        *(
            (
                f"{group}: {{{text}}}",
                f"arm.yaml:1: {group}.{place}: got {size}, expected rad or m, and not degrees or mm",
            )
            for group, text, place, size in (
                ("simulation", "positions: {a: [-1.5, 90]}", "positions.a.1", 90),
                ("tracking", "amplitude: 30", "amplitude", 30),
                ("logs", "joints: {a: {offset: -180}}", "joints.a.offset", -180),
            )
        ),
        (
            "joints: [a]",
            "arm.yaml:1: joints: got ['a'], expected settings by the name of a joint; "
            "`moving_joints` lists the joints that move",
        ),
        ("joints:\n  a: 5", "arm.yaml:2: joints.a: got 5, expected keys with values"),
        ("42", "arm.yaml:1: got 42, expected keys with values"),
        (
            "logs:\n  joints:\n    a:\n      gian: 2",
            "arm.yaml:4: logs.joints.a: unknown key 'gian'; did you mean 'gain'?",
        ),
        (
            "logs:\n  joints:\n    a: {units: {p: deg}}",
            "arm.yaml:3: logs.joints.a.units: unknown key 'p'; known are 'q', 'qd', 'tau', 'u'",
        ),
        ("logs:\n  units: {t: h}", "arm.yaml:2: logs.units.t: got 'h', expected 's', 'ms', 'us' or 'ns'"),
        (
            "logs:\n  joints:\n    a: {gain: 0}",
            "arm.yaml:3: logs.joints.a: got {'gain': 0}, expected a gain that is not 0",
        ),
    ],
)
def test_a_wrong_value_is_reported_with_its_place(urdf, text, message):
    assert told(urdf(text)) == message


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("a: [1", "arm.yaml:1: not plain YAML: expected ',' or ']', but got '<stream end>'"),
        ("about: a\nabout: b", "arm.yaml:2: not plain YAML: the key 'about' a second time; join both"),
        (
            "gravity:\t[0, 0, 0]",
            "arm.yaml:1: not plain YAML: found character '\\t' that cannot start any token; "
            "write spaces in place of tabs",
        ),
        ("about: &x a\ngravity: *x", "arm.yaml:2: not plain YAML: an alias; write the values again"),
        ("? [a]\n: 1", "arm.yaml:1: not plain YAML: a key that is no plain word"),
        (
            "about: !!python/object/apply:os.system [ls]",
            "arm.yaml:1: not plain YAML: the tag tag:yaml.org,2002:python/object/apply:os.system",
        ),
        (
            "joints:\n  joint1:\n    gear: 1:50",
            "arm.yaml:3: not plain YAML: the number 1:50, which is not decimal",
        ),
        (
            "joints: {joint1: {gear: 0100}}",
            "arm.yaml:1: not plain YAML: the number 0100, which is not decimal",
        ),
        ("about: !!bool maybe", "arm.yaml:1: not plain YAML: the tag tag:yaml.org,2002:bool"),
        ("about: !!timestamp maybe", "arm.yaml:1: not plain YAML: the tag tag:yaml.org,2002:timestamp"),
        (
            "joints: {joint1: {gear: 1.0e+200}}",
            "arm.yaml:1: joints.joint1.gear: got 1e+200, expected a number within +-1e+12",
        ),
        ("about: 2025-99-99", "arm.yaml: not plain YAML: month must be in 1..12"),
        ("about: " + 40 * "[", "arm.yaml:1: not plain YAML: more than 16 levels"),
        ("about: |\n" + 300_000 * " ", "arm.yaml: got a file of 300009 bytes, expected at most 262144"),
        (b"about: \xff", "arm.yaml: got bytes that are not UTF-8, expected YAML text"),
        (b"about: \x00", "arm.yaml: not plain YAML: characters that YAML does not allow"),
        (
            "about: a\n---\nabout: b",
            "arm.yaml:2: not plain YAML: found another document; remove the line ---",
        ),
    ],
)
def test_anything_but_plain_yaml_is_refused(urdf, text, message):
    assert told(urdf(text)) == message


def test_all_errors_of_a_file_are_reported_at_once(urdf):
    with pytest.raises(SpelgenErrors) as error:
        load_settings(urdf("gear: 1\njoints:\n  a: {gear: 0}\n"))
    assert str(error.value).splitlines() == [
        "arm.yaml:3: joints.a.gear: got 0, expected greater than 0",
        "arm.yaml:1: unknown key 'gear'; write it under 'joints.NAME'",
    ]


def test_a_folder_of_that_name_is_refused(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "arm.yaml").mkdir()
    assert told("arm.urdf") == "arm.yaml: got no regular file, expected a YAML file"


def test_the_other_suffix_is_not_passed_over(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "arm.yml").write_text("gravity: [0, 0, 0]\n")
    assert told("arm.urdf") == "arm.yml: got 'arm.yml', expected 'arm.yaml'; rename it"


def test_joints_that_do_not_exist_are_reported_with_their_lines(urdf):
    path = urdf("joints:\n  elbow: {}\n  elbw: {}\nsimulation:\n  positions:\n    wrist: [0, 1]\n")
    load_settings(path, ["elbow", "elbw", "wrist", "shoulder"])
    with pytest.raises(SpelgenErrors) as error:
        load_settings(path, ["shoulder", "elbow"])
    assert str(error.value).splitlines() == [
        "arm.yaml:3: joints: unknown joint 'elbw'; did you mean 'elbow'?",
        "arm.yaml:6: simulation.positions: unknown joint 'wrist'; known are 'shoulder', 'elbow'",
    ]


def test_an_error_in_the_settings_of_a_step_refuses_only_that_step(urdf):
    settings = load_settings(
        urdf("gravity: [0, 0, -1.6]\ntraining: {epochs: many}\nlogs: {units: {q: deg}}\n")
    )
    message = "arm.yaml:2: training.epochs: got 'many', expected a whole number"
    assert (settings.gravity[2], settings.logs.units.q) == (-1.6, "deg")
    assert [(each.severity, each.message) for each in settings.diagnostics] == [("warning", message)]
    with pytest.raises(SettingsError) as error:
        assert settings.training.epochs
    assert str(error.value) == message


def test_errors_of_a_step_are_listed_with_those_of_the_arm(urdf):
    with pytest.raises(SpelgenErrors) as error:
        load_settings(urdf("joints: {zz: {gear: 2}}\nlogs: {bogus: 1}\n"), ["shoulder"])
    first, second = str(error.value).splitlines()
    assert "unknown joint 'zz'" in first and "unknown key 'bogus'" in second


def test_a_mapping_may_have_a_file_of_its_own(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "logger.yaml").write_text("units: {q: deg}\njoints:\n  a: {sign: -1}\n  b: {}\n")
    mapping = load_mapping("logger.yaml", ["a", "b"])
    assert (mapping.units.q, mapping.joint("a").sign) == ("deg", -1)
    with pytest.raises(SettingsError) as error:
        load_mapping("logger.yaml", ["a", "bb"])
    assert str(error.value) == "logger.yaml:4: joints: unknown joint 'b'; did you mean 'bb'?"
    (tmp_path / "logger.yaml").write_text("units: {q: grad}\n")
    with pytest.raises(SettingsError, match=r"^logger\.yaml:1: units\.q: got 'grad', expected 'rad', 'deg'"):
        load_mapping("logger.yaml", ["a"])


def test_units_in_settings_have_the_spellings_of_headers(urdf):
    """Units in settings may have the same spellings as units in the header of a log file, such as Degrees or N*m."""
    units = "units: {t: seconds, q: Degrees, qd: 0.5 °/s, tau: N*m}"
    logs = load_settings(urdf(f"logs:\n  {units}\n  joints: {{a: {{units: {{q: 2 cm, tau: kN}}}}}}\n")).logs
    assert logs.units.model_dump(exclude_none=True) == {"t": "s", "q": "deg", "qd": "0.5 deg/s", "tau": "Nm"}
    assert logs.joint("a").units.model_dump(exclude_none=True) == {"q": "20 mm", "tau": "1000 N"}


def test_reading_settings_imports_nothing_heavy():
    script = (
        "import sys, spelgen.settings; print({'numpy', 'torch', 'sympy', 'flint', 'lxml'} & set(sys.modules))"
    )
    shown = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True)
    assert shown.stdout == "set()\n"


def test_settings_in_place_of_a_mapping_are_named(tmp_path):
    path = tmp_path / "arm.yaml"
    path.write_text("gravity: [0, 0, 0]\nlogs:\n  velocity: logged\n")
    with pytest.raises(SettingsError) as error:
        load_mapping(path, ["a"])
    assert str(error.value) == (
        f"{path}:2: got settings of a robot, expected the keys of a mapping, as in the group logs of these settings; "
        "write these keys into a file of their own; without --mapping, the settings beside the URDF are used"
    )


def test_a_list_of_boxes_is_refused_with_an_example(tmp_path):
    path = tmp_path / "cell.yaml"
    path.write_text("boxes:\n  - {size: [1, 1, 1]}\n")
    with pytest.raises(
        SettingsError, match=r"cell.yaml:1: boxes: got .*, expected boxes by name, as in \{table: "
    ):
        read_surroundings(path)


@pytest.mark.parametrize("name", ["rpr", "scara", "panda", "ur10e"])
def test_a_starter_file_states_the_defaults(robots, tmp_path, name):
    """The settings file that `init` writes states the defaults, also if its commented-out settings are uncommented."""
    urdf = tmp_path / "arm.urdf"
    urdf.write_bytes((robots / f"{name}.urdf").read_bytes())
    assert CliRunner().invoke(app, ["init", str(urdf)]).stdout == f"wrote {tmp_path}/arm.yaml\n"
    text = (tmp_path / "arm.yaml").read_text()
    plain = load_arm(urdf)
    assert plain.settings == Settings()
    (tmp_path / "arm.yaml").write_text(re.sub(r"^# ", "", text, flags=re.MULTILINE))
    said = load_arm(urdf)
    assert not said.settings.diagnostics
    assert said.settings.moving_joints == plain.chain.joint_names
    (tip,) = re.findall(r'tip: "(.*)"', text)
    assert load_arm(urdf, tip=tip).chain.joint_names == plain.chain.joint_names
    assert (
        said.settings.joints.keys()
        == {x.name for x in said.chain.coordinates}
        == said.settings.logs.joints.keys()
    )
    kinds = [x.joint_type for x in said.chain.coordinates]
    assert not said.settings.logs.misfits([x.name for x in said.chain.coordinates], kinds)
    ours, theirs = (make_friction(x.chain, x.settings) for x in (plain, said))
    assert np.array_equal(ours(np.ones(len(kinds))), theirs(np.ones(len(kinds))))
    assert "this output exists already" in CliRunner().invoke(app, ["init", str(urdf)]).stderr
