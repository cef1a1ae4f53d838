"""Former place of a part of `other_explanations`; remove this file with its last import."""

from .other_explanations import varying as varying
