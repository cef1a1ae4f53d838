"""The command line: a thin skin over the Python API; `commands` does the work.

Exit status: 0 done, 1 no usable result, 2 bad input (one plain sentence on stderr), 130 interrupted (the best so far is
written).
"""

from __future__ import annotations

import argparse
import os
import re
import sys
import warnings
from collections.abc import Sequence
from pathlib import Path
from typing import Any

DONE, NO_RESULT, BAD_INPUT, INTERRUPTED = 0, 1, 2, 130
EVERY_KEY = "demo_data/every_key.toml"
# keyword arguments of Python that the package's messages name, and that are options here under the same name
KEYWORDS = ("dt", "time_tolerance", "period", "hold", "initial", "skip", "starts", "seed", "workers", "engine")


def main(arguments: Sequence[str] | None = None) -> int:
    """Run a command; returns the exit status."""
    try:
        options = _parser().parse_args(arguments)
        return _run(options)
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


def _run(options: argparse.Namespace) -> int:
    from .._base import deferred_interrupt, terminable

    with deferred_interrupt():  # an import is not to be torn apart
        from .._base import InputError
        from . import commands
    with terminable(), warnings.catch_warnings():
        warnings.showwarning = _warn
        try:
            return int(getattr(commands, options.command)(options))
        except InputError as error:
            return say(in_options(str(error)), BAD_INPUT)


def _warn(message: Warning | str, *_: Any, **__: Any) -> None:
    """A warning is a sentence too, without the place in the code that Python adds."""
    say(f"warning: {message}", DONE)


def say(sentence: str, status: int) -> int:
    """Print one line on stderr; returns the status."""
    print("pilfr: " + " ".join(sentence.split()), file=sys.stderr)
    return status


def in_options(sentence: str) -> str:
    """Put a message that names Python's keyword arguments into the words of the command line."""
    sentence = sentence.replace("give the model as `model=`", "use it in Python with load(FILE, model=MODEL)")
    sentence = re.sub(r"columns=\{'([^']*)': '([^']*)'\}", r"--column \1=\2", sentence)
    keyword = rf"`?(?<![\w-])({'|'.join(KEYWORDS)})=(?:'([^']*)'|([^\s;,()`]*[^\s;,.()`]))?`?"
    return re.sub(keyword, lambda m: f"--{m[1].replace('_', '-')} {m[2] or m[3] or m[1].upper()}", sentence)


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="pilfr",
        description="Identify dynamic models with hysteresis from recordings; find the physics that a simulator lacks.",
        allow_abbrev=False,
    )
    commands = parser.add_subparsers(required=True, metavar="COMMAND", dest="command")

    fit = commands.add_parser("fit", help="identify a PI-LFR model from recordings", allow_abbrev=False)
    fit.add_argument("train", nargs="+", help="training recordings (.csv, .mat, .npz)")
    _data_options(fit)
    fit.add_argument(
        "--test", action="append", default=[], metavar="FILE", help="recording to report on, never fitted (repeatable)"
    )
    _structure_options(fit)
    fit.add_argument(
        "--from", dest="start_from", metavar="MODEL.json", help="start from a saved model instead of searching"
    )
    fit.add_argument(
        "--solver", choices=("gauss-newton", "ipopt"), default="gauss-newton", help="solver of the final problem"
    )
    fit.add_argument("--workers", type=int, default=1, help="processes; the numbers do not depend on it")
    fit.add_argument(
        "--engine", choices=("auto", "c", "vm"), default="auto", help="generated C or CasADi's virtual machine"
    )
    fit.add_argument(
        "--time-limit", type=float, metavar="SECONDS", help="stop then and keep the best so far (default: none)"
    )
    fit.add_argument("--out", default="fit", metavar="DIR", help="folder for model.json and report.html (default: fit)")
    fit.add_argument("--overwrite", action="store_true", help="replace a model that is in that folder already")

    diagnose = commands.add_parser(
        "diagnose",
        help="find the physics that a simulator leaves out",
        usage="pilfr diagnose SIMULATOR.py TRAIN [TRAIN ...] [options], or --simulated SIM TRAIN [TRAIN ...] [options]",
        allow_abbrev=False,
    )
    diagnose.add_argument(
        "files",
        nargs="+",
        metavar="FILE",
        help="a Python file that sets `simulator` (or a model.json), then training recordings (.csv, .mat, .npz)",
    )
    diagnose.add_argument(
        "--simulated",
        metavar="SIM",
        help="inputs and outputs of the simulation itself, in place of the simulator file",
    )
    diagnose.add_argument(
        "--test", action="append", default=[], metavar="FILE", help="recording to judge on, never fitted (repeatable)"
    )
    _data_options(diagnose, named=False, which="with --simulated")
    diagnose.add_argument(
        "--limit",
        action="append",
        default=[],
        metavar="INPUT=AMPLITUDE",
        help="largest amplitude of an input in the experiment that is proposed next (repeatable; default: as recorded)",
    )
    diagnose.add_argument("--workers", type=int, help="fits side by side (default: one a processor, at most four)")
    diagnose.add_argument(
        "--out",
        default="diagnosis",
        metavar="DIR",
        help="folder for diagnosis.json and report.html (default: diagnosis)",
    )
    diagnose.add_argument("--overwrite", action="store_true", help="replace a diagnosis that is in that folder already")

    run = commands.add_parser(
        "run",
        help="execute a run file: identifications with all they depend on, skipped where done",
        allow_abbrev=False,
    )
    campaign = commands.add_parser(
        "campaign",
        help="execute all jobs of a run file side by side: Monte-Carlo studies, grids, cross-validation",
        allow_abbrev=False,
    )
    for parser_of, name in ((run, "run"), (campaign, "campaign")):
        parser_of.epilog = f"Every key of a run file, in one that runs: {Path(__file__).parent / EVERY_KEY}"
        add = parser_of.add_argument
        add("run_file", metavar="RUN.toml", help="what to do (.toml, or .py that sets `run`)")
        add("--out", metavar="DIR", help=f"folder of the results (default: as the file says, else RUN-{name})")
        add("--workers", type=int, help="processes; the numbers do not depend on it (default: as the file says)")
        add("--overwrite", action="store_true", help="compute everything again, whatever is in the folder")
    campaign.add_argument("--dask", metavar="ADDRESS", help="run the jobs on the Dask cluster of that scheduler")
    campaign.add_argument(
        "--time-limit", type=float, metavar="SECONDS", help="end a job then (default: as the file says, else none)"
    )

    simulate = commands.add_parser(
        "simulate", help="simulate a saved model on a recording's inputs", allow_abbrev=False
    )
    simulate.add_argument("model", help="model.json")
    simulate.add_argument(
        "data", help="recording (.csv, .mat, .npz), or several in one array (.npz, .npy: samples, channels, ...)"
    )
    _data_options(simulate, named=False)
    simulate.add_argument("--out", required=True, metavar="FILE", help="CSV file; of several records also .npz or .npy")

    export = commands.add_parser(
        "export", help="write a model's step as a serialized CasADi function or as C", allow_abbrev=False
    )
    export.add_argument("model", help="model.json, or a Python file that sets `simulator`")
    form = export.add_mutually_exclusive_group()
    form.add_argument("--casadi", action="store_true", help="a file for casadi.Function.load, and its names (default)")
    form.add_argument("--c", action="store_true", help="C source and header that need no library")
    export.add_argument("--out", required=True, metavar="FILE", help="the file; with --c the folder for both files")
    export.add_argument("--name", default="model", help="name of the function (default: model)")
    export.add_argument("--smooth", type=float, default=0.0, metavar="EPS", help="round min and max (default: exact)")
    export.add_argument("--dt", type=float, metavar="SECONDS", help="step of a simulator, which has none")
    export.add_argument("--hold", choices=("zero", "linear"), help="what a simulator's inputs do between samples")

    demo = commands.add_parser(
        "demo", help="identify a rig, and diagnose a simulator, from recordings that come along", allow_abbrev=False
    )
    demo.add_argument("--out", default="runs/demo", metavar="DIR", help="folder for the report (default: runs/demo)")
    demo.add_argument("--workers", type=int, default=min(4, os.cpu_count() or 1), help="processes")
    return parser


def _structure_options(fit: argparse.ArgumentParser) -> None:
    """Options of a search; no defaults here, so that `commands` sees which ones were given."""
    fit.add_argument("--nx", type=int, help="states of the linear part (default: chosen on the training data)")
    fit.add_argument(
        "--operators", type=int, metavar="N", help="hysteresis operators a channel (default 20); 0 for a linear model"
    )
    fit.add_argument(
        "--operator", choices=("play", "stop", "generalized_play"), help="kind of operator (default: play)"
    )
    fit.add_argument("--channels", type=int, help="channels of the element (default 1)")
    fit.add_argument(
        "--structure",
        choices=("lfr", "hammerstein", "wiener", "ssnn", "network_lfr", "narx", "noe"),
        help="where the element sits (default: lfr), or a network to compare with",
    )
    fit.add_argument("--hidden", type=int, metavar="N", help="neurons of a network (default: 15; 10 of narx and noe)")
    fit.add_argument("--lags", type=int, metavar="N", help="past outputs and inputs of narx and noe")
    fit.add_argument("--bound", action="append", metavar="NAME=LOW:HIGH", help="bounds of a parameter (repeatable)")
    fit.add_argument("--fix", action="append", metavar="NAME=VALUE", help="hold a block at a value (repeatable)")
    fit.add_argument("--starts", type=int, help="random starts (default 8)")
    fit.add_argument("--seed", type=int, help="seed of all starts (default 0)")


def _data_options(parser: argparse.ArgumentParser, named: bool = True, which: str = "default: the model's") -> None:
    add = parser.add_argument
    which = "" if named else f" ({which})"
    add("--inputs", metavar="NAME[,NAME]", required=named, help=f"names of the inputs{which}")
    add("--outputs", metavar="NAME[,NAME]", required=named, help=f"names of the outputs{which}")
    add(
        "--column",
        action="append",
        default=[],
        metavar="NAME=COLUMN",
        help="column of a name, or of the time t, where it differs (repeatable)",
    )
    add(
        "--initial",
        choices=("estimate", "zero", "periodic"),
        help="state at the first sample (default: estimate; zero where no outputs were measured)",
    )
    add("--period", type=int, metavar="SAMPLES", help="samples a period, for records in steady state")
    add("--hold", choices=("zero", "linear"), help="what the input does between samples")
    add("--skip", type=int, default=0, metavar="SAMPLES", help="leading samples that are simulated, not scored")
    add("--dt", type=float, metavar="SECONDS", help="step, where the file has no time column")
    add(
        "--time-tolerance",
        type=float,
        metavar="STEPS",
        help="how far samples may lie off a uniform grid (default: 1e-4 steps, beyond rounding)",
    )


if __name__ == "__main__":
    raise SystemExit(main())
