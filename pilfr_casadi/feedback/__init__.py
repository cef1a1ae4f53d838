"""From a fitted model to a running controller: observer, hysteresis compensation, predictive control."""

from .kalman import KalmanFilter, kalman_filter

__all__ = ["KalmanFilter", "kalman_filter"]
