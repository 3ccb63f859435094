"""Commands return the documented exit codes, print one clear line per error and write no partial files."""

import contextlib
import json
import os
import re
import subprocess
import sys
from pathlib import Path

import pytest
from typer.testing import CliRunner

from spelgen import __version__
from spelgen.cli.main import app
from spelgen.fitting.process import TrainingProgress

ROOT = Path(__file__).parents[1]
COMMANDS = [
    "inspect",
    "build",
    "simulate",
    "excite",
    "logs",
    "train",
    "evaluate",
    "estimate",
    "report",
    "check",
]


@pytest.fixture
def spelgen(tmp_path, monkeypatch):
    """Return a function that runs a command in this process, in an empty folder."""
    monkeypatch.chdir(tmp_path)
    return lambda *arguments: CliRunner().invoke(app, [str(each) for each in arguments])


def process(*arguments, **options):
    """Run a command in a process of its own; return its result."""
    command = [sys.executable, "-m", "spelgen", *map(str, arguments)]
    environment = os.environ | {"PYTHONPATH": str(ROOT)}
    return subprocess.run(command, capture_output=True, text=True, env=environment, timeout=120, **options)


def everything(folder: Path) -> list[str]:
    return sorted(str(path.relative_to(folder)) for path in folder.rglob("*") if path.is_file())


# ---- help, version and listings


def test_version(spelgen):
    assert spelgen("--version").stdout == f"spelgen {__version__}\n"


@pytest.mark.parametrize("command", ["", *COMMANDS])
def test_help_fits_80_columns(spelgen, command):
    result = spelgen(*filter(None, [command]), "--help")
    assert result.exit_code == 0
    assert max(map(len, result.stdout.splitlines())) <= 80


@pytest.mark.parametrize("command", COMMANDS)
def test_every_option_has_a_help_text(spelgen, command):
    options = re.split(r"^  (?=-)", spelgen(command, "--help").stdout, flags=re.MULTILINE)[1:]
    assert len(options) >= 2
    for option in options:
        assert re.search(r"(\s{2,}|\n\s+)(\[[a-z, ]+\] )?[A-Za-z]\S*[ ,.]", option.split("\n\n")[0]), option


def test_help_and_inspect_load_nothing_heavy(robots):
    """`--help` and `inspect` import no large package, each of which would double their duration."""
    heavy = {
        "torch",
        "scipy",
        "pandas",
        "pyarrow",
        "casadi",
        "mujoco",
        "pinocchio",
        "onnx",
        "sympy",
        "trimesh",
        "ray",
    }
    run = "import sys; from spelgen.cli.main import app; app({!r}, standalone_mode=False)"
    run += "; print({!r} & set(sys.modules))"
    help_too = {"numpy", "lxml", "flint"}
    for arguments, absent in (["--help"], heavy | help_too), (["inspect", str(robots / "rpr.urdf")], heavy):
        done = subprocess.run(
            [sys.executable, "-c", run.format(arguments, absent)],
            capture_output=True,
            text=True,
            cwd=ROOT,
            check=False,
        )
        assert done.stdout.splitlines()[-1] == "set()", done.stderr


# ---- results on standard output, messages on standard error, and files


def test_inspect_text_fits_80_columns(spelgen, robots):
    for urdf in robots.glob("*.urdf"):
        result = spelgen("inspect", urdf)
        assert result.exit_code == 0
        assert max(map(len, result.stdout.splitlines())) <= 80


def test_inspect_json_is_the_python_result(spelgen, robots):
    import spelgen as package

    told = json.loads(spelgen("inspect", robots / "rpr.urdf", "--format", "json").stdout)
    assert told == json.loads(json.dumps(package.inspect(robots / "rpr.urdf").to_dict()))
    assert told["schema"] == 1


def test_inspect_writes_a_file(spelgen, robots, tmp_path):
    shown = spelgen("inspect", robots / "rpr.urdf").stdout
    assert spelgen("inspect", robots / "rpr.urdf", "-o", "deep/er.txt").exit_code == 0
    assert (tmp_path / "deep" / "er.txt").read_text(encoding="utf-8") == shown


@pytest.mark.parametrize(
    ("command", "forms"),
    [
        ("inspect {urdf} -o page.pdf", ".txt, .json, .html, .py"),
        ("report run -o page.pdf", ".html"),
        ("estimate run --data logs -o page.txt", ".html"),
    ],
)
def test_a_suffix_without_a_format_is_one_error_that_names_the_forms(spelgen, robots, command, forms):
    result = spelgen(*command.format(urdf=robots / "rpr.urdf").split())
    name = command.split()[-1]
    expected = f"Invalid value for '--output': '{name}' has no suffix of a format of this command: {forms}"
    assert result.exit_code == 2
    assert expected in " ".join(result.stderr.replace("│", " ").split())


def test_a_run_to_resume_that_does_not_exist_is_named_as_it_was_given(spelgen):
    result = spelgen("train", "mine", "--resume", "--data", "logs")
    assert result.exit_code == 1
    assert result.stderr == (
        "--resume: no run: mine is no folder, and there is no runs/mine, the default folder of this module; name the "
        "run folder, or pass it by -o\n"
    )


def test_logs_without_the_option_are_to_be_named_by_it(spelgen, robots, tmp_path):
    logs = tmp_path / "log.csv"
    for given, told in (([str(logs)], "write it before the logs"), ([], "name at least one file or folder")):
        result = spelgen("identify", str(robots / "rpr.urdf"), *given)
        assert result.exit_code == 2 and f"'--data': {told}" in result.output


def test_strict_fails_on_a_warning_only(spelgen, robots, tmp_path):
    assert spelgen("inspect", robots / "rpr.urdf", "--strict").exit_code == 0
    text = (robots / "rpr.urdf").read_text(encoding="utf-8")
    (tmp_path / "odd.urdf").write_text(
        text.replace('lower="0.305" upper="1.27"', 'lower="1.27" upper="0.305"')
    )
    assert spelgen("inspect", "odd.urdf").exit_code == 0
    failed = spelgen("inspect", "odd.urdf", "--strict")
    assert failed.exit_code == 1
    assert "odd.urdf: 1 warning, and --strict allows none" in failed.stderr


def test_build_and_check(spelgen, robots, tmp_path):
    (tmp_path / "arm.urdf").write_bytes((robots / "scara.urdf").read_bytes())
    assert spelgen("build", "arm.urdf").stdout == "wrote arm_spel.py\n"
    assert spelgen("build", "arm.urdf").stdout == "arm_spel.py is up to date\n"
    assert spelgen("check", "arm_spel.py").stdout.startswith(
        "arm_spel.py is up to date with arm.urdf; 10 facts"
    )
    text = (tmp_path / "arm.urdf").read_text(encoding="utf-8")
    (tmp_path / "arm.urdf").write_text(text + "<!-- changed -->\n", encoding="utf-8")
    stale = spelgen("check", "arm_spel.py")
    assert stale.exit_code == 1
    assert "arm.urdf has changed since the module was built" in stale.stderr
    assert stale.stdout == ""


def test_module_run_is_the_command(robots):
    assert process("--version").stdout == f"spelgen {__version__}\n"


# ---- errors: one line on stderr, exit 1, nothing written


def refused(result) -> str:
    """Return the one line on stderr of a refused command: exit code 1, empty stdout, no traceback."""
    assert result.exit_code == 1
    assert result.stdout == ""
    assert result.stderr.count("\n") == 1
    assert "Traceback" not in result.stderr
    return result.stderr.strip()


@pytest.mark.parametrize("command", [["inspect"], ["build"], ["simulate", "-o", "logs"]], ids=lambda c: c[0])
@pytest.mark.parametrize(
    "content, told",
    [
        (None, r"arm\.urdf: .*no such file"),
        ("no xml at all", r"arm\.urdf:1: .+"),
        ("<robot name='x'><link name='a'/></robot>", r"arm\.urdf:1: .*joint.*"),
    ],
    ids=["missing", "not-xml", "no-joints"],
)
def test_unusable_urdf(spelgen, tmp_path, command, content, told):
    if content is not None:
        (tmp_path / "arm.urdf").write_text(content)
    before = everything(tmp_path)
    line = refused(spelgen(command[0], "arm.urdf", *command[1:]))
    assert re.match(told, line, re.IGNORECASE), line
    assert everything(tmp_path) == before


def test_unknown_joint(spelgen, robots):
    line = refused(spelgen("inspect", robots / "rpr.urdf", "--joints", "joint1,joint9"))
    assert "'joint9'" in line and "joint3" in line


def test_existing_output_is_kept(spelgen, robots, tmp_path):
    (tmp_path / "rpr_spel.py").write_text("mine")
    line = refused(spelgen("build", robots / "rpr.urdf"))
    assert line == "rpr_spel.py: this output exists already; --force replaces it, -o names another"
    assert (tmp_path / "rpr_spel.py").read_text() == "mine"
    assert spelgen("build", robots / "rpr.urdf", "--force").exit_code == 0
    assert (tmp_path / "rpr_spel.py").read_text().startswith('r"""')


def test_output_that_cannot_be_written(spelgen, robots, tmp_path):
    (tmp_path / "file").write_text("")
    line = refused(spelgen("inspect", robots / "rpr.urdf", "-o", "file/below"))
    assert line.startswith("file: ") or line.startswith("file/below: ")


@pytest.mark.parametrize(
    "content, told",
    [
        (None, "logs.csv: got no such file or folder"),
        ("t,q_joint1\n0,1\n", "logs.csv: missing columns "),
        ("\x00\x01", "logs.csv: "),
    ],
    ids=["missing", "columns", "garbage"],
)
def test_unreadable_logs(spelgen, robots, tmp_path, content, told):
    assert spelgen("build", robots / "rpr.urdf").exit_code == 0
    if content is not None:
        (tmp_path / "logs.csv").write_text(content)
    before = everything(tmp_path)
    assert refused(
        spelgen("train", "rpr_spel.py", "--data", "logs.csv", "--set", "progress=false")
    ).startswith(told)
    assert everything(tmp_path) == before


def test_the_settings_name_the_columns_of_logs_and_a_mapping_file_comes_first(spelgen, robots, tmp_path):
    for suffix in (".urdf", ".yaml"):
        (tmp_path / f"rpr{suffix}").write_bytes((robots / f"rpr{suffix}").read_bytes())
    with (tmp_path / "rpr.yaml").open("a") as file:
        file.write("logs: {columns: {t: clock}}\n")
    assert spelgen("build", "rpr.urdf").exit_code == 0
    (tmp_path / "logs.csv").write_text("t,q\n0,1\n")
    assert "missing columns clock, q_joint1" in refused(spelgen("train", "rpr_spel.py", "--data", "logs.csv"))
    (tmp_path / "mine.yaml").write_text("columns: {t: stamp}\njoints: {joint1: {name: J1}}\n")
    command = ["train", "rpr_spel.py", "--data", "logs.csv", "--mapping", "mine.yaml"]
    assert "missing columns stamp, q_J1" in refused(spelgen(*command))
    (tmp_path / "mine.yaml").write_text("joints: {joint7: {sign: -1}}\n")
    assert refused(spelgen(*command)).startswith("mine.yaml:1: joints: unknown joint 'joint7'; did you mean")


@pytest.mark.parametrize("command", ["train", "check"])
def test_foreign_module(spelgen, tmp_path, command):
    (tmp_path / "other.py").write_text("print('not ours')\n")
    (tmp_path / "logs.csv").write_text("t\n")
    data = ["--data", "logs.csv"] if command == "train" else []
    assert refused(spelgen(command, "other.py", *data)).startswith("other.py: ")


@pytest.mark.parametrize("command", [["evaluate", "--data", "logs"], ["report"]], ids=lambda c: c[0])
def test_no_run(spelgen, tmp_path, command):
    line = refused(spelgen(command[0], "nothing", *command[1:]))
    assert line.startswith("nothing: ") and "spelgen train" in line
    assert everything(tmp_path) == []


def test_debug_shows_the_traceback(spelgen):
    plain, debug = spelgen("inspect", "no.urdf"), spelgen("inspect", "no.urdf", "--debug")
    assert debug.exit_code == 1
    assert "Traceback (most recent call last)" in debug.stderr
    assert debug.stderr.endswith(plain.stderr)


def test_unexpected_errors_are_named(spelgen, robots, monkeypatch):
    def broken(*arguments, **options):
        raise ZeroDivisionError("division\nby zero")

    monkeypatch.setattr("spelgen.arm.configured_arm.load_arm", broken)
    line = refused(spelgen("inspect", robots / "rpr.urdf"))
    assert line == "spelgen: unexpected ZeroDivisionError: division by zero; --debug shows where"


def test_missing_extra_is_named(robots, tmp_path):
    code = "import sys; sys.modules['pinocchio'] = None; from spelgen.cli.main import main; main()"
    command = [sys.executable, "-c", code, "simulate", str(robots / "rpr.urdf"), "-o", str(tmp_path / "logs")]
    done = subprocess.run(command, capture_output=True, text=True, cwd=ROOT, check=False)
    assert done.returncode == 1
    assert "pip install 'spelgen[simulate]'" in done.stderr and done.stderr.count("\n") == 1
    assert everything(tmp_path) == []


def test_names_cannot_steer_the_terminal(spelgen, tmp_path):
    (tmp_path / "a\x1b[31mb.urdf").write_text("no xml")
    assert "\x1b" not in spelgen("inspect", "a\x1b[31mb.urdf").stderr


# ---- usage errors: exit 2


@pytest.mark.parametrize(
    "arguments",
    [
        ["inspect"],
        ["nonsense"],
        ["inspect", "a.urdf", "--jionts", "x"],
        ["inspect", "a.urdf", "--format", "yaml"],
        ["inspect", "a.urdf", "--assume", "everything"],
        ["inspect", "a.urdf", "--angle-tolerance", "-1"],
        ["build", "a.urdf", "--preset", "magic"],
        ["simulate", "a.urdf"],
        ["train", "m.py"],
        ["train", "m.py", "--data", "x", "--set", "epochs=0"],
        ["evaluate", "run"],
    ],
    ids=" ".join,
)
def test_usage_errors(spelgen, arguments):
    result = spelgen(*arguments)
    assert result.exit_code == 2
    assert "Error: " in result.stderr
    assert result.stdout == ""


def test_data_may_be_followed_by_several(spelgen, robots, tmp_path):
    assert spelgen("build", robots / "rpr.urdf").exit_code == 0
    result = spelgen("train", "rpr_spel.py", "--data", "a.csv", "b.csv")
    assert result.exit_code == 1
    first, others = result.stderr.splitlines()
    assert first.startswith("a.csv: ")
    assert others == "  the same: b.csv"


# ---- signals and pipes


def test_closed_pipe_is_quiet(robots):
    reader, writer = os.pipe()
    os.close(reader)
    command = [sys.executable, "-m", "spelgen", "inspect", str(robots / "panda.urdf")]
    done = subprocess.run(command, stdout=writer, stderr=subprocess.PIPE, cwd=ROOT, timeout=60, check=False)
    os.close(writer)
    assert done.stderr == b""
    assert done.returncode == 141


@pytest.mark.parametrize("importing", [False, True])
def test_interrupt_exits_130(spelgen, robots, monkeypatch, importing):
    def interrupted(*arguments, **options):
        if importing:  # the exception that compiled modules raise when an import is interrupted
            raise ImportError("initialization failed") from KeyboardInterrupt()
        raise KeyboardInterrupt

    monkeypatch.setattr("spelgen.arm.configured_arm.load_arm", interrupted)
    result = spelgen("inspect", robots / "rpr.urdf")
    assert (result.exit_code, result.stderr) == (130, "interrupted\n")


def test_a_termination_ends_a_command_as_ctrl_c_does(robots, tmp_path):
    (tmp_path / "live.urdf").symlink_to(robots / "rpr.urdf")
    ends = (
        "import os, signal; import spelgen.arm.configured_arm as arms; from spelgen.cli.main import main; "
        "arms.load_arm = lambda *_, **__: os.kill(os.getpid(), signal.SIGTERM); main()"
    )
    command = [sys.executable, "-c", ends, "inspect", "live.urdf"]
    done = subprocess.run(command, capture_output=True, text=True, cwd=tmp_path, timeout=60, check=False)
    assert (done.returncode, done.stderr) == (130, "interrupted\n")


# ---- from a URDF to a report, with little data


@pytest.fixture(scope="module")
def trained(robots, tmp_path_factory):
    """Run build, simulate, train, evaluate and report in a folder, with little data and training; return the folder."""
    folder = tmp_path_factory.mktemp("whole")
    for suffix in (".urdf", ".yaml"):
        text = (robots / f"two_link{suffix}").read_text(encoding="utf-8")
        (folder / f"arm{suffix}").write_text(
            re.sub(r"trajectories: \d+", "trajectories: 6", text).replace(
                "  window: 5", "  window: 5\n  momentum_steps: 10"
            ),
            encoding="utf-8",
        )
    steps = {
        "build": ["build", "arm.urdf"],
        "simulate": ["simulate", "arm.urdf", "-o", "logs"],
        "train": ["train", "arm_spel.py", "--data", "logs", "-o", "run", "--set", "epochs=2"],
        "evaluate": ["evaluate", "run", "--data", "logs"],
        "report": ["report", "run"],
    }
    with contextlib.chdir(folder):
        return folder, {name: CliRunner().invoke(app, words) for name, words in steps.items()}


def test_all_commands_succeed(trained):
    folder, results = trained
    for name, result in results.items():
        assert result.exit_code == 0, (name, result.stderr)
        assert max(map(len, result.stdout.splitlines())) <= 80, name
    assert {"arm_spel.py", "logs/train.parquet", "logs/test.parquet", "run/report.html"} <= set(
        everything(folder)
    )


def test_evaluate_shows_baselines(trained):
    _, results = trained
    assert "velocity stays constant" in results["evaluate"].stdout


def test_a_second_run_needs_force_or_resume(trained, monkeypatch):
    folder, _ = trained
    monkeypatch.chdir(folder)
    command = ["train", "arm_spel.py", "--data", "logs", "-o", "run"]
    again = CliRunner().invoke(app, command)
    assert again.exit_code == 1
    assert again.stderr.startswith("run: ") and "--resume" in again.stderr
    more = CliRunner().invoke(app, [*command, "--resume", "--set", "epochs=3"])
    assert more.exit_code == 0, more.stderr
    assert "after 3 epochs" in more.stdout


def test_interrupted_training_writes_a_usable_run(spelgen, trained, tmp_path, monkeypatch):
    """Ctrl-C in the first epoch ends `train` with exit code 130 and a run that can be used and resumed."""

    def interrupt(*_):
        raise KeyboardInterrupt

    folder, _ = trained
    monkeypatch.chdir(folder)
    command = ["train", "arm_spel.py", "--data", "logs", "-o", tmp_path / "run"]
    with monkeypatch.context() as patch:
        patch.setattr(TrainingProgress, "epoch", interrupt)
        done = spelgen(*command, "--set", "optimizer=adamw", "--set", "momentum_steps=0")
    assert done.exit_code == 130, done.stderr
    assert "interrupted after" in done.stdout
    assert spelgen("report", tmp_path / "run").exit_code == 0


# ---- misspelt commands, options and values


def test_bare_command_shows_the_help(spelgen):
    assert spelgen().exit_code == 0
    assert spelgen().stdout == spelgen("-h").stdout == spelgen("--help").stdout


def test_help_shows_whole_sentences(spelgen):
    commands = spelgen("--help").stdout.partition("Commands:\n")[2].splitlines()
    assert len(commands) == 14
    assert all(line.endswith(".") and not line.endswith("...") for line in commands)


@pytest.mark.parametrize(
    ("words", "told"),
    [
        (["trian"], "No such command 'trian'. Did you mean 'train'?"),
        (["train", "--objectve", "rollout"], "No such option: --objectve. Did you mean --objective?"),
        (["train", "m.py", "--set", "epoch=3"], "--set: unknown key 'epoch'; did you mean 'epochs'?"),
        (["train", "m.py", "--set", "epochs"], "--set: got 'epochs', expected KEY=VALUE"),
        (["train", "m.py", "--set", "solver=rk5"], "--set solver: got 'rk5', expected 'rk4' or 'dopri5'"),
        (
            ["train", "m.py", "--set", "prior.body=1"],
            "--set prior: unknown key 'body'; did you mean 'bodies'?",
        ),
        (
            ["build", "x.urdf", "--assume", "inertal"],
            "'inertal' is none of kinematics, inertials. Did you mean 'inertials'?",
        ),
        (["logs", "x", "--robot", "y", "--format", "xml"], "'xml' is none of text, json."),
    ],
)
def test_the_likely_name_is_suggested(spelgen, words, told):
    result = spelgen(*words)
    assert result.exit_code == 2
    assert result.stderr.rstrip().endswith(told)


@pytest.mark.parametrize("command", COMMANDS)
def test_values_have_names_that_people_read(spelgen, command):
    assert not re.search(r"--\S+ <|\{|INTEGER|list\[", spelgen(command, "-h").stdout)


def test_completion_completes_commands_options_and_choices():
    def completed(words):
        asked = {
            "_SPELGEN_COMPLETE": "complete_bash",
            "COMP_WORDS": words,
            "COMP_CWORD": str(len(words.split()) - 1),
        }
        command = [sys.executable, "-m", "spelgen"]
        environment = os.environ | {"PYTHONPATH": str(ROOT)} | asked
        return subprocess.run(
            command, capture_output=True, text=True, env=environment, check=False
        ).stdout.split()

    assert completed("spelgen tr") == ["train"]
    assert completed("spelgen train --objective rol") == ["rollout"]
