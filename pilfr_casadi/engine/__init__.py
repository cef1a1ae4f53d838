"""Engines that run a model: sensitivities by a matrix recursion, as generated C or in CasADi's virtual machine.

`sensitivities` holds the recursion and the virtual machine, `compiled` the generated C. Both engines sum in the same
order, so simulations, derivatives and fits agree bit for bit on x86-64.
"""

from typing import TYPE_CHECKING

from .._base.lazy import lazy_face

if TYPE_CHECKING:
    from .._base import (
        cache_directory as cache_directory,
        compiler as compiler,
        run_compiler as run_compiler,
    )
    from .compiled import (
        Compiled as Compiled,
        make_engine as make_engine,
        source_code as source_code,
    )
    from .sensitivities import Engine as Engine, VirtualMachine as VirtualMachine, linearize as linearize
else:
    __getattr__, __dir__, __all__ = lazy_face(__name__, __file__)
