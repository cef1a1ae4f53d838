"""From a fitted model to a running controller: observer, hysteresis compensation, predictive control."""

from .compensation import Feedforward, feedforward
from .dompc import do_mpc_controller, do_mpc_model
from .inverse import Inverse, inverse_element
from .kalman import KalmanFilter, kalman_filter
from .mpc import PredictiveController
from .plan import Plan
from .unseen import Visibility, visibility

__all__ = [
    "Feedforward",
    "Inverse",
    "KalmanFilter",
    "Plan",
    "PredictiveController",
    "Visibility",
    "do_mpc_controller",
    "do_mpc_model",
    "feedforward",
    "inverse_element",
    "kalman_filter",
    "visibility",
]
