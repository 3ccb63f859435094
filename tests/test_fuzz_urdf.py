"""Any URDF file gives a derived structure or errors of one line each that name the file."""

from __future__ import annotations

import random
from pathlib import Path

import pytest
from fuzzing import FEW, MINUTES, fuzz
from hypothesis import strategies as st

from spelgen.certificate.inspection import inspect
from spelgen.errors import SpelgenError

ROOT = Path(__file__).parents[1]
OURS = sorted((ROOT / "robots").glob("*.urdf"))
THEIRS = sorted((ROOT.parent / "shared" / "arms").rglob("*.urdf"))[::9]
LARGEST = 60_000  # [bytes] size of files that are mutated: larger ones only take longer
MUTANTS = 300 if MINUTES else 2 * FEW
NAMES = st.sampled_from(["a", "b", "c", "d", "base", "", "a b", "é", "{{ a }}", "a'b", "l" * 200])
TYPES = st.sampled_from(
    ["revolute", "continuous", "prismatic", "fixed", "floating", "planar", "", "hinge"]
    + 4 * ["revolute", "continuous", "prismatic"]
)
NUMBERS = st.sampled_from(
    ["0", "1", "-1", "0.5", "1.5708", "3.14159", "1e-9", "1e9", "1e400", "nan", "x", "", "1 2", "0x10", "--1"]
    + 9 * ["0", "0.1", "-0.3"]
)


@st.composite
def elements(draw: st.DrawFn, name: str, attributes: tuple[str, ...], content: str = "") -> str:
    """Draw zero, one or two copies of an XML element with some of its attributes, whose values may be anomalous."""
    present = [x for x in attributes if draw(st.integers(0, 9))]
    told = " ".join(f'{x}="{draw(NUMBERS)}"' for x in present)
    return f"<{name} {told}>{content}</{name}>" * draw(st.sampled_from([0, 1, 1, 1, 1, 1, 2]))


@st.composite
def triples(draw: st.DrawFn) -> str:
    return " ".join(draw(NUMBERS) for _ in range(draw(st.sampled_from([2, 3, 3, 3, 3, 3, 4]))))


@st.composite
def joints(draw: st.DrawFn) -> str:
    origin = f'<origin xyz="{draw(triples())}" rpy="{draw(triples())}"/>'
    axis = draw(st.sampled_from(['<axis xyz="0 0 1"/>', '<axis xyz="1 0 0"/>', ""])) or (
        f'<axis xyz="{draw(triples())}"/>'
    )
    mimic = (
        f'<mimic joint="{draw(NAMES)}" multiplier="{draw(NUMBERS)}"/>' if not draw(st.integers(0, 5)) else ""
    )
    limit = draw(elements("limit", ("lower", "upper", "effort", "velocity")))
    dynamics = draw(elements("dynamics", ("damping", "friction")))
    ends = f'<parent link="{draw(NAMES)}"/><child link="{draw(NAMES)}"/>'
    return f'<joint name="{draw(NAMES)}" type="{draw(TYPES)}">{ends}{origin}{axis}{mimic}{limit}{dynamics}</joint>'


@st.composite
def links(draw: st.DrawFn) -> str:
    mass = draw(elements("mass", ("value",)))
    tensor = draw(elements("inertia", ("ixx", "ixy", "ixz", "iyy", "iyz", "izz")))
    inertial = draw(elements("inertial", (), f'<origin xyz="{draw(triples())}"/>{mass}{tensor}'))
    return f'<link name="{draw(NAMES)}">{inertial}</link>'


@st.composite
def robots_of_any_kind(draw: st.DrawFn) -> str:
    parts = draw(st.lists(st.one_of(links(), joints()), max_size=9))
    return f'<robot name="{draw(NAMES)}">{"".join(parts)}</robot>'


@st.composite
def nearly_right(draw: st.DrawFn) -> str:
    """Draw the URDF of a serial chain whose structure is valid, but whose numbers may be anomalous."""
    count = draw(st.integers(1, 4))
    told = [f'<link name="l{k}">{draw(elements("inertial", (), ""))}</link>' for k in range(count + 1)]
    for k in range(count):
        kind = draw(st.sampled_from(["revolute", "continuous", "prismatic"]))
        numbers = f'<origin xyz="{draw(triples())}" rpy="{draw(triples())}"/><axis xyz="{draw(triples())}"/>'
        limit = '<limit lower="-1" upper="1" effort="1" velocity="1"/>'
        ends = f'<parent link="l{k}"/><child link="l{k + 1}"/>'
        told.append(f'<joint name="j{k}" type="{kind}">{ends}{numbers}{limit}</joint>')
    return f'<robot name="r">{"".join(told)}</robot>'


def test_generated_files(tmp_path):
    def use(text):
        path = tmp_path / "drawn.urdf"
        path.write_text(text, encoding="utf-8")
        require_answer(path)

    fuzz(st.one_of(robots_of_any_kind(), nearly_right()), 500, use)


@pytest.mark.parametrize("kind", ["bytes", "tokens"])
def test_mutated_files(tmp_path, kind):
    sources = [path.read_bytes() for path in [*OURS, *THEIRS] if path.stat().st_size <= LARGEST]
    draw = random.Random(0)
    path = tmp_path / "mutant.urdf"
    answers = set()
    for _ in range(MUTANTS):
        source = draw.choice(sources)
        path.write_bytes(mutated(source, draw) if kind == "bytes" else shuffled(source, draw))
        answers.add(require_answer(path))
    assert answers == {True, False}  # some mutated files are still accepted, some are refused


def mutated(source: bytes, draw: random.Random) -> bytes:
    """Return a file with a few bytes changed, removed or inserted, or with a part repeated."""
    content = bytearray(source)
    for _ in range(draw.randint(1, 3)):
        place, length = draw.randrange(len(content)), draw.choice([1, 1, 1, 8, 200])
        how = draw.randrange(4)
        if how == 0:
            content[place] = draw.randrange(256)
        elif how == 1:
            del content[place : place + length]
        elif how == 2:
            content[place:place] = bytes(draw.choice(b'<>"/& 0.-e\x00\xff') for _ in range(length))
        else:
            content[place:place] = content[place : place + length]
    return bytes(content)


def shuffled(source: bytes, draw: random.Random) -> bytes:
    """Return an XML file with some quoted values exchanged: it is still XML."""
    parts = source.split(b'"')
    values = [k for k in range(1, len(parts), 2)]
    for _ in range(draw.randint(1, 4)):
        one, other = draw.choice(values), draw.choice(values)
        parts[one], parts[other] = parts[other], parts[one]
    return b'"'.join(parts)


def require_answer(path: Path) -> bool:
    """Return True if a structure is derived; otherwise check that the errors are one line each and name the file."""
    try:
        found = inspect(path)
    except SpelgenError as error:
        lines = str(error).split("\n")
        assert lines
        for line in lines:
            assert line.startswith((str(path), "and ")), line
            assert line.isprintable(), line
        return False
    assert found.text()
    assert len(found.structure.joints) == len(found.arm.coordinates)
    return True
