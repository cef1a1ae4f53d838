"""Run a command of the program `pilfr`; turn every failure into one sentence and an exit status.

Exit status: 0 done, 1 no usable result, 2 bad input (one plain sentence on stderr), 130 interrupted (the best so far is
written). Each group of commands has its own file, imported only when one of its commands runs.
"""

from __future__ import annotations

import importlib
import io
import os
import re
import sys
import warnings
from collections.abc import Callable, Sequence
from typing import Any

import typer

from .._base import InputError, __version__, deferred_interrupt, terminable, unwrapped_interrupt
from ._common import BAD_INPUT, DONE, INTERRUPTED, NO_RESULT, UsageError, say

COMMANDS = {  # name: (file, help)
    "fit": ("models", "Identify a PI-LFR model from recordings."),
    "check": ("diagnose", "Find what recordings can reveal about a simulator, before a diagnosis."),
    "diagnose": ("diagnose", "Find the physics that a simulator leaves out."),
    "fleet": ("studies", "Find the physics that a simulator lacks on many machines, and the machines that differ."),
    "simulate": ("models", "Simulate a saved model on a recording's inputs."),
    "export": ("models", "Write a model's step as a serialized CasADi function, as C, or as an FMU."),
    "run": ("studies", "Execute the jobs of a run file one by one; finished jobs are skipped."),
    "campaign": (
        "studies",
        "Execute all jobs of a run file side by side: Monte Carlo studies, grids, cross-validation.",
    ),
    "demo": ("demo", "Identify a rig and diagnose a simulator, from recordings that come with the package."),
}
# keyword arguments in messages of the package that are options of the same name
KEYWORDS = "dt|time_tolerance|resample|period|hold|initial|skip|starts|seed|workers|engine"


class PlainCommand(typer.core.TyperCommand):
    """A command whose help shows its arguments without braces and Python types."""

    def collect_usage_pieces(self, ctx: Any) -> list[str]:
        """Return the words after the command in the usage line."""
        names = [p.metavar + "..." * (p.nargs != 1) for p in _arguments(self)]
        return [self.options_metavar or "", *names]

    def format_options(self, ctx: Any, formatter: Any) -> None:
        """Write the tables of arguments and options."""
        rows = {
            "Arguments": [(p.metavar, p.help or "") for p in _arguments(self)],
            "Options": [p.get_help_record(ctx) for p in self.get_params(ctx) if p.param_type_name == "option"],
        }
        for title, table in rows.items():
            if table:
                with formatter.section(title):
                    formatter.write_dl(table)


def _arguments(command: Any) -> list[Any]:
    return [p for p in command.params if p.param_type_name == "argument"]


def main(arguments: Sequence[str] | None = None) -> int:
    """Run a command.

    Parameters
    ----------
    arguments : sequence of str, optional
        Arguments; by default those of the process.

    Returns
    -------
    int
        The exit status.
    """
    if isinstance(sys.stdout, io.TextIOWrapper) and sys.stdout.errors == "strict":
        sys.stdout.reconfigure(errors="replace")  # a file's name need not be text
    try:
        return _run(sys.argv[1:] if arguments is None else list(arguments))
    except typer.Exit as end:  # of --help and --version
        return end.exit_code
    except UsageError as error:
        return say(_usage_sentence(error), BAD_INPUT)
    except InputError as error:
        return say(name_options(str(error)), BAD_INPUT)
    except KeyboardInterrupt:
        return say("Interrupted before there was anything to write.", INTERRUPTED)
    except BrokenPipeError:
        return DONE
    except OSError as error:
        return say(f"{error.filename or 'A file'} cannot be used: {error.strerror or error}.", BAD_INPUT)
    except MemoryError:
        return say("Memory ran out; give shorter recordings or a smaller model.", NO_RESULT)
    except Exception as error:
        if os.environ.get("PILFR_DEBUG"):
            raise
        return say(f"Something failed inside ({type(error).__name__}: {error}); PILFR_DEBUG=1 shows where.", NO_RESULT)


def _run(arguments: list[str]) -> int:
    with deferred_interrupt():  # an import must not be interrupted
        program = typer.main.get_command(_program(arguments[0] if arguments else ""))
    with terminable(), unwrapped_interrupt(), warnings.catch_warnings():
        warnings.showwarning = _warn
        with program.make_context("pilfr", arguments) as context:
            return int(program.invoke(context) or DONE)


def _program(wanted: str) -> typer.Typer:
    """Build the program; import only the wanted command, and register the others by name for the help."""
    program = typer.Typer(
        help="Identify dynamic models with hysteresis from recordings; find the physics that a simulator lacks.",
        add_completion=False,
        rich_markup_mode=None,
    )
    program.callback()(_program_options)
    for name, (file, text) in COMMANDS.items():
        command: Callable[..., Any] = _placeholder
        if name == wanted:
            command = getattr(importlib.import_module(f".{file}", __package__), f"{name}_command")
        program.command(name, cls=PlainCommand, help=f"{text}\n\n{command.__doc__ or ''}", short_help=text)(command)
    return program


def _show_version(wanted: bool) -> None:
    if wanted:
        print(f"pilfr {__version__}")
        raise typer.Exit


def _program_options(
    version: bool = typer.Option(False, "--version", help="Print the version.", is_eager=True, callback=_show_version),
) -> None:
    pass


def _placeholder() -> None:
    pass


def _usage_sentence(error: Any) -> str:
    """Describe a wrong option; start with the option and its value if its type reports them."""
    if " was given; " in error.message and getattr(error, "param", None) is not None:
        return f"{error.param.opts[-1]} {error.message}"
    sentence = str(error.format_message()).replace("Value error, ", "").replace(". Did you", "; did you")
    where = error.ctx.command_path if error.ctx is not None else "pilfr"
    return sentence if sentence.endswith("?") else f"{sentence.rstrip('.')}; see {where} --help."


def _warn(message: Warning | str, *_: Any, **__: Any) -> None:
    """Print a warning as a sentence, without the line of code that Python adds."""
    say(f"warning: {message}", DONE)


def name_options(sentence: str) -> str:
    """Replace keyword arguments in a message by options of the command line."""
    sentence = sentence.replace("give the model as `model=`", "use it in Python with load(FILE, model=MODEL)")
    sentence = sentence.replace("read it by `pilfr_casadi.simulators.load_simulator`", "give a model.json")
    sentence = re.sub(r"columns=\{'([^']*)': '([\w.-]*)'\}", r"--column \1=\2", sentence)
    sentence = re.sub(r"columns=\{'([^']*)': '([^']*)'\}", r'--column "\1=\2"', sentence)
    keyword = rf"`?(?<![\w-])({KEYWORDS})=(?:'([^']*)'|([^\s;,()`]*[^\s;,.()`]))?`?"
    return re.sub(keyword, lambda m: f"--{m[1].replace('_', '-')} {m[2] or m[3] or m[1].upper()}", sentence)
