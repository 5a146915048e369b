# SPDX-License-Identifier: Apache-2.0
"""What is loaded when: the package and its help are light, and methods load what they need."""

import ast
import signal
from importlib import import_module
from pathlib import Path

import pytest

import ohmskin
from command_line import python
from ohmskin.cli.main import app, run
from ohmskin.ctrl_c import ctrl_c_kept

# What takes long to load, and only some commands or methods need.
HEAVY = {
    "numpy",
    *("casadi", "mcap", "matplotlib", "typer", "rich", "starlette", "joblib", "threadpoolctl"),
    *("scipy.signal", "scipy.sparse", "scipy.optimize", "scipy.ndimage"),
}
HELP = """
from ohmskin.cli.main import app
app(["--help"], prog_name="ohmskin", standalone_mode=False)
"""
DEMO = """
import builtins
from ohmskin.cli.main import app
kept, builtins.print = builtins.print, lambda *_, **__: 1 / 0
try: app(["demo"], prog_name="ohmskin", standalone_mode=False)
except ZeroDivisionError: builtins.print = kept
"""
JOINT = """
import numpy as np, ohmskin
estimator = ohmskin.make_estimator("joint", ohmskin.SkinKnowledge(2, 2))
assert estimator.estimate(np.tile([0.9, 0.1, 0.9, 0.1], (2, 2, 1))).converged
"""


def loaded_after(program: str) -> set[str]:
    """Modules that a process of its own has loaded at the end of this program."""
    done = python("-c", f"{program}\nimport sys; print(*sys.modules, file=sys.stderr)")
    assert done.code == 0, done.err
    return set(done.err.split())


@pytest.mark.parametrize(
    ("program", "allowed"),
    [
        ("import ohmskin", set()),
        (HELP, {"typer", "rich"}),
        (DEMO, {"typer"}),  # before its first word
        (JOINT, {"numpy", "threadpoolctl"}),
    ],
    ids=["package", "help", "demo", "joint"],
)
def test_nothing_heavy_is_loaded(program: str, allowed: set[str]) -> None:
    # SciPy 1.11 loads more by itself than newer ones.
    base = loaded_after("import scipy.linalg") if "numpy" in allowed else set()
    assert (loaded_after(program) - base) & HEAVY == allowed - base


def test_only_a_paper_method_loads_casadi() -> None:
    program = "import ohmskin\nmake = ohmskin.make_estimator\nknown = ohmskin.SkinKnowledge(1, 1)\n"
    others = [name for name in ohmskin.METHODS if name not in ("lsq", "regularized")]
    assert len(others) == 4
    assert "casadi" not in loaded_after(program + f"for name in {others}: make(name, known)")
    assert "casadi" in loaded_after(program + "make('lsq', known)")


def test_every_public_name_is_found() -> None:
    for name in ohmskin.__all__:
        assert name in dir(ohmskin)
        assert getattr(ohmskin, name) is not None
    with pytest.raises(AttributeError, match="no attribute 'oepn'"):
        _ = ohmskin.oepn


def test_a_type_checker_finds_the_same_public_names_from_the_same_modules() -> None:
    tree = ast.parse(Path(ohmskin.__file__).read_text())
    (block,) = (node for node in tree.body if isinstance(node, ast.If) and len(node.body) > 1)
    imports = [node for node in block.body if node.module.startswith("ohmskin.")]
    checked = {name.asname: node.module for node in imports for name in node.names}
    assert checked.keys() == {*ohmskin.__all__, "__version__"}
    for name, module in checked.items():
        assert getattr(import_module(module), name) is getattr(ohmskin, name)
    # A list that it cannot compute would leave nothing for `from ohmskin import *`.
    assigned = [node.targets[0].id for node in tree.body if isinstance(node, ast.Assign)]
    assert "__all__" not in assigned


@pytest.mark.parametrize("name", app.commands)
def test_the_list_of_commands_says_what_a_command_says_of_itself(name: str) -> None:
    listed = app.commands[name]
    own = listed.load().help.split("\n\n")[0]
    assert listed.help == " ".join(own.split())


def test_ctrl_c_during_an_import_is_ctrl_c_and_no_error_of_the_import() -> None:
    def import_something(**_: object) -> None:
        try:
            signal.raise_signal(signal.SIGINT)
        except KeyboardInterrupt as exc:
            raise ImportError("initialization failed") from exc

    with pytest.raises(KeyboardInterrupt), ctrl_c_kept():
        import_something()
    with pytest.raises(SystemExit, match="130"):
        run(import_something, "ohmskin")


def test_ctrl_c_that_was_handled_does_not_end_the_process_as_a_signal() -> None:
    """Python remembers one that falls into an executed text, as of a dataclass."""
    handled = "try: exec('raise KeyboardInterrupt')\nexcept KeyboardInterrupt: pass\n"
    program = f"from ohmskin.cli import main\nmain.run = lambda *_: exec({handled!r})\nmain.main()"
    assert python("-c", program).code == 0


# Ctrl-C comes when the command line begins to import this module, or has ended.
INTERRUPTED = """
import atexit, builtins, os, signal, sys
from ohmskin.__main__ import main
at, real = sys.argv.pop(1), builtins.__import__
def interrupt(): os.kill(os.getpid(), signal.SIGINT)
def imports(name, *more):
    if name == at.removeprefix("deaf "):
        try: interrupt()
        except KeyboardInterrupt:
            if name == at: raise  # else it is lost, as in a callback of a weak reference
    return real(name, *more)
builtins.__import__ = imports
if at == "end": atexit.register(interrupt)
main()
"""


@pytest.mark.parametrize("at", ["typer", "numpy", "deaf numpy", "deaf rich.columns", "end"])
def test_ctrl_c_amid_imports_shows_no_traceback(at: str) -> None:
    done = python("-c", INTERRUPTED, at, "demo")
    assert done.code in (130, -signal.SIGINT)
    assert done.err == ""


def test_nothing_is_imported_before_ctrl_c_ends_the_process() -> None:
    """While Python imports something, it shows a traceback of that."""
    imports = "import sys; before = {*sys.modules, '_signal'}; import ohmskin.__main__"
    done = python("-c", f"{imports}; print(*sorted(sys.modules.keys() - before))")
    assert done.out.split() == ["ohmskin", "ohmskin.__main__"]


DROPPED = """
import os, signal, time
from ohmskin.cli import main
class Dies:
    def __del__(self): os.kill(os.getpid(), signal.SIGINT)
def command(**_):
    Dies()
    time.sleep(20)
main.app = command
main.main()
"""


def test_ctrl_c_that_python_drops_comes_again() -> None:
    """As in the callback of a weak reference, which each import has."""
    done = python("-c", DROPPED)
    assert (done.code, done.err) == (130, "")


# A call in which Python sees no signal, as in CasADi. It would take days.
DEAF = """
import hashlib, os
from ohmskin.ctrl_c import ends_in_time
with ends_in_time(lambda: os.write(1, b"left")):
    os.kill(os.getpid(), 2) if {early} else None
    os.posix_spawn("/bin/sh", ["sh", "-c", f"sleep 2; kill -2 {{os.getpid()}}"], {{}})
    hashlib.pbkdf2_hmac("sha256", b"", b"", 2**31 - 1, 2**20)
"""


def test_ctrl_c_ends_what_does_not_see_it() -> None:
    """`lsq` needed 11 s for that."""
    done = python("-c", DEAF.format(early=False))
    assert (done.code, done.out, done.err) == (130, "left", "")
    done = python("-c", DEAF.format(early=True))
    assert done.code == -signal.SIGINT
    assert "KeyboardInterrupt" in done.err  # the body has ended in time, as without it


def test_ctrl_c_that_was_ignored_stays_so() -> None:
    done = python("-c", f"import signal; signal.signal(2, signal.SIG_IGN)\n{INTERRUPTED}", "typer")
    assert (done.code, done.err) == (2, "")
