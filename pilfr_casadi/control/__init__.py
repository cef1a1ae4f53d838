"""From a fitted model to a running controller: observer, hysteresis compensation, predictive control, bounds.

`estimation` holds the Kalman filter, and `observability` computes what outputs show of a state. `inverse` computes the
feedforward of a model, and `element_inverse` the inverse of its element. `control_task` is the checked problem of
predictive control; `mpc` solves it, and `dompc` hands it to do-mpc. `bounds` bounds the response to limited inputs.
"""

from typing import TYPE_CHECKING

from .._base.lazy import lazy_face

if TYPE_CHECKING:
    from .bounds import response_bound as response_bound
    from .dompc import do_mpc_controller as do_mpc_controller, do_mpc_model as do_mpc_model
    from .element_inverse import inverse_element as inverse_element
    from .estimation import (
        KalmanFilter as KalmanFilter,
        ekf_step as ekf_step,
        kalman_filter as kalman_filter,
        roll_out as roll_out,
    )
    from .inverse import (
        Feedforward as Feedforward,
        analyse_response as analyse_response,
        feedforward as feedforward,
    )
    from .mpc import PredictiveController as PredictiveController
    from .observability import visibility as visibility
else:
    __getattr__, __dir__, __all__ = lazy_face(__name__, __file__)
