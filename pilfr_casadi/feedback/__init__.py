"""From a fitted model to a running controller: observer, hysteresis compensation, predictive control."""

from .feedforward import Feedforward, feedforward
from .inverse import Inverse, inverse
from .kalman import KalmanFilter, kalman_filter
from .mpc import Plan, PredictiveController
from .unseen import Visibility, visibility

__all__ = [
    "Feedforward",
    "Inverse",
    "KalmanFilter",
    "Plan",
    "PredictiveController",
    "Visibility",
    "feedforward",
    "inverse",
    "kalman_filter",
    "visibility",
]
