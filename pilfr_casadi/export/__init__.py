"""Models on disk, and models as CasADi functions."""

from .files import made, write_atomically
from .functions import to_casadi
from .loading import load
from .saving import FORMAT, VERSION, save

__all__ = ["FORMAT", "VERSION", "load", "made", "save", "to_casadi", "write_atomically"]
