"""A cart on a spring and a damper, driven by a force: the smallest machine for the tests of the diagnosis."""

from pilfr_casadi import Parameter, Port, Simulator

GROUND = Port("ground", {"vel": -1.0}, lambda x: x.pos, lambda x: x.vel)


def cart(k=40.0, d=1.0, k_bounds=(10, 200), d_bounds=(0, 5), output="pos", ports=(GROUND,)):
    """A simulator of it, of unit mass."""
    return Simulator(
        lambda x, u, p: {"pos": x.vel, "vel": u.force - p.k * x.pos - p.d * x.vel},
        lambda x: {output: x.pos},
        states=("pos", "vel"),
        inputs=("force",),
        parameters={"k": Parameter(k, bounds=k_bounds), "d": Parameter(d, bounds=d_bounds)},
        ports=ports,
    )
