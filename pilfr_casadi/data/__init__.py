"""Recordings, before any model: reading and preprocessing them, excitation signals, metrics, periods and units.

`recording` holds the class `Recording`, and `holds` what its inputs do between samples. `readers` makes recordings of
files and frames: `tables` opens files by suffix (add a file type in `OPENERS`), `csv_table` parses text, `columns`
tells time columns and units by their names, `time_grid` finds the step, and `common_clock` merges files.
`preprocessing` resamples and filters, `periods` finds and averages periods, `units` converts units, `excitation` makes
signals, and `metrics` compares them.
"""

from typing import TYPE_CHECKING

from .._base.lazy import lazy_face

if TYPE_CHECKING:
    from .columns import TIME_NAMES as TIME_NAMES, is_time as is_time, name_with_unit as name_with_unit
    from .common_clock import merge as merge
    from .excitation import (
        excited_bins as excited_bins,
        multisine as multisine,
        orthogonal_multisine as orthogonal_multisine,
        prbs as prbs,
        sine_sweep as sine_sweep,
        steady_periods as steady_periods,
        tukey_realizations as tukey_realizations,
    )
    from .holds import (
        COURSES as COURSES,
        HOLD_CHOICES as HOLD_CHOICES,
        HOLDS as HOLDS,
        Hold as Hold,
        interpolate_band_limited as interpolate_band_limited,
        known_hold as known_hold,
        step_hold as step_hold,
    )
    from .metrics import (
        BAND as BAND,
        DIVERGING as DIVERGING,
        NOTHING_SENTENCE as NOTHING_SENTENCE,
        chance as chance,
        correlation as correlation,
        explains_nothing as explains_nothing,
        nrmse as nrmse,
        rmse as rmse,
        rmse_per_output as rmse_per_output,
    )
    from .periods import (
        group_by_input as group_by_input,
        keeps_its_period as keeps_its_period,
        mean_period as mean_period,
        noise_weights as noise_weights,
        period_noise as period_noise,
        repeats_itself as repeats_itself,
        same_input as same_input,
    )
    from .readers import (
        column_names as column_names,
        read as read,
        read_csv as read_csv,
        read_frame as read_frame,
        read_mat as read_mat,
        read_npz as read_npz,
        written_times as written_times,
    )
    from .recording import (
        SAME_STEP as SAME_STEP,
        Recording as Recording,
        as_recordings as as_recordings,
        as_tuple as as_tuple,
        check_for_identification as check_for_identification,
        default_names as default_names,
        fingerprint as fingerprint,
        moves_freely as moves_freely,
    )
    from .tables import STACK_SUFFIXES as STACK_SUFFIXES, TABLE_SUFFIXES as TABLE_SUFFIXES, read_stack as read_stack
    from .time_grid import step_of as step_of
    from .units import (
        conversion as conversion,
        dimension as dimension,
        insert_units as insert_units,
        revolution_in as revolution_in,
        symbols as symbols,
    )

__getattr__, __dir__, __all__ = lazy_face(__name__, __file__)
