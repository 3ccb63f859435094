"""Hostile URDF files are refused or built by `inspect` and `build` within 10 s and 1 GB each.

The 10 s are processor time of the reference machine in time_bounds.py.
"""

from __future__ import annotations

import json
import os
import random
import re
import subprocess
import sys
from collections.abc import Callable
from dataclasses import dataclass
from math import pi
from pathlib import Path

import pytest
from time_bounds import in_time

ROOT = Path(__file__).parents[1]
SECONDS, MEGABYTES = 10, 1000

# a server process imports the modules of all commands and forks a process per command; the last line of its output
# has exit code and peak memory; processor time includes the fork and the imports
SERVER = """
import json, os, resource, signal, sys
import spelgen.emission.specify
from spelgen.cli.main import main

def run(folder, told, *arguments):
    os.chdir(folder)
    sys.stdout.flush()
    os.dup2(os.open(os.devnull, os.O_WRONLY), 1)
    os.dup2(os.open(told, os.O_WRONLY | os.O_CREAT), 2)
    sys.argv = ["spelgen", *arguments]
    try:
        main()
    except SystemExit as end:
        code = end.code
    assert "torch" not in sys.modules
    status = open("/proc/self/status").read()
    print(code, status.partition("VmHWM:")[2].split()[0], file=sys.stderr, flush=True)
    os._exit(0)

own = resource.getrusage(resource.RUSAGE_SELF)
for line in sys.stdin:
    child = os.fork()
    if child == 0:
        signal.alarm({alarm})
        run(*json.loads(line))
    _, status, used = os.wait4(child, 0)
    print(status, sum(x.ru_utime + x.ru_stime for x in (own, used)), flush=True)
"""


@dataclass(frozen=True)
class Case:
    """A URDF to build: its text, options of the command, and a part of the expected error (`refused`; None: none)."""

    make: Callable[[], str | bytes]
    refused: str | None
    options: tuple[str, ...] = ()


def robot(links: list[str], joints: list[str]) -> str:
    parts = "".join(f'<link name="{name}"/>\n' for name in links)
    return f'<robot name="r">\n{parts}{"".join(joints)}</robot>'


def joint(k: int, parent: str, *, origin: str = "", more: str = "", kind: str = "continuous") -> str:
    ends = f'<parent link="{parent}"/><child link="l{k}"/>'
    return f'<joint name="j{k}" type="{kind}">{ends}<origin {origin}/><axis xyz="0 0 1"/>{more}</joint>\n'


def chain(
    count: int, origin: Callable[[int], str], *, kind: str = "continuous", more: Callable = lambda k: ""
) -> str:
    joints = [joint(k, f"l{k - 1}", origin=origin(k), kind=kind, more=more(k)) for k in range(1, count + 1)]
    return robot([f"l{k}" for k in range(count + 1)], joints)


def planar(k: int) -> str:
    return 'xyz="0.1 0 0"'


def general(k: int) -> str:
    draw = random.Random(k)
    xyz = " ".join(repr(draw.uniform(-1, 1)) for _ in range(3))
    return f'xyz="{xyz}" rpy="{" ".join(repr(draw.uniform(-pi, pi)) for _ in range(3))}"'


def star(count: int, kind: str) -> str:
    return robot(
        ["l0", *(f"l{k}" for k in range(1, count))], [joint(k, "l0", kind=kind) for k in range(1, count)]
    )


def one_joint(**changes: str) -> str:
    known = {"name": "r", "origin": planar(1), "more": ""} | changes
    text = robot(["l0", "l1"], [joint(1, "l0", origin=known["origin"], more=known["more"])])
    return text.replace('name="r"', f'name="{known["name"]}"')


LAUGHS = "".join(f'<!ENTITY a{k} "{f"&a{k - 1};" * 10}">' for k in range(1, 10))
LAUGHING = f'<!DOCTYPE robot [<!ENTITY a0 "ha">{LAUGHS}]>' + one_joint(name="&a9;")
EXTERNAL = '<!DOCTYPE robot [<!ENTITY a SYSTEM "file:///etc/hostname">]>' + one_joint(more="&a;")
OUTSIDE = '<!DOCTYPE robot SYSTEM "http://127.0.0.1:9/robot.dtd">' + one_joint()
DECLARED = '<?xml version="1.0" encoding="utf-16"?>'
WRAPPED = '<robot name="r">{}</robot>'
TOO_MANY = r": got 300 joints, expected at most 16; choose fewer with --joints or --tip"
DECLARATION = r":\d: got a document type or entity declaration, expected plain XML"

CASES = {
    "billion laughs": Case(lambda: LAUGHING, DECLARATION),
    "billion laughs in UTF-16": Case(
        lambda: (DECLARED + LAUGHING).encode("utf-16"), "not well-formed|document type"
    ),
    "external entity": Case(lambda: EXTERNAL, DECLARATION),
    "external entity in UTF-16": Case(
        lambda: (DECLARED + EXTERNAL).encode("utf-16"), "document type|not well-formed"
    ),
    "external document type": Case(lambda: OUTSIDE, DECLARATION),
    "25 MB": Case(
        lambda: one_joint(name="r" * 25_000_000), r"a file of 25\d+ bytes, expected at most 20000000"
    ),
    "15 MB in one attribute": Case(lambda: one_joint(name="r" * 15_000_000), "not well-formed|characters"),
    "15 MB of elements": Case(lambda: WRAPPED.format("<a/>" * 3_700_000), "no <link>"),
    "15 MB of attributes": Case(
        lambda: WRAPPED.format("<link " + " ".join(f'a{k}=""' for k in range(1_500_000)) + "/>"),
        "not well-formed|no name|no <joint>",
    ),
    "100,000 levels": Case(lambda: WRAPPED.format("<a>" * 100_000 + "</a>" * 100_000), "not well-formed"),
    "250 levels": Case(lambda: one_joint(more="<a>" * 250 + "</a>" * 250), None),
    "300 joints in a plane": Case(lambda: chain(300, planar), TOO_MANY),
    "300 joints anywhere": Case(lambda: chain(300, general), TOO_MANY),
    "300 sliding joints": Case(lambda: chain(300, general, kind="prismatic"), TOO_MANY),
    "16 of 300 joints in a plane": Case(lambda: chain(300, planar), None, ("--tip", "l16")),
    "12 of 300 joints anywhere": Case(lambda: chain(300, general), None, ("--tip", "l12")),
    "6 of 300 joints far apart": Case(
        lambda: chain(300, general), None, ("--joints", ",".join(f"j{k}" for k in range(50, 301, 50)))
    ),
    "2000 links fixed in a row": Case(
        lambda: chain(1999, general, kind="fixed"), "no joint that moves independently"
    ),
    "2000 links around one": Case(lambda: star(2000, "continuous"), "1999 chains of 1 joint"),
    "2000 links fixed around one": Case(
        lambda: star(2000, "fixed").replace('"fixed"', '"revolute"', 1), None
    ),
    "2001 links": Case(lambda: star(2001, "fixed"), "got 2001 links, expected at most 2000"),
    "circle of mimic joints": Case(
        lambda: chain(300, planar, more=lambda k: f'<mimic joint="j{k % 300 + 1}"/>'),
        "a circle of mimic joints",
    ),
    "300 joints that follow each other": Case(
        lambda: chain(
            300, planar, more=lambda k: f'<mimic joint="j{k - 1}" multiplier="1.1"/>' if k > 1 else ""
        ),
        "got 299 joints that follow others by <mimic>, expected at most 48; fix some of them",
    ),
    "a multiplier of many digits": Case(
        lambda: chain(
            3, general, more=lambda k: '<mimic joint="j1" multiplier="0.1234567890123457"/>' if k > 1 else ""
        ),
        None,
    ),
    "not a number": Case(lambda: one_joint(origin='xyz="nan 0 0"'), "got 'nan', expected three numbers"),
    "infinite": Case(lambda: one_joint(origin='xyz="1e400 0 0"'), r"expected three numbers within \+-1e\+12"),
    "tiny": Case(lambda: one_joint(origin='xyz="1e-400 4.9e-324 1e-300"'), None),
    "a million digits": Case(
        lambda: one_joint(origin=f'xyz="{"1" * 10**6} 0 0"'), "a number of 1000000 characters"
    ),
    "a million numbers": Case(lambda: one_joint(origin=f'xyz="{"1 " * 10**6}"'), "1000000 numbers"),
    "2000 errors": Case(lambda: star(2000, "spherical"), "got the type 'spherical'"),
}


@pytest.fixture(scope="module")
def server():
    """Start the server process that runs commands; yield it."""
    environment = os.environ | {"PYTHONPATH": str(ROOT), "OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}
    # limit of wall time, large enough for a busy machine
    program = SERVER.replace("{alarm}", str(60 * SECONDS))
    with subprocess.Popen(
        [sys.executable, "-c", program],
        env=environment,
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
    ) as process:
        yield process
        process.stdin.close()


@pytest.mark.skipif(sys.platform != "linux", reason="memory is read from /proc")
@pytest.mark.parametrize("name", CASES)
def test_is_refused_or_built_in_bounds(server, tmp_path, name):
    case = CASES[name]
    text = case.make()
    path = tmp_path / "robot.urdf"
    path.write_bytes(text if isinstance(text, bytes) else text.encode())
    inspect, build = ("inspect", "--format", "json", "-o", "structure.json"), ("build", "-o", "module.py")
    # `inspect` is not run for refused files, as it uses the same reader as `build`
    for command in (inspect, build) if case.refused is None else (build,):
        arguments = command[0], path.name, *case.options, *command[1:]
        code, errors = run_in_bounds(server, *arguments, folder=tmp_path)
        assert code == ("0" if case.refused is None else "1")
        if case.refused is not None:
            assert_refusal(errors, case.refused)
    made = {each.name for each in tmp_path.iterdir()} - {path.name}
    assert made == ({"structure.json", "module.py"} if case.refused is None else set())


def run_in_bounds(server: subprocess.Popen, *arguments: str, folder: Path) -> tuple[str, list[str]]:
    """Run a command of spelgen, such as `build`, in `folder`; return its exit code and its lines on stderr.

    The process `server` (see SERVER) has imported spelgen and forks for each command, which saves the time of imports.
    Asserts that the command uses at most `SECONDS` of processor time and `MEGABYTES` of memory.
    """
    told = folder.parent / f"{folder.name}-{arguments[0]}.stderr"
    print(json.dumps([str(folder), str(told), *arguments]), file=server.stdin, flush=True)
    status, seconds = server.stdout.readline().split()
    text = told.read_text()
    assert status == "0", text[-2000:]
    *lines, last = text.splitlines()
    code, kilobytes = last.split()
    assert in_time(float(seconds), SECONDS), f"{seconds} s"
    assert int(kilobytes) < 1000 * MEGABYTES
    return code, lines


def assert_refusal(lines: list[str], reason: str) -> None:
    assert lines
    for line in lines:
        assert re.search(reason, line) or re.fullmatch(r"and \d+ more like these", line)
        assert line.startswith(("robot.urdf", "and "))
        assert len(line) < 500
