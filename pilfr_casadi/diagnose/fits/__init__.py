"""Fits of a simulator to recordings, and what is left of them, on which every step of a diagnosis rests.

`workbench` integrates and fits a simulator with open ports. `floor` estimates the noise, and `coloured_noise` tells
slow noise from missing physics. `linearise` computes the response to small forces at ports; with it `screen` scores
every port and law, and `force_recovery` recovers the hidden force in a port. `evidence` is the one scale on which fits
are compared, with a table of the numbers on which answers rest.
"""
