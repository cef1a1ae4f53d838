"""Former place of a part of `screen`; remove this file with its last import."""

from .screen import explainable as explainable
