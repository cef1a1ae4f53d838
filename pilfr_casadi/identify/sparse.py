r"""Regularization paths: fits with fewer operators or stronger priors, chosen by validation.

Along the path the objective of Krikelis et al. (2024), Eq. 20, has

    l1 Σ_j w_ij        (unneeded operators get zero weight and are removed; the rest is fitted again), or
    s ((θ - m) / σ)²   (a prior of mean m and standard deviation σ, s times as strong).

Every fit is judged by its free-run simulation of a validation recording, to which none of them was fitted. The
strongest regularization whose validation error is within a margin of the smallest is recommended; no test recording is
used. Penalised estimates are biased towards zero, hence the second fit (relaxed lasso, Meinshausen 2007). It uses the
remaining operators, or the same number of operators spread over the density of the first fit's weights, at several
spacings and with a prior on their weights. Validation chooses between these too.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from .._base import InputError, Progress, is_number
from ..data import Recording, as_recordings, fingerprint
from ..models import LAYER, PILFR, PrandtlIshlinskii
from ..optimise import Candidate, Status
from .context import context_of_fit, rms_error
from .fitting import fit as identify
from .multistart import DEFAULT_SOLVER, StartSearch, hold_near_density, polish, regrid_channels
from .result import DENSITY_PRIOR, Fit

FACTORS = (0.01, 0.1, 1.0, 10.0, 100.0)  # on the strength of priors
STRENGTHS = (1.0, 10.0, 30.0, 100.0, 300.0, 1000.0)  # of the L1 penalty, in units of the objective without it
# (extent, spacing) of `regrid` with which operators are spread
SPREADINGS = tuple((extent, spacing) for extent in (1.0, 1.15, 1.3) for spacing in (0.25, 0.4))
SPREAD = 0.02  # relative deviation of the prior on the weights of spread operators


@dataclass(frozen=True, eq=False, repr=False)
class RegularizationPath:
    """Fits over the strength of a regularization.

    Attributes
    ----------
    strengths : tuple of float
        Weakest first; 0 stands for the fit without regularization.
    fits : tuple of Fit
        One for each strength.
    operators : tuple of int
        Number of operators of each fit.
    train, validation : tuple of float
        NRMSE (Eq. 27) of each fit.
    recommended : int
        Index of the strongest regularization whose validation error is within `margin` of the smallest.
    margin : float
        Share of the smallest validation error.
    """

    strengths: tuple[float, ...]
    fits: tuple[Fit, ...]
    operators: tuple[int, ...]
    train: tuple[float, ...]
    validation: tuple[float, ...]
    recommended: int
    margin: float

    @property
    def fit(self) -> Fit:
        """The recommended fit."""
        return self.fits[self.recommended]

    def __repr__(self) -> str:
        rows = [f"{'strength':>10}  {'operators':>9}  {'train':>9}  {'validation':>10}"]
        columns = zip(self.strengths, self.operators, self.train, self.validation, strict=True)
        for i, (s, n, a, b) in enumerate(columns):
            mark = "  <- recommended" if i == self.recommended else ""
            rows.append(f"{s:>10.3g}  {n:>9}  {a:>9.5f}  {b:>10.5f}{mark}")
        return "\n".join([*rows, f"the strongest within {100 * self.margin:g} % of the smallest validation error"])


def operators_used(fit: Fit) -> int:
    """Count the operators with a weight above zero over all channels; 0 without a Prandtl-Ishlinskii element."""
    return int(np.sum(fit.parameters["w"] > 0)) if "w" in fit.parameters else 0


def prune(fit: Fit, train: Recording | Sequence[Recording], **options: Any) -> Fit:
    """Remove the operators of zero weight from a fit, and fit the rest again without a penalty.

    Parameters
    ----------
    fit : Fit
        A fit of a PI-LFR with a Prandtl-Ishlinskii element, usually with an L1 penalty on `w`.
    train : Recording or sequence of Recording
        Training data of the fit.
    options
        As for `fit`: `solver`, `engine`, `stable`, `constraints`, `noise`, `weights`; the last four default to the
        options of the fit.

    Returns
    -------
    Fit
        Each channel has as many operators as the channel with the most nonzero weights, at least one.

    Raises
    ------
    InputError
        If the model has no such element.
    """
    structure = getattr(fit, "structure", None)
    if structure is None or not isinstance(structure.element, PrandtlIshlinskii):
        raise InputError("Only a PI-LFR with a Prandtl-Ishlinskii element has operators to remove; give a fit of one.")
    element, weights = structure.element, fit.parameters["w"]
    n = max(1, int(np.max(np.sum(weights > 0, axis=1))))
    # indices of the operators that remain, one row per channel
    kept = np.sort(np.argsort(weights <= 0, axis=1, kind="stable")[:, :n], axis=1)
    full = weights.shape

    def select(value: Any) -> Any:
        array = np.asarray(value, dtype=float)
        return np.take_along_axis(np.broadcast_to(array, full), kept, axis=1) if array.ndim else array

    smaller = replace(
        structure,
        element=replace(element, n=n),
        fixed={k: select(v) if k in LAYER else v for k, v in structure.fixed.items()},
        bounds={k: (select(v[0]), select(v[1])) if k in LAYER else v for k, v in structure.bounds.items()},
        priors={k: (select(v[0]), select(v[1])) if k in LAYER else v for k, v in structure.priors.items()},
    )
    values = {k: select(v) if k in LAYER else v for k, v in fit.parameters.items()}
    model, n_x = smaller.model_for(fit.model, values), fit.model.n_x
    memory = (np.arange(element.channels)[:, None] * element.n + kept).ravel()
    initial = {key: np.concatenate([s[:n_x], s[n_x:][memory]]) for key, s in fit.initial.items()}
    fitted = identify(replace(fit, model=model, structure=smaller, initial=initial), train, **options)
    return fitted if fitted.status is Status.INTERRUPTED else polish_fit(fitted, train, **options)


def polish_fit(fit: Fit, train: Recording | Sequence[Recording], *, solver: Any = None, **options: Any) -> Fit:
    """Polish a fit as a search polishes its best starts (`polish`); return the fit itself if the result is worse."""
    structure, context = fit.structure, context_of_fit(fit, train, solver=solver or DEFAULT_SOLVER, **options)
    assert structure is not None
    search = StartSearch(context, structure, {}, level=float(np.mean(fit.train_nrmse)))
    problem = search.problem(fit.model)
    states = [fit.initial_state(r) for r in context.recordings if r.begins == "estimate"]
    theta = np.concatenate([problem.start[: problem.n_free], *states])
    error = rms_error(problem, theta)
    best = polish(search, Candidate(0, fit.model, theta, error, fit.solution, fit.note))
    if best.model is fit.model and best.error >= error:
        return fit
    problem = context.problem(best.model, best.error)
    solution = context.solve(problem, "solve", best.theta)
    found = context.result(best.model, structure, problem, solution, note=best.note)
    return replace(found, seconds=found.seconds + fit.seconds, linear=fit.linear, linear_nrmse=fit.linear_nrmse)


def regularization_path(
    fit: Fit,
    train: Recording | Sequence[Recording],
    validation: Recording | Sequence[Recording],
    *,
    strengths: Sequence[float] | None = None,
    priors: Mapping[str, tuple[Any, Any]] | None = None,
    margin: float = 0.05,
    progress: Progress | None = None,
    **options: Any,
) -> RegularizationPath:
    """Fit with a regularization of growing strength, and choose by validation.

    Parameters
    ----------
    fit : Fit
        The fit without regularization, of a PI-LFR; every fit of the path begins there.
    train : Recording or sequence of Recording
        Training data of the fit.
    validation : Recording or sequence of Recording
        Data by which the strength is chosen: neither training recordings nor recordings for a later test.
    strengths : sequence of float
        L1 weights on `w` (default: 1 to 1000 times the objective of the fit) or, with `priors`, factors on their
        strength (default: 0.01 to 100).
    priors : mapping
        `(mean, std)` by parameter name, in place of the L1 penalty on `w`.
    margin : float
        Share of the smallest validation error that a stronger regularization may cost.
    progress : callable
        Gets ("path", done, total, smallest validation error so far).
    options
        As for `prune`.

    Raises
    ------
    InputError
        If the fit is not a fit of a PI-LFR, a strength or the margin is invalid, or a validation recording is a
        training recording.
    """
    structure, training, unseen = _check_path(fit, train, validation, priors is None)
    ascending = _sort_strengths(fit.solution.cost if priors is None else None, strengths, margin)
    _replace_priors(fit, structure, priors or {})  # refuses unusable ones
    fits, errors = [fit], [fit.nrmse(unseen)]
    thin: dict[int, tuple[Fit, ...]] = {}
    for i, strength in enumerate(ascending):
        if priors is None:
            found = _fit_sparser(fit, training, unseen, strength, thin, options)
        else:
            scaled = {k: (m, np.asarray(s, dtype=float) / np.sqrt(strength)) for k, (m, s) in priors.items()}
            found = _raise_if_interrupted(identify(_replace_priors(fit, structure, scaled), training, **options))
        fits.append(found)
        errors.append(found.nrmse(unseen))
        if progress:
            progress("path", i + 1, len(ascending), float(np.nanmin(errors)))
    usable = np.where(np.isfinite(errors), errors, np.inf)
    recommended = int(np.max(np.flatnonzero(usable <= (1 + margin) * np.min(usable))))
    return RegularizationPath(
        strengths=(0.0, *map(float, ascending)),
        fits=tuple(fits),
        operators=tuple(operators_used(f) for f in fits),
        train=tuple(f.nrmse(training) for f in fits),
        validation=tuple(map(float, errors)),
        recommended=recommended,
        margin=float(margin),
    )


def _replace_priors(fit: Fit, structure: PILFR, priors: Mapping[str, tuple[Any, Any]]) -> Fit:
    changed = replace(structure, priors={**structure.priors, **priors})
    parameters = fit.model.parameters.change(**{k: {"prior": prior} for k, prior in priors.items()})
    return replace(fit, structure=changed, model=fit.model.with_parameters(parameters))


def _check_path(
    fit: Any, train: Any, validation: Any, sparse: bool
) -> tuple[PILFR, tuple[Recording, ...], tuple[Recording, ...]]:
    """Check the arguments of a path; return the structure and the recordings. A `sparse` path needs operators."""
    if not isinstance(fit, Fit):
        raise InputError(f"A {type(fit).__name__} was given for a regularization path; give a Fit.")
    structure, training, unseen = fit.structure, as_recordings(train), as_recordings(validation)
    if structure is None or (sparse and not isinstance(structure.element, PrandtlIshlinskii)):
        raise InputError("A regularization path needs a fit of a PI-LFR with an element; give one.")
    if {fingerprint(r) for r in training} & {fingerprint(r) for r in unseen}:
        raise InputError("A validation recording is also a training recording; give one that was not fitted.")
    return structure, training, unseen


def _sort_strengths(unit: float | None, strengths: Any, margin: Any) -> list[float]:
    """Check and sort strengths; default penalties are in units of the objective `unit`, which is None for priors."""
    if strengths is None:
        strengths = FACTORS if unit is None else [unit * s for s in STRENGTHS]
    valid = isinstance(strengths, Sequence | np.ndarray) and all(is_number(s) and 0 < s < np.inf for s in strengths)
    if not (valid and len(strengths) and is_number(margin) and 0 <= margin < np.inf):
        raise InputError(
            f"strengths = {strengths!r} and margin = {margin!r} were given; give one strength or more, all above zero, "
            "and a margin of zero or more."
        )
    return sorted({float(s) for s in strengths})


def _fit_sparser(
    fit: Fit,
    training: tuple[Recording, ...],
    unseen: tuple[Recording, ...],
    strength: float,
    thin: dict[int, tuple[Fit, ...]],
    options: Mapping[str, Any],
) -> Fit:
    """Return the best fit on validation, with the operators that a penalty leaves or as many spread ones.

    `thin` stores the fits with spread operators by their number.
    """
    pruned = _raise_if_interrupted(
        prune(_raise_if_interrupted(identify(fit, training, l1={"w": strength}, **options)), training, **options)
    )
    n = max(1, pruned.structure.element.n)  # type: ignore[union-attr]
    if n not in thin:
        thin[n] = tuple(_raise_if_interrupted(f) for f in thin_operators(fit, training, n, **options))
    return min((pruned, *thin[n]), key=lambda f: np.nan_to_num(f.nrmse(unseen), nan=np.inf))


def _raise_if_interrupted(fit: Fit) -> Fit:
    """Return the fit; if it was interrupted, raise the interrupt again."""
    if fit.status is Status.INTERRUPTED:
        raise KeyboardInterrupt
    return fit


def thin_operators(
    fit: Fit, train: Recording | Sequence[Recording], n: int, *, solver: Any = None, **options: Any
) -> tuple[Fit, ...]:
    """Fit with n operators per channel, spread over the density of a fit's weights at several spacings.

    The options of the fit apply unless others are given. Returns no fits if weights or thresholds are fixed, bounded or
    have a prior.
    """
    structure, recordings = fit.structure, as_recordings(train)
    bound = structure is None or set(LAYER) & {*structure.fixed, *structure.bounds, *structure.priors}
    if structure is None or bound or not isinstance(structure.element, PrandtlIshlinskii):
        return ()
    smaller = replace(structure, element=replace(structure.element, n=n))
    z = np.concatenate([fit.signals(r)["z"] for r in recordings])
    states = [fit.initial_state(r) for r in recordings if r.begins == "estimate"]
    states = [np.concatenate([s[: fit.model.n_x], np.zeros(n * structure.element.channels)]) for s in states]
    fits: list[Fit] = []
    for extent, spacing in SPREADINGS:
        context = context_of_fit(
            replace(fit, structure=smaller), recordings, solver=solver or DEFAULT_SOLVER, **options
        )
        values = regrid_channels(structure, fit.parameters, z, extent=extent, spacing=spacing, count=n)
        model = hold_near_density(smaller.model_for(fit.model, values), values, SPREAD)
        problem = context.problem(model, float(np.mean(fit.train_nrmse)))
        begin = np.concatenate([problem.start[: problem.n_free], *states])
        if not np.isfinite(problem.cost(begin)):
            continue
        fitted = context.result(model, smaller, problem, context.solve(problem, "solve", begin), note=DENSITY_PRIOR)
        fits.append(replace(fitted, linear=fit.linear, linear_nrmse=fit.linear_nrmse))
        if fitted.status is Status.INTERRUPTED:
            break
    return tuple(fits)
