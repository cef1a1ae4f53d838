"""Fits on disk: `save` and `load` a `Fit` as a model file (`export.write_model_file`)."""

from __future__ import annotations

import os

import numpy as np

from ..export import read_model_file
from ..models import PILFR, Model
from .options import Asked, asked_by
from .result import Candidate, Fit


def save(fit: Fit, path: str | os.PathLike[str]) -> None:
    """Write a fit as JSON, atomically: an existing file stays as it is until the new one is complete on disk.

    Parameters
    ----------
    fit : Fit
        The fit to save. A model of the user's own equations is saved by its values alone; see `load`.
    path : path
        The file, usually `*.json`.

    Raises
    ------
    InputError
        If the file cannot be written.
    """
    fit.save(path)


def load(path: str | os.PathLike[str], model: Model | PILFR | None = None) -> Fit:
    """Read a fit that `save` wrote; simulations are the same to the last digit.

    Parameters
    ----------
    path : path
        The file.
    model : Model or PILFR, optional
        The equations, where the file cannot hold them: a closed model of your own, or a PI-LFR whose element has
        envelope expressions of your own. Its values are replaced by those of the file.

    Returns
    -------
    Fit
        Of the starts that were tried only what they reached is kept: each candidate has its seed, error and status, an
        empty `theta` and the fitted model.

    Raises
    ------
    InputError
        If the file is missing, unreadable, damaged, of another kind or version, was changed after it was written, does
        not fit `model`, or holds values that are missing, not finite, or outside their bounds.

    Warns
    -----
    UserWarning
        If the file is of the first version of the format, which has no digest to tell changes by.
    """
    content = read_model_file(path, model)
    candidates = tuple(
        Candidate(c.seed, content.model, np.zeros(0), c.error, c.solution, note=c.note, drawn=c.drawn)
        for c in content.starts
    )
    asked = Asked()  # the first files did not say what the fit was asked with
    if content.limits is not None:
        asked = asked_by(content.limits, content.structure, noise=content.noise, weights=content.weights)
    return Fit(
        model=content.model,
        structure=content.structure,
        dt=content.dt,
        solution=content.solution,
        train_nrmse=content.train_nrmse,
        initial=dict(content.initial),
        labels=content.labels,
        errors=dict(content.errors),
        active=content.active,
        candidates=candidates,
        linear=content.linear,
        seconds=content.seconds,
        units=dict(content.units),
        linear_nrmse=content.linear_nrmse,
        limits=content.limits or (),
        asked=asked,
    )
