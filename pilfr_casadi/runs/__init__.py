"""Scripted identification runs: a file says what to do, a folder shows what was done, and nothing is done twice."""

from .campaign import campaign
from .described import Run, read_run
from .execute import RunInterrupted, RunResult, run
from .jobs import RunJob, jobs_of

__all__ = ["Run", "RunInterrupted", "RunJob", "RunResult", "campaign", "jobs_of", "read_run", "run"]
