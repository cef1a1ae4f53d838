"""Every figure of the package; the only folder that imports matplotlib.

Functions that draw one picture take an optional `ax` and return the axes (`axes.figure` is the figure); functions that
compose several return the `matplotlib.figure.Figure`.
"""

from typing import TYPE_CHECKING

from .._base.lazy import lazy_face

if TYPE_CHECKING:
    from .canvas import new_figure as new_figure
    from .chart import chart as chart
    from .diagnosis import (
        Signal as Signal,
        force_cloud as force_cloud,
        force_remainder as force_remainder,
        force_time as force_time,
        learned_force as learned_force,
        mismatch_bands as mismatch_bands,
        mismatch_growth as mismatch_growth,
        mismatch_level as mismatch_level,
        mismatch_map as mismatch_map,
        mismatch_time as mismatch_time,
        refined_hysteresis as refined_hysteresis,
        strength_over_signal as strength_over_signal,
    )
    from .fit_signals import (
        as_scored as as_scored,
        compares_linear as compares_linear,
        linear_simulation as linear_simulation,
        output_over_input as output_over_input,
        remains as remains,
        spectrum as spectrum,
        time as time,
        traces as traces,
    )
    from .fits import (
        convergence as convergence,
        loading_curve as loading_curve,
        loop as loop,
        plot_fit as plot_fit,
        virgin_curve as virgin_curve,
        weights as weights,
    )
    from .fleet import (
        machine_map as machine_map,
        machine_strips as machine_strips,
        machine_trends as machine_trends,
        small_multiples as small_multiples,
    )
    from .linear_parts import bode as bode, pole_zero as pole_zero
    from .signals import (
        Simulated as Simulated,
        amplitude_density as amplitude_density,
        compared_residuals as compared_residuals,
        compared_spectra as compared_spectra,
        compared_traces as compared_traces,
        plot_comparison as plot_comparison,
        plot_recording as plot_recording,
    )
    from .statistics import (
        best_linear_approximation as best_linear_approximation,
        compared_spread as compared_spread,
        frequency_response as frequency_response,
        loops as loops,
        residual_tests as residual_tests,
        spread as spread,
    )
else:
    __getattr__, __dir__, __all__ = lazy_face(__name__, __file__)
