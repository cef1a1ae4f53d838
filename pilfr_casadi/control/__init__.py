"""From a fitted model to a running controller: observer, hysteresis compensation, predictive control, bounds."""

from typing import TYPE_CHECKING

from .._base.lazy import lazy_face

if TYPE_CHECKING:
    from .bounds import response_bound as response_bound
    from .compensation import Feedforward as Feedforward, feedforward as feedforward
    from .dompc import do_mpc_controller as do_mpc_controller, do_mpc_model as do_mpc_model
    from .inverse import inverse_element as inverse_element
    from .kalman import KalmanFilter as KalmanFilter, kalman_filter as kalman_filter
    from .mpc import PredictiveController as PredictiveController
    from .unseen import visibility as visibility
else:
    __getattr__, __dir__, __all__ = lazy_face(__name__, __file__)
