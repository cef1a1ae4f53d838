"""Former place of a part of `_base`; remove this file with its last import."""

from .._base import Stages as Stages
