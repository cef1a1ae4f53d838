"""The command line: a thin skin over the Python API.

Exit status: 0 done, 1 no usable result, 2 bad input (one plain sentence on stderr), 130 interrupted (the best so far is
written).
"""

from __future__ import annotations

import argparse
import os
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from .recording import InputError, Recording

DONE, NO_RESULT, BAD_INPUT, INTERRUPTED = 0, 1, 2, 130


def main(arguments: Sequence[str] | None = None) -> int:
    """Run a command; returns the exit status."""
    try:
        options = _parser().parse_args(arguments)
        return int(options.run(options))
    except InputError as error:
        return _say(str(error), BAD_INPUT)
    except KeyboardInterrupt:
        return _say("Interrupted before there was anything to write.", INTERRUPTED)
    except BrokenPipeError:
        return DONE
    except OSError as error:
        return _say(f"{error.filename or 'A file'} cannot be used: {error.strerror or error}.", BAD_INPUT)
    except MemoryError:
        return _say("Memory ran out; give shorter recordings or a smaller model.", NO_RESULT)
    except Exception as error:
        if os.environ.get("PILFR_DEBUG"):
            raise
        return _say(f"Something failed inside ({type(error).__name__}: {error}); PILFR_DEBUG=1 shows where.", NO_RESULT)


def _say(sentence: str, status: int) -> int:
    print("pilfr: " + " ".join(sentence.split()), file=sys.stderr)
    return status


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="pilfr", description="Identify dynamic models with hysteresis from recordings."
    )
    commands = parser.add_subparsers(required=True, metavar="COMMAND")

    fit = commands.add_parser("fit", help="identify a PI-LFR model from recordings")
    fit.add_argument("train", nargs="+", help="training recordings (.csv, .mat, .npz)")
    _data_options(fit)
    fit.add_argument(
        "--test", action="append", default=[], metavar="FILE", help="recording to report on, never fitted (repeatable)"
    )
    fit.add_argument(
        "--nx", type=int, default=None, help="states of the linear part (default: chosen on the training data)"
    )
    fit.add_argument(
        "--operators", type=int, default=20, metavar="N", help="hysteresis operators a channel; 0 for a linear model"
    )
    fit.add_argument(
        "--operator", choices=("play", "stop", "generalized_play"), default="play", help="kind of operator"
    )
    fit.add_argument("--channels", type=int, default=1, help="channels of the element")
    fit.add_argument(
        "--structure", choices=("lfr", "hammerstein", "wiener"), default="lfr", help="where the element sits"
    )
    fit.add_argument(
        "--bound", action="append", default=[], metavar="NAME=LOW:HIGH", help="bounds of a parameter (repeatable)"
    )
    fit.add_argument(
        "--fix", action="append", default=[], metavar="NAME=VALUE", help="hold a block at a value (repeatable)"
    )
    fit.add_argument(
        "--from", dest="start_from", metavar="MODEL.json", help="start from a saved model instead of searching"
    )
    fit.add_argument(
        "--solver", choices=("gauss-newton", "ipopt"), default="gauss-newton", help="solver of the final problem"
    )
    fit.add_argument("--starts", type=int, default=8, help="random starts (default 8)")
    fit.add_argument("--seed", type=int, default=0, help="seed of all starts")
    fit.add_argument("--workers", type=int, default=1, help="processes; the numbers do not depend on it")
    fit.add_argument(
        "--engine", choices=("auto", "c", "vm"), default="auto", help="generated C or CasADi's virtual machine"
    )
    fit.add_argument("--out", default="fit", metavar="DIR", help="folder for model.json and report.html (default: fit)")
    fit.set_defaults(run=_fit)

    simulate = commands.add_parser("simulate", help="simulate a saved model on a recording's inputs")
    simulate.add_argument("model", help="model.json")
    simulate.add_argument("data", help="recording (.csv, .mat, .npz)")
    _data_options(simulate, named=False)
    simulate.add_argument(
        "--out", required=True, metavar="FILE", help="CSV file for time, inputs and simulated outputs"
    )
    simulate.set_defaults(run=_simulate)

    export = commands.add_parser("export", help="write a saved model as a serialized CasADi function")
    export.add_argument("model", help="model.json")
    export.add_argument("--out", required=True, metavar="FILE", help="file for casadi.Function.load")
    export.set_defaults(run=_export)

    demo = commands.add_parser("demo", help="identify a rig with a hysteretic spring from recordings that come along")
    demo.add_argument("--out", default="runs/demo", metavar="DIR", help="folder for the report (default: runs/demo)")
    demo.add_argument("--workers", type=int, default=min(4, os.cpu_count() or 1), help="processes")
    demo.set_defaults(run=_demo)
    return parser


def _data_options(parser: argparse.ArgumentParser, named: bool = True) -> None:
    how = {"required": True} if named else {"default": None}
    parser.add_argument("--inputs", metavar="NAME[,NAME]", help="names of the inputs", **how)
    parser.add_argument("--outputs", metavar="NAME[,NAME]", help="names of the outputs", **how)
    parser.add_argument(
        "--column",
        action="append",
        default=[],
        metavar="NAME=COLUMN",
        help="column of a name, where it differs (repeatable)",
    )
    parser.add_argument(
        "--initial", choices=("estimate", "zero", "periodic"), default="estimate", help="state at the first sample"
    )
    parser.add_argument(
        "--period", type=int, default=None, metavar="SAMPLES", help="samples a period, for records in steady state"
    )
    parser.add_argument("--hold", choices=("zero", "linear"), default=None, help="what the input does between samples")
    parser.add_argument(
        "--skip", type=int, default=0, metavar="SAMPLES", help="leading samples that are simulated, not scored"
    )
    parser.add_argument(
        "--dt", type=float, default=None, metavar="SECONDS", help="step, where the file has no time column"
    )


def _names(text: str) -> tuple[str, ...]:
    return tuple(part.strip() for part in text.split(",") if part.strip())


def _pairs(texts: Sequence[str], option: str) -> dict[str, str]:
    pairs = [text.partition("=") for text in texts]
    for (name, sign, value), text in zip(pairs, texts, strict=True):
        if not (name and sign and value):
            raise InputError(f"{option} {text!r} was given; write {option} NAME=VALUE.")
    return {name: value for name, _, value in pairs}


def _number(text: str, option: str) -> float:
    try:
        return float(text)
    except ValueError:
        raise InputError(f"{text!r} in {option} is not a number; write one like 0.5.") from None


def _bounds(texts: Sequence[str]) -> dict[str, tuple[float, float]]:
    out = {}
    for name, value in _pairs(texts, "--bound").items():
        low, sign, high = value.partition(":")
        if not sign:
            raise InputError(f"--bound {name}={value} was given; write --bound NAME=LOW:HIGH.")
        out[name] = (
            _number(low, "--bound") if low else -float("inf"),
            _number(high, "--bound") if high else float("inf"),
        )
        if out[name][0] > out[name][1]:
            raise InputError(
                f"The bounds {value} of {name} are infeasible: the lower one exceeds the upper one; swap them."
            )
    return out


def _read(options: argparse.Namespace, path: str, inputs: tuple[str, ...], outputs: tuple[str, ...]) -> Recording:
    from .readers import read

    more = {"initial": options.initial, "period": options.period, "hold": options.hold, "skip": options.skip}
    return read(path, inputs, outputs, columns=_pairs(options.column, "--column"), dt=options.dt, **more)


def _structure(options: argparse.Namespace, nx: int) -> Any:
    from .elements import PrandtlIshlinskii
    from .lfr import PILFR, hammerstein, wiener
    from .operators import GeneralizedPlay, Play, Stop

    if options.operators < 0:
        raise InputError(f"--operators {options.operators} was given; give 0 (a linear model) or more.")
    kind = {"play": Play, "stop": Stop, "generalized_play": GeneralizedPlay}[options.operator]
    element = PrandtlIshlinskii(kind, options.operators, options.channels) if options.operators else None
    fixed = {name: _number(value, "--fix") for name, value in _pairs(options.fix, "--fix").items()}
    if options.structure == "lfr" or element is None:
        base = PILFR(nx, element)
    else:
        base = {"hammerstein": hammerstein, "wiener": wiener}[options.structure](nx, element)
    return PILFR(nx, element, {**base.fixed, **fixed}, _bounds(options.bound))


def _folder(path: str) -> Path:
    """Make the output folder before any long work, so that a bad one is said at once."""
    folder = Path(path)
    try:
        folder.mkdir(parents=True, exist_ok=True)
        probe = folder / f".writable-{os.getpid()}"
        probe.touch()
        probe.unlink()
    except OSError as error:
        raise InputError(f"The folder {path} cannot be written ({error.strerror}); give another --out.") from None
    return folder


def _fit(options: argparse.Namespace) -> int:
    from .export import load
    from .fit import fit
    from .gauss_newton import GaussNewton
    from .ipopt import Ipopt
    from .progress import progress_bar
    from .report import fit_report

    inputs, outputs = _names(options.inputs), _names(options.outputs)
    seen = [Path(path).resolve() for path in (*options.train, *options.test)]
    if len(set(seen)) < len(seen):
        raise InputError("A file is given twice, as training or test recording; a test on training data says nothing.")
    for name, value in (("--starts", options.starts), ("--workers", options.workers)):
        if value < 1:
            raise InputError(f"{name} {value} was given; give 1 or more.")
    train = [_read(options, path, inputs, outputs) for path in options.train]
    tests = [_read(options, path, inputs, outputs) for path in options.test]
    folder = _folder(options.out)
    solver = GaussNewton() if options.solver == "gauss-newton" else Ipopt()
    with progress_bar() as progress:
        if options.start_from:
            result = fit(load(options.start_from), train, solver=solver, engine=options.engine, progress=progress)
        else:
            nx = options.nx if options.nx is not None else _choose_order(train)
            search = {"starts": options.starts, "seed": options.seed, "workers": options.workers}
            result = fit(
                _structure(options, nx), train, solver=solver, engine=options.engine, progress=progress, **search
            )
    result.save(folder / "model.json")
    page = fit_report(result, train, tests, folder)
    print(result)
    for recording in tests:
        print(f"NRMSE on {recording.name}: {result.nrmse(recording):.4f}{_share_of_range(result, recording)}")
    print(f"model: {folder / 'model.json'}\nreport: {page}")
    if result.status.name == "INTERRUPTED":
        return INTERRUPTED
    return (
        DONE
        if min(result.train_nrmse) < 1.0
        else _say("The model explains nothing of the training recording.", NO_RESULT)
    )


def _share_of_range(result: Any, recording: Recording) -> str:
    import numpy as np

    error = (result.simulate(recording) - recording.y)[recording.skip :]
    share = 100 * np.sqrt(np.mean(error**2, axis=0)) / np.ptp(recording.y[recording.skip :], axis=0)
    return f" (rms error {', '.join(f'{s:.2f}' for s in share)} % of the range)"


def _choose_order(train: Sequence[Recording]) -> int:
    from .order_selection import select_order

    choice = select_order(train, range(1, 9), offset=True)
    print(f"order chosen on the training data: {choice.recommended}")
    return int(choice.recommended)


def _simulate(options: argparse.Namespace) -> int:
    import numpy as np

    from .export import load, write_atomically

    if Path(options.out).resolve() == Path(options.data).resolve():
        raise InputError(f"--out {options.out} would overwrite the recording; give another file.")
    model = load(options.model)
    inputs = _names(options.inputs) if options.inputs else model.model.inputs
    outputs = _names(options.outputs) if options.outputs else model.model.outputs
    recording = _read(options, options.data, inputs, outputs)
    y = model.simulate(recording)
    if not np.all(np.isfinite(y)):
        return _say(f"The simulation of {options.model} diverges on {options.data}; nothing was written.", NO_RESULT)
    header = ",".join(["t", *inputs, *outputs])
    rows = np.column_stack([recording.t, recording.u, y])
    text = "\n".join([header, *(",".join(map(repr, row)) for row in rows.tolist())]) + "\n"
    write_atomically(Path(options.out), text)
    print(f"NRMSE on {recording.name}: {model.nrmse(recording):.4f}\nsimulated outputs: {options.out}")
    return DONE


def _export(options: argparse.Namespace) -> int:
    from .export import load

    function, out = load(options.model).to_casadi(), Path(options.out)
    if out.is_dir() or not out.parent.is_dir() or not os.access(out.parent, os.W_OK):
        raise InputError(f"--out {options.out} cannot be written; give a file in a folder that exists.")
    function.save(str(out))
    print(f"casadi function: {options.out}")
    return DONE


def _demo(options: argparse.Namespace) -> int:
    from .demo import run_demo

    return run_demo(_folder(options.out), options.workers)
