"""Former place of a part of `residual_spectrum`; remove this file with its last import."""

from .residual_spectrum import ringing as ringing
