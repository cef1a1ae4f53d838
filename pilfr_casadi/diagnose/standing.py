"""Former place of a part of `gates`; remove this file with its last import."""

from .gates import opened_at_the_start as opened_at_the_start
