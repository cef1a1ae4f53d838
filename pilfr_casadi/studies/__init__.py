"""Studies of many jobs in a folder of results: runs and campaigns, which a run file describes, and fleets of machines.

`executor` runs jobs of any kind side by side, `folder` keeps their results. Runs: `schema` (the tables of the file),
`run_file`, `jobs`, `execution`, `store`, `summary`. Fleets: `fleets` (the steps), `machines` (the steps at one
machine), `population` (statistics over machines), `fleet_result`.
"""

from typing import TYPE_CHECKING

from .._base.lazy import lazy_face

if TYPE_CHECKING:
    from .execution import (
        NoModel as NoModel,
        RunInterrupted as RunInterrupted,
        RunResult as RunResult,
        campaign as campaign,
        run as run,
        seeds_advice as seeds_advice,
    )
    from .executor import (
        AHEAD as AHEAD,
        Effort as Effort,
        Outcome as Outcome,
        dask_executor as dask_executor,
        run_side_by_side as run_side_by_side,
    )
    from .fleet_result import Fleet as Fleet, Machine as Machine, read_fleet as read_fleet
    from .fleets import FLEET as FLEET, common_physics as common_physics, fleet as fleet
    from .folder import (
        PAGE as PAGE,
        PICTURE as PICTURE,
        SUMMARY as SUMMARY,
        TABLE as TABLE,
        Manifest as Manifest,
        check_own as check_own,
        lock_folder as lock_folder,
    )
    from .jobs import MODEL as MODEL, fold as fold, input_digests as input_digests, jobs_of as jobs_of
    from .population import (
        Population as Population,
        combine as combine,
        estimate_population as estimate_population,
        slope as slope,
    )
    from .run_file import ROLES as ROLES, Cell as Cell, Run as Run, grid_keys as grid_keys, read_run as read_run
    from .schema import (
        LARGEST_SIZE as LARGEST_SIZE,
        ModelTable as ModelTable,
        RunTable as RunTable,
        SolverTable as SolverTable,
    )
    from .summary import reasons as reasons
else:
    __getattr__, __dir__, __all__ = lazy_face(__name__, __file__)
