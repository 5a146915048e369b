# SPDX-License-Identifier: Apache-2.0
"""The command line: ``ohmskin --help``. An error is one line that says what to do, exit code 2.

A command's module is imported when the command is run, or asked for its help.
"""

import sys
from collections.abc import Callable
from importlib import import_module
from typing import Annotated, Any, Final

import typer
from typer.core import TyperCommand, TyperGroup

import ohmskin
from ohmskin.ctrl_c import ctrl_c_kept, forget_ctrl_c, raise_again
from ohmskin.errors import OhmskinError

# The module and function of each command, and what the list of commands says of it. That is the
# first paragraph of the command's own help, and a test compares both. It stands here, too, because
# `ohmskin --help` would take seconds if it imported all these modules.
_COMMANDS: Final = {
    "board.ports": "List serial ports, and the kinds of ports that need no board.",
    "board.info": "Say what board is at PORT and how it scans.",
    "board.configure": "Change how the board scans, until its reset or for good (--save).",
    "board.flash": "Write the firmware to a board, and check that it answers.",
    "stream.stream": "Show the skin at PORT, live, or print every scan as JSON. Ctrl-C ends it.",
    "view.view": "Show skins live on a page in the browser: heat map, contacts, tare, recording.",
    "calibrate.tare": "Take what the skin at PORT reads now for no force: nothing may touch it.",
    "skin.skin": "Show a calibration file; say where its cells are, and draw them.",
    "doctor.doctor": "Say what is wrong with the board at PORT, and what to do. Touch nothing.",
    "verify.verify": "Compare the board at PORT with a plate of known resistors.",
    "record.estimate": "Estimate every cell of every frame of a readings file.",
    "record.record": "Record every scan at PORT. Ctrl-C ends it; a line typed becomes a mark.",
    "record.export": "Write recordings as .npz or .csv: readings, or forces by a calibration.",
    "emulate.emulate": "Serve an emulated board at a pseudo-terminal. Ctrl-C ends it.",
    "demo.demo": "Scan an emulated skin, and show what a ghost is and how it goes. Needs no board.",
    "calibrate.calibrate": "Learn forces by a scale, weights or recordings: a calibration file.",
}


class _Command(TyperCommand):
    """A command whose module is not imported yet. It knows what the list of commands shows."""

    def __init__(self, place: str, help_: str) -> None:
        self._module, _, name = place.partition(".")
        super().__init__(name, help=help_)

    def load(self) -> Any:
        """The command itself, or the group of them. Its module may have an EPILOG for the help."""
        assert self.name is not None
        with ctrl_c_kept():
            module = import_module(f"ohmskin.cli.{self._module}")
        function, group = getattr(module, self.name), typer.Typer(add_completion=False)
        if isinstance(function, typer.Typer):
            group.add_typer(function, name=self.name)
        else:
            group.command(self.name, epilog=getattr(module, "EPILOG", None))(function)
        return typer.main.get_group(group).commands[self.name]

    def make_context(self, info_name: Any, args: Any, parent: Any = None, **extra: Any) -> Any:
        """The command itself is run, and so imported now."""
        return self.load().make_context(info_name, args, parent, **extra)


_typer = typer.Typer(
    no_args_is_help=True,
    context_settings={"help_option_names": ["-h", "--help"]},
    epilog="PORT is a serial port (/dev/ttyACM0, COM3) or a URL: emulator://8x8?scene=ghost, "
    "simavr://uno?scene=ghost, replay://FILE.mcap?speed=1; of another computer, "
    "socket://robot:4000 or rfc2217://robot:4000. OHMSKIN_PORT may name it, too.",
)


@_typer.callback(invoke_without_command=True)
def _top(version: Annotated[bool, typer.Option("--version", help="the version")] = False) -> None:
    """Reads resistive tactile skins: boards, scans, and the conductance of every cell."""
    if version:
        print(f"ohmskin {ohmskin.__version__}")  # noqa: T201
        raise typer.Exit


app = typer.main.get_command(_typer)
assert isinstance(app, TyperGroup)
app.commands = {place.partition(".")[2]: _Command(place, text) for place, text in _COMMANDS.items()}


def main() -> None:
    """Run the command line; the process's exit code says how it went."""
    sys.unraisablehook = raise_again
    try:
        run(app, "ohmskin")
    finally:
        forget_ctrl_c()


def run(commands: Callable[..., Any], program: str) -> None:
    """Run these commands. An error is one line that begins with the program's name."""
    try:
        # Typer returns the code of an Exit, such as 130 for Ctrl-C.
        code = commands(prog_name=program, standalone_mode=False)
        if code:
            sys.exit(code)
    except (OhmskinError, ValueError, OSError) as exc:
        _fail(program, str(exc))
    except (Exception, KeyboardInterrupt) as exc:
        # An import that Ctrl-C ends may raise an ImportError, whose cause is Ctrl-C.
        if isinstance(exc.__cause__ or exc, (typer.Abort, KeyboardInterrupt)):
            sys.exit(130)
        # Errors of Typer say by this method what is wrong with the command line.
        message = getattr(exc, "format_message", None)
        if message is None:
            raise
        if text := message():
            context = getattr(exc, "ctx", None)
            if context and text.startswith(("Missing argument", "Got unexpected")):
                text = f"{text.rstrip('.')}. {context.get_usage()}"
            _fail(program, text)
        sys.exit(2)  # no command at all: the help is the answer


def _fail(program: str, text: str) -> None:
    from ohmskin.cli.terminal import printable  # with rich, which a command that fails may not need

    print(printable(f"{program}: {' '.join(text.split())}"), file=sys.stderr)  # noqa: T201
    sys.exit(2)
