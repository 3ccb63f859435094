"""Conversion of a ``ModelSpec`` to the source of a module, and back. Equal specifications give equal bytes.

Names from a URDF appear only as string literals, and as JSON strings in docstrings, never as code. A module is not
executed to read its specification: its text is searched for the specification.
"""

import ast
import json
import re
from collections.abc import Sequence
from functools import cache
from importlib.resources import files
from pathlib import Path
from textwrap import fill, wrap

from spelgen.emission import parts
from spelgen.emission.parts import Call, Code
from spelgen.errors import ModuleError
from spelgen.files import read_bytes
from spelgen.labels import UNITS, cell_text, counted, entry_name, joints_in_ranges
from spelgen.spec import ConstantSpec, ModelSpec, OutputSpec, spec_from_json
from spelgen.templates import render

_WIDTH = 110
_STEP = 4  # blanks per level of indentation
_SKIP = "  # fmt: skip"  # With this comment in a module, ruff does not reformat its rows of numbers.
_COMMENTS = {
    "JOINTS": ["Positions [rad, m], speed [rad/s, m/s], friction [Nm, N], armature [kg m^2, kg]."],
    "LINKS": [
        "In the frame of the joint, z along its axis; position and rotation: of this frame in the parent's [m].",
        "mass [kg], center_of_mass [m], inertia about it: xx, xy, xz, yy, yz, zz [kg m^2].",
    ],
    "FUNCTIONS": ["The learned functions of q, and the joints that each depends on."],
    "CONSTANTS": ["The trained constants, in units of scale."],
}
_EXAMPLE = """\
    import torch
    from {module} import Model  # if this file is {module}.py

    model = Model()  # trained: model.load_state_dict(torch.load("run/model.pt"))
    q, qd, tau = torch.zeros(3, 100, {n}, dtype=torch.float64)  # any batch, joints last
    M = model.mass_matrix(q)  # (100, {n}, {n})
    qdd = model.forward_dynamics(q, qd, tau)  # (100, {n})
    tau = model.inverse_dynamics(q, qd, qdd)
    V = model.potential_energy(q)  # (100,) [J]
    H = model.hamiltonian(q, model.momentum(q, qd))"""
# [bytes] Largest file that is read as a module: ten times the size of the largest module that `spelgen build` writes.
MAX_MODULE = 2**22
_EXPECTED = "a module written by this version of `spelgen build`"
# The statement of a module with its specification, as JSON. It ends at the first """, which cannot occur in JSON.
_SPEC = re.compile(r'^SPEC = r"""(.*)"""', re.MULTILINE)


def module_text(spec: ModelSpec, *, standalone: bool = False) -> str:
    """Return the Python source of the module that ``spec`` describes.

    The module imports torch and ``spelgen.runtime``. A standalone module contains the runtime's definitions and imports
    torch only.
    """
    assembly = parts.model_parts(spec)
    call = _listed_call("super().__init__", Call("", assembly.model.arguments), 8) + _SKIP
    names = names_in(ast.parse(call))
    arm = "\n\n".join(_rows(spec, assembly))
    if parts.MASS_ENTRIES.text in names:
        arm += f"\n\n\n{_mass_entries(spec)}"
    model = render(
        "model.py.jinja",
        base=assembly.model.callee,
        summary=class_summary(spec),
        has_networks=parts.GENERATOR.text in names,
        call=call,
    )
    title = f"Port-Hamiltonian model of an arm with {counted(len(spec.joints), 'joint')}, by `spelgen build`."
    context = {"title": title, "header": header(spec), "arm": arm, "model": model, "spec": spec.to_json()}
    if standalone:
        from spelgen.emission.standalone import bundle

        return render("standalone.py.jinja", **bundle(arm, model), **context)
    # A module imports only the names that occur in its text.
    used = names_in(ast.parse(f"{arm}\n{model}")) & _public_names()
    # The imported names have ruff's order: classes first.
    ordered = sorted(used, key=lambda name: (not name[0].isupper(), name))
    return render("module.py.jinja", names=ordered, has_tensor=parts.MASS_ENTRIES.text in names, **context)


@cache
def _public_names() -> frozenset[str]:
    """Return the names that a module can import from ``spelgen.runtime``."""
    # The source of ``spelgen.runtime`` is parsed, because an import of the package would import torch.
    source = (files("spelgen") / "runtime" / "__init__.py").read_text(encoding="utf-8")
    imports = [node for node in ast.parse(source).body if isinstance(node, ast.ImportFrom)]
    return frozenset(alias.name for node in imports for alias in node.names)


def class_summary(spec: ModelSpec) -> str:
    """Return a sentence about the model: its bodies or networks. It is the docstring of the class ``Model``."""
    if spec.links:
        residual = ", and residual terms" if spec.design.net != "none" else ""
        return (
            f"{counted(len(spec.links), 'rigid body')} with trained inertial parameters, friction{residual}."
        )
    if spec.design.mass == "dense-3n":
        return "Networks give M^-1 (three axes per joint), potential energy V, damping D and input matrix G."
    return f"{_functions(spec)} make M; networks of V and D."


def _functions(spec: ModelSpec) -> str:
    functions = counted(len(spec.outputs), "learned function")
    return f"{functions} of q and {counted(len(spec.constants), 'constant')}"


def header(spec: ModelSpec) -> str:
    """Return the docstring of the module: arm, example, structure of M, and table of joints."""
    # Names from the URDF are quoted, see `_quoted`, so that they cannot end the docstring.
    example = _EXAMPLE.format(module=module_name(spec), n=len(spec.joints))
    about = fill(description(spec), _WIDTH, break_long_words=False, break_on_hyphens=False)
    return "\n\n".join([about, example, _picture(spec), _joint_table(spec)])


def description(spec: ModelSpec) -> str:
    """Return sentences about a model: robot, bodies or networks, joints of the potential energy V, and inputs."""
    kind = class_summary(spec)
    lines = [f"Robot {_quoted(spec.robot)}. {kind[0].upper()}{kind[1:]}"]
    if spec.links and spec.design.net != "none":
        lines.append(f"Residual terms are zero until a fit selects them; in M: {_functions(spec)}.")
    if spec.potential:
        lines.append(f"V depends on {joints_in_ranges(spec.potential)}.")
    else:
        lines.append("Gravity does no work.")
    if spec.servos:
        lines.append("Inputs are commanded positions u of servos: tau = clip(kp (u - q) - kd qd).")
    if not spec.started_from_urdf:
        lines.append("The URDF has no physically consistent inertials: initial links have 1 kg each.")
    return " ".join(lines)


def module_name(spec: ModelSpec) -> str:
    """Return the default name of the module of a URDF, without folder and suffix: `ur5_spel` for ur5.urdf."""
    name = re.sub(r"[^0-9A-Za-z_]+", "_", Path(spec.urdf).stem) or "arm"
    return f"{'_' if name[0].isdigit() else ''}{name}_spel"


def _picture(spec: ModelSpec) -> str:
    """Return a text table of the lower triangle of M: for each entry, the joints that it depends on, C or 0.

    C: the entry is constant. 0: the entry is always zero.
    """
    cells = {}
    for row, column, kind, joints in spec.entries:
        cells[row, column] = cell_text(kind, joints)
    width = max(2, *map(len, cells.values()))
    lines = ["Mass matrix: numbers of the joints that each entry depends on; C constant, 0 always zero", ""]
    for row in range(len(spec.joints)):
        line = "  ".join(cells[row, column].ljust(width) for column in range(row + 1))
        lines.append(f"    {row + 1:2}  {line}".rstrip())
    return "\n".join(lines)


def _joint_table(spec: ModelSpec) -> str:
    """Return a text table of the joints: number, name, type, limits and units."""
    lines = ["Joints, in the order of q, qd and tau", ""]
    names = [_quoted(joint.name) for joint in spec.joints]
    width = max(map(len, names))
    for number, (joint, name) in enumerate(zip(spec.joints, names, strict=True), start=1):
        limits = "unlimited"
        if joint.lower is not None and joint.upper is not None:
            limits = f"{joint.lower:g} .. {joint.upper:g}"
        units = UNITS[joint.joint_type]
        quantities = f"{limits} {units.position}, {units.torque}"
        lines.append(f"    {number:2}  {name.ljust(width)}  {joint.joint_type:9}  {quantities}")
    return "\n".join(lines)


def _quoted(name: str) -> str:
    """Return a name as a JSON string: its quotes are escaped, so that it cannot end a docstring."""
    return json.dumps(name)


def _rows(spec: ModelSpec, assembly: parts.ModelParts) -> list[str]:
    """Return the source of the tables ``JOINTS``, ``LINKS``, ...; comments with the units precede each table."""
    statements = []
    terms: dict[str, Sequence[OutputSpec | ConstantSpec]] = {
        "FUNCTIONS": spec.outputs,
        "CONSTANTS": spec.constants,
    }
    for name, rows in assembly.rows.items():
        lines = [*(f"# {line}" for line in _COMMENTS[name]), f"{name} = ("]
        for k, row in enumerate(rows):
            end = ""
            if name in terms:
                end = f"  # {name[0].lower()}{k + 1}: {_term_description(spec, terms[name][k])}"
            lines.append(f"    {_filled('', row, 4, len(end))},{end}")
        statements.append("\n".join([*lines, f"){_SKIP}"]))
    return statements


def _term_description(spec: ModelSpec, term: OutputSpec | ConstantSpec) -> str:
    """Return the description of a term of M for a comment: the entries of M that contain it, and a unit.

    The unit is the unit of the first entry; other entries have another unit only if a factor of the term has a unit.
    """
    entries = [entry_name(row, column) for row, column, _ in term.basis]
    row, column, _ = term.basis[0]
    # The unit of an entry of M is kg m^2 for two revolute joints, kg m for one prismatic joint, kg for two.
    slides = [spec.joints[joint].joint_type for joint in (row, column)].count("prismatic")
    suffix = f" and {len(entries) - 2} more" if len(entries) > 2 else ""
    return f"{', '.join(entries[:2])}{suffix} [{('kg m^2', 'kg m', 'kg')[slides]}]"


def _mass_entries(spec: ModelSpec) -> str:
    """Return the source of ``mass_entries``, which computes M from values of its learned functions and constants."""
    # The terms of M are named f1, f2, ... (functions), then c1, c2, ... (constants).
    names = [f"f{k + 1}" for k in range(len(spec.outputs))]
    names += [f"c{k + 1}" for k in range(len(spec.constants))]
    arguments = ", ".join(f"{name}: Tensor" for name in names)
    start = f"def mass_entries({arguments}) -> Tensor:"
    if len(start) > _WIDTH:
        lines = wrap(f"{arguments},", _WIDTH - 4, initial_indent=" " * 4, subsequent_indent=" " * 4)
        start = "\n".join(["def mass_entries(", *lines, f") -> Tensor:{_SKIP}"])
    result = "the residual of M" if spec.links else "M without armature"
    about = f'    """Return {result}, (..., n, n), from functions of q and constants."""'
    body, rows = [], []
    for row, cells in enumerate(parts.entry_sums(spec)):
        texts = [_sum(sums, names) for sums in cells]
        for column, text in enumerate(texts):
            # Entries that are sums are assigned to variables, so that a row of M fits on a line. Entries that are
            # single terms are used directly.
            if " " in text or text.startswith("-"):
                texts[column] = entry_name(row, column).lower().replace(",", "_")
                body.append(f"    {texts[column]} = {text}")
        rows.append(f"[{', '.join(texts)}]")
    end = f"    return symmetric({', '.join(rows)})"
    if len(end) > _WIDTH:
        end = "\n".join(["    return symmetric(", *(f"        {row}," for row in rows), f"    ){_SKIP}"])
    return "\n".join([start, about, *body, end])


def _sum(sums: parts.Sums, names: list[str]) -> str:
    """Return the source of a linear combination of terms, such as ``f1 - 2 * c1``; ``0`` if there are no terms.

    sums: pairs (factor, index of a term). names: names of all terms.
    """
    text = ""
    for factor, index in sums:
        term = names[index] if abs(factor) == 1 else f"{_number(abs(factor))} * {names[index]}"
        text += f" - {term}" if factor < 0 else f" + {term}"
    # The first term has no plus sign, and no blanks around its minus sign.
    if text.startswith(" - "):
        return f"-{text[3:]}"
    return text.removeprefix(" + ") or "0"


def _number(value: float) -> str:
    """Return a short source text of ``value`` that gives exactly this number."""
    # The text with six digits is tried first: most numbers of a URDF have no more digits.
    short = f"{value:g}"
    return short if float(short) == value else repr(value)


def read_source(path: Path) -> str:
    """Return the text of the module at ``path``. Raises ModuleError if the file is absent, too large or not UTF-8."""
    if not path.exists():
        raise ModuleError("no such file", file=path, do="build it with `spelgen build`")
    content = read_bytes(path, ModuleError, _EXPECTED, MAX_MODULE)
    try:
        return content.decode("utf-8").replace("\r\n", "\n")
    except ValueError as problem:
        raise _no_module(f" ({type(problem).__name__})", path) from None


def read_spec(path: Path | str) -> ModelSpec:
    """Return the specification in the module at ``path``. Raises ModuleError if the file has no specification."""
    return parse_spec(read_source(Path(path)), Path(path))


def parse_spec(text: str, file: Path | None = None) -> ModelSpec:
    """Return the specification in a module's text, without a check whether the text was edited.

    Raises ModuleError if the text has no specification. file: path of the module for the error.
    """
    statement = _SPEC.search(text)
    if statement is None:
        raise _no_module("", file)
    return spec_from_json(statement[1], file)


def require_unedited(text: str, file: Path | None = None) -> ModelSpec:
    """Return the specification in a module's text; raise ModuleError if the text was edited since `spelgen build`."""
    spec = parse_spec(text, file)
    # The whole text is compared with the text that the specification gives. A model is assembled from the specification
    # only: an edit of any other text would be ignored.
    if text in (module_text(spec, standalone=is_standalone) for is_standalone in (False, True)):
        return spec
    raise ModuleError(
        "a module that was edited, or written by another version of spelgen", file=file, expected=_EXPECTED,
        do="build it again, or use the edited one from Python: `from MODULE import Model; spelgen.fit(Model(), logs)`",
    )  # fmt: skip


def _no_module(reason: str, file: Path | None) -> ModuleError:
    got, do = f"no specification of spelgen in it{reason}", "build it again, or check the path"
    if file is not None and file.suffix in (".urdf", ".xacro", ".xml"):
        got, do = "a robot description", f"`spelgen build {file}` writes its module"
    return ModuleError(got, file=file, expected=_EXPECTED, do=do)


def _filled(start: str, value: object, indent: int, reserved: int = 0) -> str:
    """Return the text ``start`` followed by the source text of ``value``, in one line or several lines.

    The result is one line if the text and ``reserved`` more characters fit into ``_WIDTH`` columns.

    Args:
        start: text before the value, such as "name=".
        value: the value.
        indent: column at which the text starts.
        reserved: number of characters that the caller adds after the text, such as a comment.
    """
    text = start + _flat(value)
    if indent + len(text) + reserved < _WIDTH or not _items(value) or _is_repeated(value):
        return text
    inner = " " * (indent + _STEP)
    opening, closing = "{}" if isinstance(value, dict) else "()"
    callee = value.callee if isinstance(value, Call) else ""
    # Each line is filled with as many items as fit. An item that has several lines starts on its own line.
    lines = [f"{start}{callee}{opening}", inner]
    for key, item in _items(value):
        text = f"{_filled(key, item, indent + _STEP)},"
        line = lines[-1]
        if line == inner:
            lines[-1] += text
        elif "\n" in text or "\n" in line or len(line) + len(text) >= _WIDTH:
            lines.append(inner + text)
        else:
            lines[-1] += f" {text}"
    return "\n".join([*lines, " " * indent + closing])


def _listed_call(start: str, value: Call, indent: int) -> str:
    """Return ``start`` followed by the source text of a call with one line per argument; indent: column of the call."""
    inner = " " * (indent + _STEP)
    lines = [f"{inner}{_filled(key, item, indent + _STEP)}," for key, item in _items(value)]
    return "\n".join([f"{start}{value.callee}(", *lines, " " * indent + ")"])


def _flat(value: object) -> str:
    """Return the source text of a value in one line. Texts become string literals of ASCII characters."""
    if isinstance(value, Code):
        return value.text
    if isinstance(value, str):
        return json.dumps(value) if value.isascii() and value.isprintable() else ascii(value)
    if isinstance(value, tuple):
        if _is_repeated(value):
            return f"({_flat(value[0])},) * {len(value)}"
        return f"({_flat(value[0])},)" if len(value) == 1 else f"({_joined(value)})"
    if isinstance(value, dict):
        return "{" + _joined(value) + "}"
    return f"{value.callee}({_joined(value)})" if isinstance(value, Call) else repr(value)


def _items(value: object) -> list[tuple[str, object]]:
    """Return (prefix, item) for each argument of a ``Call``, or item of a dictionary or tuple; [] for other values.

    The prefix is "key=" for a keyword argument of a call, "key: " for a dictionary, otherwise "".
    """
    if isinstance(value, Call):
        return [(f"{key}=" if key else "", item) for key, item in value.arguments]
    if isinstance(value, dict):
        return [(f"{_flat(key)}: ", item) for key, item in value.items()]
    return [("", item) for item in value] if isinstance(value, tuple) else []


def _is_repeated(value: object) -> bool:
    """Return True for a tuple of more than three equal items, which is written as a product: ``(0.0,) * 6``."""
    return isinstance(value, tuple) and len(value) > 3 and value.count(value[0]) == len(value)


def _joined(value: object) -> str:
    return ", ".join(key + _flat(item) for key, item in _items(value))


def names_in(tree: ast.AST) -> set[str]:
    """Return all names that occur in a syntax tree, including names in annotations."""
    return {node.id for node in ast.walk(tree) if isinstance(node, ast.Name)}
