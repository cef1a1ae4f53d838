"""The search over hypotheses: the simulator with laws in its ports, all fitted to the same recordings.

`hypotheses` keeps what was fitted, with its evidence. `moves` leads from one hypothesis to others, and `forms` fits the
law that a move has added in other forms; `pairs` selects two laws at once, and `trials` fits them.
`learned` fits forces that have no name yet. `stretches` chooses what a search sees of long recordings, and fits the
likeliest hypotheses to everything.
"""
