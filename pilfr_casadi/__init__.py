"""Identify dynamic models with hysteresis from recordings, and find the physics that a simulator leaves out.

Find missing physics. A `Simulator` holds your equations, with `Parameter` values and a `Port` wherever a force may be
missing; `diagnose` compares it with recordings of the machine and returns a `Diagnosis`::

    import pilfr_casadi as pilfr

    train = pilfr.read_csv("train.csv", inputs="force", outputs="x2")
    print(pilfr.check(simulator, train))  # what these recordings can reveal
    diagnosis = pilfr.diagnose(simulator, train, test=pilfr.read_csv("test.csv", inputs="force", outputs="x2"))
    print(diagnosis)  # where, what, how sure, error before and after
    diagnosis.report("report")  # report.html, diagnosis.json, figures

Identify a model. A `PILFR` is a linear model closed by hysteresis operators; `fit` returns a `Fit`::

    model = pilfr.PILFR(nx=5, element=pilfr.PrandtlIshlinskii(pilfr.Play, 20))
    fit = pilfr.fit(model, train, starts=8, seed=0)
    fit.save("rig.json")  # pilfr.load reads it again
    F = fit.to_casadi()  # casadi.Function (x, u) -> (x_next, y)

More lives in the folders: `pilfr.laws` (the catalogue of physical laws), `pilfr.models`, `pilfr.data`, `pilfr.linear`,
`pilfr.optimise`, `pilfr.control`, `pilfr.plots`, `pilfr.report`, `pilfr.studies`. Each says in its docstring what it
holds.
"""

from typing import TYPE_CHECKING

from ._base import __version__ as __version__
from ._base.lazy import lazy_face
from .diagnose import diagnose as diagnose

if TYPE_CHECKING:
    from . import (
        control as control,
        data as data,
        export as export,
        identify as identify,
        laws as laws,
        linear as linear,
        models as models,
        optimise as optimise,
        plots as plots,
        report as report,
        simulators as simulators,
        studies as studies,
    )
    from ._base import InputError as InputError
    from .control import (
        PredictiveController as PredictiveController,
        do_mpc_controller as do_mpc_controller,
        do_mpc_model as do_mpc_model,
        feedforward as feedforward,
        inverse_element as inverse_element,
        kalman_filter as kalman_filter,
        response_bound as response_bound,
        visibility as visibility,
    )
    from .data import (
        Recording as Recording,
        as_recordings as as_recordings,
        mean_period as mean_period,
        merge as merge,
        multisine as multisine,
        noise_weights as noise_weights,
        nrmse as nrmse,
        orthogonal_multisine as orthogonal_multisine,
        period_noise as period_noise,
        prbs as prbs,
        read as read,
        read_csv as read_csv,
        read_frame as read_frame,
        read_mat as read_mat,
        read_npz as read_npz,
        rmse as rmse,
        sine_sweep as sine_sweep,
        tukey_realizations as tukey_realizations,
    )
    from .diagnose import Check as Check, Diagnosis as Diagnosis, check as check
    from .export import Exported as Exported, exported as exported, to_casadi as to_casadi
    from .identify import (
        Comparison as Comparison,
        Fit as Fit,
        RegularizationPath as RegularizationPath,
        compare as compare,
        fit as fit,
        load as load,
        one_step as one_step,
        prune as prune,
        regularization_path as regularization_path,
        save as save,
        standard_errors as standard_errors,
    )
    from .laws import Law as Law, Local as Local
    from .linear import (
        BLA as BLA,
        frequency_subspace as frequency_subspace,
        modal as modal,
        plain_bla as plain_bla,
        robust_bla as robust_bla,
        select_order as select_order,
        time_subspace as time_subspace,
    )
    from .models import (
        NARX as NARX,
        NOE as NOE,
        PILFR as PILFR,
        Combined as Combined,
        Envelope as Envelope,
        GeneralizedPlay as GeneralizedPlay,
        Model as Model,
        Parameter as Parameter,
        ParameterSet as ParameterSet,
        Part as Part,
        Play as Play,
        PrandtlIshlinskii as PrandtlIshlinskii,
        Products as Products,
        StaticNetwork as StaticNetwork,
        Stop as Stop,
        close_loop as close_loop,
        generalized_play as generalized_play,
        hammerstein as hammerstein,
        network_lfr as network_lfr,
        open_model as open_model,
        play as play,
        ssnn as ssnn,
        stop as stop,
        to_plays as to_plays,
        to_stops as to_stops,
        wiener as wiener,
    )
    from .optimise import (
        Constraint as Constraint,
        GaussNewton as GaussNewton,
        Ipopt as Ipopt,
        Limit as Limit,
        Problem as Problem,
        Solution as Solution,
        Status as Status,
        dc_gain as dc_gain,
        ordered as ordered,
        stable as stable,
    )
    from .report import fit_report as fit_report, write_report as write_report
    from .simulators import (
        Port as Port,
        Simulator as Simulator,
        from_fmu as from_fmu,
        from_function as from_function,
        from_mujoco as from_mujoco,
    )
    from .studies import campaign as campaign, fleet as fleet, read_run as read_run, run as run
else:
    __getattr__, __dir__, _listed = lazy_face(__name__, __file__)
# Reached through their folders (`pilfr.models.to_plays`); these spellings still work.
_ELSEWHERE = {
    "BLA",
    "Comparison",
    "Envelope",
    "Exported",
    "Limit",
    "ParameterSet",
    "Part",
    "Products",
    "RegularizationPath",
    "Solution",
    "StaticNetwork",
    "Status",
    "as_recordings",
    "compare",
    "dc_gain",
    "do_mpc_controller",
    "do_mpc_model",
    "feedforward",
    "fleet",
    "fit_report",
    "frequency_subspace",
    "from_mujoco",
    "generalized_play",
    "inverse_element",
    "kalman_filter",
    "mean_period",
    "merge",
    "modal",
    "network_lfr",
    "noise_weights",
    "one_step",
    "open_model",
    "ordered",
    "orthogonal_multisine",
    "period_noise",
    "plain_bla",
    "play",
    "prbs",
    "prune",
    "read_frame",
    "read_run",
    "regularization_path",
    "response_bound",
    "rmse",
    "select_order",
    "ssnn",
    "stable",
    "standard_errors",
    "stop",
    "time_subspace",
    "to_casadi",
    "to_plays",
    "to_stops",
    "tukey_realizations",
    "visibility",
    "write_report",
}
if not TYPE_CHECKING:
    __all__ = [*(name for name in _listed if name not in _ELSEWHERE), "__version__", "diagnose"]
