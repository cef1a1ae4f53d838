"""Every figure of the package; the only place that knows matplotlib, so import it where a figure is made.

Functions that draw one picture take an optional `ax` and return the axes (`axes.figure` is the figure); those that
compose several return the `matplotlib.figure.Figure`.
"""

from .canvas import new_figure
from .law import loading_curve, loop, virgin_curve, weights
from .measured import best_linear_approximation, compared_spread, frequency_response, loops, operators_demo, spread
from .overview import convergence, plot_fit
from .signals import amplitude_density, as_scored, linear_simulation, output_over_input, remains, spectrum, time, traces

__all__ = [
    "amplitude_density",
    "as_scored",
    "best_linear_approximation",
    "compared_spread",
    "convergence",
    "frequency_response",
    "linear_simulation",
    "loading_curve",
    "loop",
    "loops",
    "new_figure",
    "operators_demo",
    "output_over_input",
    "plot_fit",
    "remains",
    "spectrum",
    "spread",
    "time",
    "traces",
    "virgin_curve",
    "weights",
]
