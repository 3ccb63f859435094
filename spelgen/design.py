"""Design of a model: the form of each quantity of the equations of motion. Presets are designs in YAML files."""

from collections.abc import Iterator, Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Literal, get_args, get_type_hints

from spelgen.errors import SettingsError, collect
from spelgen.settings.yaml_document import YamlDocument, read_document, unknown_name

Preset = Literal["hybrid", "closed-form", "minimal", "spel", "spel-kan", "phnode"]
"""The presets of spelgen."""

PRESET_NAMES: tuple[str, ...] = get_args(Preset)

BREAKAWAY = {
    "revolute": (1e-4, 4e-4, 1.6e-3, 6.4e-3, 2.5e-2, 1e-1),
    "prismatic": (1e-5, 4e-5, 1.6e-4, 6.4e-4, 2.5e-3, 1e-2),
}
"""Break-away displacements of the bristles per joint type [rad, m]. They span the decades of presliding of gears."""
SERVO_STRIBECK_ROUNDING = 0.2
"""Rounding of the Stribeck curve at rest, as a fraction of the Stribeck velocity, for joints that servos hold at rest.
The friction of such joints decreases from standstill on; with a rounded curve, simulated joints would creep.
"""


PRESETS = Path(__file__).parent / "presets"


@dataclass(frozen=True)
class Design:
    """The form of a model: how each quantity of the equations of motion (M, V, friction, G) is represented.

    V is the potential energy, G the input matrix. The types of the fields list the possible representations of each
    quantity.

    ``derived``: the structure of the arm determines which entries of the quantity are zero, are constant, or depend on
    which joints; networks learn only the entries that vary. ``dense`` (of V) and ``dense-n`` (of friction, as an n x n
    matrix): a network learns the whole quantity without knowledge of the arm. ``dense-3n``: a network learns rows for
    all three axes of each joint's frame, as in the publications of such models, although a joint moves only about or
    along one axis (Wang et al., Sci Rep 15:33179, 2025, and Duong et al., IEEE T-RO 40:3695, 2024). ``closed-form``:
    rigid bodies with trained inertial parameters, and networks for residual terms, if any. ``per-joint``: friction of
    each joint with a network. ``constants``: a friction model with trained constants.

    Raises SettingsError for an inconsistent combination.
    """

    mass: Literal["derived", "dense-3n", "closed-form"]
    potential: Literal["derived", "dense", "closed-form"]
    dissipation: Literal["per-joint", "dense-n", "dense-3n", "constants"]
    input: Literal["derived", "dense-3n"]
    memory: Literal["bristles", "none"]
    """State of the friction model: bristles (hysteresis), or none for friction that depends on the velocity only."""
    net: Literal["mlp", "kan", "none"]
    """Type of the networks of M and V: mlp (tanh) or kan (Kolmogorov-Arnold). Residual networks are always tanh."""
    encoding: Literal["joint", "lie-group", "none"]
    """Inputs of a network. joint: cos q and sin q, for a prismatic joint scaled q, of the joints it depends on.

    lie-group: for every joint the nine entries of its rotation matrix R, or the three entries of its translation r.
    none: the design has no such network.
    """

    def __post_init__(self) -> None:
        validate(asdict(self))


CHOICES: dict[str, tuple[str, ...]] = {name: get_args(kind) for name, kind in get_type_hints(Design).items()}
"""The values of each key of a design."""


def load_design(preset: str | Path | Design) -> Design:
    """Return the design of a preset, given by its name, or of a YAML file, given by its path.

    A `Design` is returned unchanged. Raises SettingsError for an unknown name or an invalid file.
    """
    if isinstance(preset, Design):
        return preset
    # The name of a preset takes precedence over a file of the same name without a suffix.
    if str(preset) in PRESET_NAMES:
        return _read(PRESETS / f"{preset}.yaml")
    if Path(preset).suffix in (".yaml", ".yml"):
        return _read(Path(preset))
    expected = f"one of {', '.join(PRESET_NAMES)}, or a YAML file"
    raise SettingsError(f"the preset {str(preset)!r}", expected=expected)


def _read(path: Path) -> Design:
    """Return the design in a YAML file with all keys of ``Design`` and, optionally, ``about``, a description."""
    document = read_document(path)
    content = document.value()
    if not isinstance(content, dict):
        raise SettingsError("no keys with values", file=path, expected=f"the keys {', '.join(CHOICES)}")
    # `about` is a description for people, not a field of `Design`.
    values = {key: value for key, value in content.items() if key != "about"}
    validate(values, document)
    return Design(**values)


def validate(values: Mapping[str, object], document: YamlDocument | None = None) -> None:
    """Raise SettingsError, or SpelgenErrors for several errors, unless ``values`` are a valid design.

    ``document``: the parsed file of the values; errors state the file and the line.
    """
    file = None if document is None else document.path
    lines = {name: None if document is None else document.line((name,)) for name in CHOICES}
    unknown = [name for name in values if name not in CHOICES]
    errors = [unknown_name((name,), "key", str(name), CHOICES, document) for name in unknown]
    for name, choices in CHOICES.items():
        if values.get(name) not in choices:
            got = repr(values[name]) if name in values else "nothing"
            expected = f"one of {', '.join(choices)}"
            errors.append(SettingsError(got, file=file, line=lines[name], element=name, expected=expected))
    # Errors of single values are raised before conflicts: the rules for pairs of values require valid values.
    collect(errors)
    for first, second, do in _conflicts(values):
        got = f"{first}: {values[first]} with {second}: {values[second]}"
        errors.append(SettingsError(got, file=file, line=lines[first], do=do))
    collect(errors)


def _conflicts(values: Mapping[str, object]) -> Iterator[tuple[str, str, str]]:
    """Yield (key, other key, advice) for each pair of keys whose values contradict each other."""
    # The rules below have the order of the keys in a design file, so that errors have the order of its lines.
    rigid = values["mass"] == "closed-form"
    if rigid != (values["potential"] == "closed-form"):
        yield "mass", "potential", "rigid bodies give both: name closed-form for both or for neither"
    if rigid != (values["dissipation"] == "constants"):
        yield "mass", "dissipation", "dissipation: constants and mass: closed-form require each other"
    if values["memory"] == "bristles" and not rigid:
        yield "memory", "dissipation", "bristles require dissipation: constants"
    if values["net"] == "none" and not rigid:
        yield "mass", "net", "net: none requires mass: closed-form"
    if (values["net"] == "none") != (values["encoding"] == "none"):
        yield "net", "encoding", "encoding is the input of networks: none for a model without networks"
    if rigid and values["net"] == "kan":
        yield "mass", "net", "residual networks in addition to rigid bodies need net: mlp"
    if rigid and values["encoding"] == "lie-group":
        yield "mass", "encoding", "residual terms of rigid bodies need encoding: joint"
    if rigid and values["input"] != "derived":
        yield "mass", "input", "mass: closed-form requires input: derived"
