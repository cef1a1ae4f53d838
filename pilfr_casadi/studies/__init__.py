"""Scripted identification runs and campaigns: a file says what to do, a folder shows what was done."""

from typing import TYPE_CHECKING

from .._base.lazy import lazy_face

if TYPE_CHECKING:
    from .campaigns import campaign as campaign, seeds_advice as seeds_advice
    from .cluster import dask_executor as dask_executor
    from .described import ROLES as ROLES, Run as Run, read_run as read_run
    from .execute import NoModel as NoModel, RunInterrupted as RunInterrupted, RunResult as RunResult, run as run
    from .executor import AHEAD as AHEAD, side_by_side as side_by_side
    from .folder import (
        MODEL as MODEL,
        PAGE as PAGE,
        PICTURE as PICTURE,
        SUMMARY as SUMMARY,
        TABLE as TABLE,
        check_own as check_own,
    )
    from .grid import Cell as Cell, grid_keys as grid_keys
    from .jobs import jobs_of as jobs_of
    from .limits import LARGEST_SIZE as LARGEST_SIZE
    from .results import reasons as reasons
else:
    __getattr__, __dir__, __all__ = lazy_face(__name__, __file__)
