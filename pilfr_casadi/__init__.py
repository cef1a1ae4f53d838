"""Identify dynamic models with hysteresis from recordings, and find the physics that a simulator leaves out.

Every public name is reachable as ``pilfr_casadi.<name>``; its module is imported when the name is first used, so that
``import pilfr_casadi`` itself costs next to nothing.
"""

import importlib
import sys
import types
from typing import Any

__version__ = "0.1.0"

# public name -> submodule that defines it
_EXPORTS = {
    "Limit": "limits",
    "RegularizationPath": "sparse",
    "dc_gain": "known",
    "ordered": "known",
    "prune": "sparse",
    "regularization_path": "sparse",
    "diagnose": "diagnose",
    "Simulator": "simulator",
    "Port": "simulator",
    "Local": "laws",
    "Law": "laws",
    "Diagnosis": "diagnose",
    "BLA": "bla",
    "Combined": "combined",
    "Constraint": "constraints",
    "Envelope": "envelope",
    "Part": "combined",
    "Products": "products",
    "mean_period": "periods",
    "noise_weights": "periods",
    "period_noise": "periods",
    "Exported": "export",
    "Fit": "fit",
    "GaussNewton": "gauss_newton",
    "GeneralizedPlay": "operators",
    "InputError": "recording",
    "Ipopt": "ipopt",
    "Model": "model",
    "NARX": "baselines",
    "NOE": "baselines",
    "StaticNetwork": "elements",
    "network_lfr": "baselines",
    "one_step": "baselines",
    "ssnn": "baselines",
    "PILFR": "lfr",
    "Parameter": "parameters",
    "ParameterSet": "parameters",
    "Play": "operators",
    "PrandtlIshlinskii": "elements",
    "Problem": "problem",
    "PredictiveController": "feedback",
    "Recording": "recording",
    "Solution": "solution",
    "Status": "solution",
    "Stop": "operators",
    "as_recordings": "recording",
    "campaign": "runs",
    "close_loop": "model",
    "exported": "export",
    "do_mpc_controller": "feedback",
    "do_mpc_model": "feedback",
    "feedforward": "feedback",
    "fit": "fit",
    "fit_report": "report",
    "frequency_subspace": "subspace",
    "generalized_play": "operators",
    "hammerstein": "lfr",
    "inverse_element": "feedback",
    "kalman_filter": "feedback",
    "load": "export",
    "modal": "modal",
    "multisine": "signals",
    "normalise": "normal_form",
    "nrmse": "metrics",
    "open_model": "model",
    "orthogonal_multisine": "signals",
    "plain_bla": "local_polynomial",
    "play": "operators",
    "prbs": "signals",
    "read": "readers",
    "read_csv": "readers",
    "read_mat": "readers",
    "read_npz": "readers",
    "rmse": "metrics",
    "robust_bla": "bla",
    "read_run": "runs",
    "response_bound": "response_bound",
    "run": "runs",
    "save": "export",
    "select_order": "order_selection",
    "sine_sweep": "signals",
    "stable": "constraints",
    "standard_errors": "gauge",
    "stop": "operators",
    "time_subspace": "subspace",
    "to_casadi": "export",
    "to_plays": "conversion",
    "to_stops": "conversion",
    "tukey_realizations": "signals",
    "visibility": "feedback",
    "wiener": "lfr",
    "write_report": "report",
}

__all__ = sorted(_EXPORTS)


def __getattr__(name: str) -> Any:
    if name not in _EXPORTS:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    value = getattr(importlib.import_module(f"{__name__}.{_EXPORTS[name]}"), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *_EXPORTS})


class _Package(types.ModuleType):
    """This package: where a public name equals its submodule's (``fit`` in ``fit.py``), the public name wins."""

    def __setattr__(self, name: str, value: Any) -> None:
        if isinstance(value, types.ModuleType) and _EXPORTS.get(name) == name:
            value = getattr(value, name)
        super().__setattr__(name, value)


sys.modules[__name__].__class__ = _Package
