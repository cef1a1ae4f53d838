"""Models on disk, and models as CasADi functions."""

from .digests import digest
from .exported_model import NAMES, Exported
from .files import made, write_atomically
from .functions import exported, to_casadi
from .loading import load
from .saving import FORMAT, VERSION, save

__all__ = [
    "FORMAT",
    "NAMES",
    "VERSION",
    "Exported",
    "digest",
    "exported",
    "load",
    "made",
    "save",
    "to_casadi",
    "write_atomically",
]
