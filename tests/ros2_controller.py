"""The exported ros2_control controller, compiled against substitutes of the ROS 2 headers, and a simulated arm."""

import ctypes
import subprocess
from pathlib import Path

import numpy as np

from spelgen.exporting.c_export import called_by_c, compile_library, compiler
from spelgen.exporting.c_source import c_functions, write_c
from spelgen.exporting.describe import Trained

STUBS = Path(__file__).parent / "ros2_stubs"
PERIOD = 1e-3
TEXT = ctypes.c_char_p


def array(values):
    """Return an array as a pointer for the C library, and the array itself, which must stay alive during the call."""
    values = np.ascontiguousarray(values, dtype=float)
    return values.ctypes.data_as(ctypes.c_void_p), values


def compiled(package: Path, folder: Path, *flags: str) -> ctypes.CDLL:
    """Compile the exported controller with the harness that calls it; any compiler warning fails the test."""
    (name,) = (path.stem for path in (package / "src").glob("*.c") if not path.stem.endswith("_estimator"))
    include, library = [f"-I{STUBS}", f"-I{package / 'src'}"], folder / "controller.so"
    warnings = ["-O1", "-fPIC", "-Wall", "-Wextra", "-Werror"]
    objects = []
    for source in sorted((package / "src").glob(f"{name}*.c")):
        objects.append(folder / f"{source.stem}.o")
        subprocess.run(["gcc", "-std=c99", *warnings, "-c", source, "-o", objects[-1]], check=True)
    # The controller is included in the harness: to compile the headers once instead of twice saves a third of the time.
    # -Wno-subobject-linkage: gcc warns of included classes with fields whose types are in an anonymous namespace.
    sources = [
        "-Wno-subobject-linkage",
        "-include",
        package / "src" / "controller.cpp",
        STUBS / "harness.cpp",
    ]
    command = ["g++", "-std=c++17", *warnings, "-Wpedantic", "-shared", "-Wl,-Bsymbolic", *flags, *include]
    done = subprocess.run(
        [*command, *sources, *objects, "-o", library, "-lm"], capture_output=True, text=True, check=False
    )
    assert not done.returncode, done.stderr
    loaded = ctypes.CDLL(str(library))
    texts = "start interfaces set set_text set_flag ranges parameters state log joint_state wrench payload"
    for function in texts.split():
        getattr(loaded, f"harness_{function}").restype = TEXT
    loaded.harness_new.restype = ctypes.c_void_p
    loaded.harness_update.restype = ctypes.c_long
    return loaded


class Controller:
    """The exported controller with n joints, run by the harness; ``parameters`` are its ROS parameters.

    Raises ValueError if the controller refuses to start.
    """

    def __init__(self, library, n, **parameters):
        self.library, self.n = library, n
        self.handle = ctypes.c_void_p(library.harness_new(b"arm"))
        self.time = 1.7e9
        self.commands = np.zeros(n)
        self.allocations = 0
        for name, value in parameters.items():
            if isinstance(value, str):
                self.call("text", name.encode(), value.encode())
            elif isinstance(value, bool):
                self.call("flag", name.encode(), int(value))
            else:
                pointer, values = array(np.atleast_1d(value))
                self.call("numbers", name.encode(), pointer, len(values) if np.ndim(value) else -1)
        error = self.call("start")
        if error is not None:
            raise ValueError(error.decode())

    def call(self, name, *arguments):
        return getattr(self.library, f"harness_{name}")(self.handle, *arguments)

    def update(self, q, qd, effort=None, period=PERIOD, available=True):
        """Run a control cycle of `period` [s]; return the commanded torques (n,) [Nm, N].

        q, qd, effort: (n,) values of the state interfaces. available: False if these values cannot be read.
        """
        self.time += period
        states = [q, qd] if effort is None else [q, qd, effort]
        pointer, _states = array(np.concatenate([np.asarray(x, float) for x in states]))
        commands, self.commands = array(np.full(self.n, np.nan))
        time, duration = ctypes.c_double(self.time), ctypes.c_double(period)
        count = self.call("update", time, duration, pointer, int(available), commands)
        assert count >= 0, "the controller reported an error"
        self.allocations += count
        return self.commands

    def reference(self, q, qd=(), qdd=()):
        """Publish a reference on the controller's topic: positions, velocities, accelerations, (n,) or empty each."""
        arguments = []
        for values in (q, qd, qdd):
            pointer, kept = array(values)
            arguments += [pointer, len(kept)]
        self.call("reference", *arguments)

    def write(self, *values):
        """Write the reference interfaces of the controller: positions, then velocities, then accelerations, (n,)."""
        for index, value in enumerate(np.concatenate(values)):
            self.call("write", index, ctypes.c_double(value))

    def set(self, name, value):
        """Set a ROS parameter of the controller; return the reason if it is refused, None otherwise."""
        if isinstance(value, str):
            reason = self.call("set_text", name.encode(), value.encode())
        else:
            pointer, values = array(np.atleast_1d(value))
            reason = self.call("set", name.encode(), pointer, len(values) if np.ndim(value) else -1)
        return None if reason is None else reason.decode()

    def text(self, name):
        """Call a function of the C++ test harness that has no arguments, and return its result, a text.

        name: name of the function without "harness_", such as "state", "interfaces", "ranges" or "log".
        """
        return self.call(name).decode()

    def joint_state(self, topic):
        """Return {joint name: effort} of the last JointState message of a topic."""
        self.text("state")
        pointer, efforts = array(np.zeros(self.n))
        return dict(
            zip(self.call("joint_state", topic.encode(), pointer).decode().split(), efforts, strict=False)
        )

    def wrench(self):
        """Return frame and values (6,) of the last message of the external wrench at the tip."""
        self.text("state")
        pointer, values = array(np.zeros(6))
        return self.call("wrench", pointer).decode(), values

    def payload(self):
        """Return frame and values of the last payload message, or None if there was none.

        Values: mass, centre (3), inertia (6), interval of the mass (2).
        """
        self.text("state")
        pointer, values = array(np.zeros(12))
        frame = self.call("payload", pointer)
        return None if frame is None else (frame.decode(), values)

    def deactivate(self):
        """Deactivate the controller; return its last commands, (n,)."""
        pointer, commands = array(np.full(self.n, np.nan))
        assert self.call("deactivate", pointer)
        return commands

    def activate(self):
        """Activate the controller again."""
        assert self.call("activate")


class SimulatedArm:
    """An arm simulated by the exported C of a model: semi-implicit Euler, torques constant over a control period."""

    def __init__(self, model, arm, folder: Path):
        names = ["forward_dynamics", "friction_step", "friction_memory"]
        self.folder = folder
        (folder / "plant").mkdir()
        trained = Trained(model, arm, tuple(names))
        functions = c_functions(trained.described, trained.entry_points)
        program = compiler()
        assert program
        source = write_c(trained.described, functions, folder / "plant")
        self.call = called_by_c(compile_library(source, program), functions)

    def evaluate(self, name, **inputs):
        """Return the first output of an exported function at inputs without batch dimension."""
        (value,) = self.call(name, {"q": np.zeros((1, 1))} | {k: x[None] for k, x in inputs.items()}).values()
        return value[0]

    def start(self, q, qd=None):
        """Set the initial state of the arm, with friction states of steady sliding at qd (0 at rest)."""
        self.q = np.array(q, dtype=float)
        self.qd = np.zeros_like(self.q) if qd is None else np.array(qd, dtype=float)
        self.z = self.evaluate("friction_memory", qd=self.qd)

    def step(self, tau, period=PERIOD, substeps=4):
        """Integrate the arm over one control period under torques (n,)."""
        for _ in range(substeps):
            qdd = self.evaluate("forward_dynamics", q=self.q, qd=self.qd, tau=tau, z=self.z)
            self.qd = self.qd + period / substeps * qdd
            moved = period / substeps * self.qd
            self.q, self.z = self.q + moved, self.evaluate("friction_step", z=self.z, dq=moved)

    def run(self, controller, seconds, at_each=None, period=PERIOD):
        """Run the controller on the arm; return positions, velocities and torques, (T, n) each.

        at_each: function of the time [s] that is called before each control cycle.
        """
        rows = []
        for cycle in range(round(seconds / period)):
            if at_each is not None:
                at_each(cycle * period)
            tau = controller.update(self.q, self.qd, period=period)
            rows.append((self.q, self.qd, tau))
            self.step(tau, period)
        return [np.array(values) for values in zip(*rows, strict=True)]
