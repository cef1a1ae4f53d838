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
    from .control import PredictiveController as PredictiveController
    from .data import (
        Recording as Recording,
        multisine as multisine,
        nrmse as nrmse,
        read as read,
        read_csv as read_csv,
        read_mat as read_mat,
        read_npz as read_npz,
        sine_sweep as sine_sweep,
    )
    from .diagnose import Check as Check, Diagnosis as Diagnosis, check as check
    from .export import exported as exported
    from .identify import Fit as Fit, fit as fit, load as load, save as save
    from .laws import Law as Law, Local as Local
    from .linear import robust_bla as robust_bla
    from .models import (
        NARX as NARX,
        NOE as NOE,
        PILFR as PILFR,
        Combined as Combined,
        GeneralizedPlay as GeneralizedPlay,
        Model as Model,
        Parameter as Parameter,
        Play as Play,
        PrandtlIshlinskii as PrandtlIshlinskii,
        Stop as Stop,
        close_loop as close_loop,
        hammerstein as hammerstein,
        wiener as wiener,
    )
    from .optimise import Constraint as Constraint, GaussNewton as GaussNewton, Ipopt as Ipopt, Problem as Problem
    from .simulators import Port as Port, Simulator as Simulator, from_fmu as from_fmu, from_function as from_function
    from .studies import campaign as campaign, run as run

if TYPE_CHECKING:  # reached through their folders (`pilfr.models.to_plays`); these spellings still work
    from .control import (
        do_mpc_controller as do_mpc_controller,
        do_mpc_model as do_mpc_model,
        feedforward as feedforward,
        inverse_element as inverse_element,
        kalman_filter as kalman_filter,
        response_bound as response_bound,
        visibility as visibility,
    )
    from .data import (
        as_recordings as as_recordings,
        mean_period as mean_period,
        merge as merge,
        noise_weights as noise_weights,
        orthogonal_multisine as orthogonal_multisine,
        period_noise as period_noise,
        prbs as prbs,
        read_frame as read_frame,
        rmse as rmse,
        tukey_realizations as tukey_realizations,
    )
    from .export import Exported as Exported, to_casadi as to_casadi
    from .identify import (
        Comparison as Comparison,
        RegularizationPath as RegularizationPath,
        compare as compare,
        one_step as one_step,
        prune as prune,
        regularization_path as regularization_path,
        standard_errors as standard_errors,
    )
    from .linear import (
        BLA as BLA,
        frequency_subspace as frequency_subspace,
        modal as modal,
        plain_bla as plain_bla,
        select_order as select_order,
        time_subspace as time_subspace,
    )
    from .models import (
        Envelope as Envelope,
        ParameterSet as ParameterSet,
        Part as Part,
        Products as Products,
        StaticNetwork as StaticNetwork,
        generalized_play as generalized_play,
        network_lfr as network_lfr,
        open_model as open_model,
        play as play,
        ssnn as ssnn,
        stop as stop,
        to_plays as to_plays,
        to_stops as to_stops,
    )
    from .optimise import (
        Limit as Limit,
        Solution as Solution,
        Status as Status,
        dc_gain as dc_gain,
        ordered as ordered,
        stable as stable,
    )
    from .report import fit_report as fit_report, write_report as write_report
    from .simulators import from_mujoco as from_mujoco
    from .studies import fleet as fleet, read_run as read_run
else:
    __getattr__, __dir__, __all__ = lazy_face(__name__, __file__)
    __all__ = [*__all__, "__version__", "diagnose"]
