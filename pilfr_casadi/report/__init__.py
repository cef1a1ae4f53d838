"""Self-contained HTML pages of fits, diagnoses and anything else.

`page.py` holds the general page and its blocks. `fit.py`, `diagnosis.py` and `fleet.py` fill it, with the tables of a
diagnosis in `diagnosis_tables.py`. `cards.py` makes the short summaries for notebooks.
`templates/report.css` sets colours, fonts and layout, `templates/page.html` and `templates/blocks.html` the structure;
`templates/explore.js` turns pictures into charts.
"""

from typing import TYPE_CHECKING

from .._base.lazy import lazy_face

if TYPE_CHECKING:
    from .cards import (
        comparison_card as comparison_card,
        diagnosis_card as diagnosis_card,
        fit_card as fit_card,
        recording_card as recording_card,
        simulator_card as simulator_card,
    )
    from .diagnosis import diagnosis_page as diagnosis_page, diagnosis_report as diagnosis_report
    from .diagnosis_tables import corrected_file as corrected_file, usage as usage
    from .fit import fit_page as fit_page, fit_report as fit_report, mode_tables as mode_tables
    from .fleet import fleet_map as fleet_map, fleet_page as fleet_page, machine_page as machine_page
    from .page import (
        Bar as Bar,
        Code as Code,
        Link as Link,
        Page as Page,
        Picture as Picture,
        Section as Section,
        Table as Table,
        Text as Text,
        number_text as number_text,
        uncertain_text as uncertain_text,
        write_report as write_report,
    )

__getattr__, __dir__, __all__ = lazy_face(__name__, __file__)
