"""Answers banked from an earlier commit, and the command that replays and compares them."""
