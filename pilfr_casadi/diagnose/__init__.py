"""Find the physics that a simulator leaves out: where, what, how sure, and the proof."""

from .result import Diagnosis, Effect
from .run import diagnose

__all__ = ["Diagnosis", "Effect", "diagnose"]
