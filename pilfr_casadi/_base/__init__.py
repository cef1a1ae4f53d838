"""Foundation of all other folders.

`errors` holds `InputError` and checks of arguments, `files` writes files and digests, `c_compiler` builds and caches
libraries, `workers` runs work in threads and processes, `interrupts` handles Ctrl-C and time limits, `progress` reports
stages, and `lazy` makes the face of a folder, whose names are imported when they are first used.
"""

from typing import TYPE_CHECKING

from .lazy import lazy_face

__version__ = "0.1.0"

if TYPE_CHECKING:
    from .c_compiler import (
        LOOPS as LOOPS,
        build as build,
        cache_directory as cache_directory,
        compiler as compiler,
        run_compiler as run_compiler,
    )
    from .errors import (
        LARGEST as LARGEST,
        REPAIR as REPAIR,
        InputError as InputError,
        capitalise as capitalise,
        check_known as check_known,
        existing_file as existing_file,
        filled as filled,
        in_words as in_words,
        is_number as is_number,
        is_whole as is_whole,
        listed as listed,
        multiple as multiple,
        numbers as numbers,
        one_line as one_line,
        percent as percent,
        positive as positive,
        quote_error as quote_error,
        read_bytes as read_bytes,
        real_array as real_array,
        usable as usable,
        whole as whole,
        without_mask as without_mask,
    )
    from .files import (
        csv_text as csv_text,
        digest as digest,
        json_text as json_text,
        make_folder as make_folder,
        ordered_digest as ordered_digest,
        path_text as path_text,
        short as short,
        to_json as to_json,
        with_nan as with_nan,
        write_atomically as write_atomically,
    )
    from .interrupts import (
        Clock as Clock,
        Interrupt as Interrupt,
        UntilInterrupted as UntilInterrupted,
        abandoned as abandoned,
        deferred_interrupt as deferred_interrupt,
        handled_interrupt as handled_interrupt,
        is_interrupt as is_interrupt,
        terminable as terminable,
        time_limit as time_limit,
        unwrapped_interrupt as unwrapped_interrupt,
    )
    from .lazy import later as later
    from .progress import (
        Progress as Progress,
        Stages as Stages,
        progress_bar as progress_bar,
        shown_progress as shown_progress,
    )
    from .workers import (
        ChildProcess as ChildProcess,
        Reply as Reply,
        check_executor as check_executor,
        close_workers as close_workers,
        one_at_a_time as one_at_a_time,
        one_blas_thread as one_blas_thread,
        open_replies as open_replies,
        processors as processors,
        read_message as read_message,
        run_in_worker as run_in_worker,
        side_by_side as side_by_side,
        worker_pool as worker_pool,
        write_message as write_message,
    )

__getattr__, __dir__, __all__ = lazy_face(__name__, __file__)
