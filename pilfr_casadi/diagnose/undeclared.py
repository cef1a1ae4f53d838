"""Former place of a part of `other_explanations`; remove this file with its last import."""

from .other_explanations import beyond_the_ports as beyond_the_ports
