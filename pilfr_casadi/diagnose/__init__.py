"""Find the physics that a simulator leaves out: where, what, how sure, and the proof.

A hypothesis is the simulator with laws in its ports. All hypotheses are fitted to the same recordings and compared by
one log evidence; verdict, effects and confidence are sums over their posterior. `pipeline` shows how an answer comes
about. Folders and files by stage:

- `fits`: a simulator fitted to recordings, the noise, the screen of laws, and the evidence on which all is compared.
- `faults`: what may be wrong with recordings, and the rule by which a fault is accepted and corrected.
- `search`: the hypotheses, and the moves from one to others.
- Preparation: `arguments` checks the arguments. `prediction` stabilises an unstable simulator with an observer.
  `preparation` checks the recordings for faults, in order. `repetitions` prepares and searches again where something
  that was taken for granted proves wrong.
- Answer: `posterior` turns the evidences into probabilities, and `verdict` these into a verdict. `correction` chooses
  the corrected simulator, with a learned force where named laws do not suffice. `other_explanations` weighs a pinned
  value, an undeclared port, and a machine that changed.
- Proof: `proof` (errors before and after, placebo, where test recordings go beyond the training recordings),
  `experiment` (the next one), `mismatch_map`.
- Result: `answer` puts it together, `result` is what users hold, `result_text` what it says, an `effect` is a law that
  was found, and `refinement` puts a Prandtl-Ishlinskii layer in place of the hysteresis that was found.
- After a diagnosis: `replication` fits laws that were found to the recordings of further machines.
- Before a diagnosis: `blind_spots` (`check`: what the recordings cannot reveal), based on `identifiability` (of
  parameters), `detectability` (of laws) and `excitation` (of motions).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

from .._base.lazy import lazy_face

if TYPE_CHECKING:
    from .._base import Progress
    from ..data import Recording
    from ..identify import surrogate as surrogate
    from ..laws import Law
    from .arguments import (
        add_scaled_laws as add_scaled_laws,
        check_laws as check_laws,
        match_recordings as match_recordings,
    )
    from .blind_spots import BlindSpot as BlindSpot, Check as Check, check as check
    from .effect import Effect as Effect
    from .faults.gates import Gate as Gate
    from .fits.evidence import SURE as SURE
    from .fits.force_recovery import (
        HiddenForce as HiddenForce,
        hidden_force as hidden_force,
        law_signals as law_signals,
    )
    from .fits.linearise import port_signals as port_signals
    from .fits.workbench import Fitted as Fitted, Workbench as Workbench
    from .mismatch_map import mismatch as mismatch
    from .refinement import Refinement as Refinement
    from .replication import (
        Replication as Replication,
        Values as Values,
        find_channel_faults as find_channel_faults,
        refit_error as refit_error,
        replicate as replicate,
    )
    from .result import BeforeAfter as BeforeAfter, Diagnosis as Diagnosis
    from .result_text import ERROR_NAMES as ERROR_NAMES
    from .search.learned import Learned as Learned, NearLaw as NearLaw, learned_force as learned_force
    from .verdict import closest_hypothesis as closest_hypothesis
else:
    __getattr__, __dir__, __all__ = lazy_face(__name__, __file__)
    __all__.append("diagnose")


def diagnose(
    simulator: Any,
    train: Recording | Sequence[Recording],
    *,
    test: Recording | Sequence[Recording] | None = None,
    hold: str | None = None,
    laws: Sequence[type[Law] | str] | None = None,
    effects: int | None = None,
    limits: Mapping[str, float] | None = None,
    workers: int | None = None,
    engine: str = "auto",
    stand_in_error: float = 0.0,
    time_limit: float | None = 600.0,
    focus: str | None = None,
    search_samples: int | None = None,
    progress: Progress | bool | None = None,
) -> Diagnosis:
    """Find what a simulator leaves out, from recordings of the machine.

    Parameters
    ----------
    simulator : Simulator, control.StateSpace, or a fitted PI-LFR
        The simulator, with nominal parameters, bounds and ports.
    train : Recording or sequence of Recording
        Recordings to fit to and to choose on.
    test : Recording or sequence of Recording, optional
        Recordings to report on, never used to fit or to choose.
    hold : {"zero", "linear", "band-limited", "next"}, optional
        Course of the inputs between samples for recordings that do not state it; by default the simulator's, or else
        the data decide.
    laws : sequence of Law classes or names, optional
        A name is an id, such as "coulomb_friction", which stands for all forms of a law, or the name of a class. By
        default the whole catalogue, and `laws.VaryingParameter`, with which parameters may vary. Inputs that the
        simulator's equations do not read are tried as scales of some of its laws.
    effects : int, optional
        Largest number of effects to look for; by default as many as the recordings tell.
    limits : mapping, optional
        Largest amplitude of each input that a next experiment may have; by default what was recorded.
    workers : int, optional
        Fits run side by side, by default one per processor, at most four.
    engine : {"auto", "c", "vm"}
        Generated C or CasADi's virtual machine; by default C where there is a compiler.
    stand_in_error : float
        NRMSE between a surrogate and the simulation that it stands for; it counts as noise.
    time_limit : float, optional
        Seconds after which the search ends, by default ten minutes; the answer then rests on what was fitted until
        then, and says so. None sets no limit.
    focus : {"simulation", "prediction"}, optional
        Errors to minimise: of a free run, or of predictions one sample ahead by an observer, as for an unstable machine
        in closed loop. By default a free run, and predictions if the simulator is unstable and runs away.
    search_samples : int, optional
        Samples of the training recordings up to which the search uses everything, by default 60 000. If there are more,
        it uses the stretches that tell most of missing forces, and only the final fits use everything.
    progress : bool or callable, optional
        True shows a bar on the terminal; a callable gets (stage, done, total, smallest error so far).

    Returns
    -------
    Diagnosis

    Raises
    ------
    InputError
        If simulator and recordings do not fit each other.
    """
    from .._base import shown_progress
    from .arguments import read_arguments
    from .pipeline import diagnose_in_steps

    with shown_progress(progress) as report:
        request = read_arguments(
            simulator,
            train,
            test=test,
            hold=hold,
            laws=laws,
            effects=effects,
            limits=limits,
            workers=workers,
            engine=engine,
            stand_in_error=stand_in_error,
            time_limit=time_limit,
            focus=focus,
            search_samples=search_samples,
            progress=report,
        )
        return diagnose_in_steps(request)
