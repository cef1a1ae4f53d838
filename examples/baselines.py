"""Compare black-box models with a PI-LFR on the same recordings, to show the benefit of the element's structure."""

import pilfr_casadi as pilfr
from pilfr_casadi.cli.demo import demo_recordings

records = demo_recordings()
train = records["train"].slice(0, 2048)  # the first of three realizations
models = {
    "linear": pilfr.PILFR(nx=5),
    "SS-NN": pilfr.ssnn(nx=5, hidden=5),
    "NARX": pilfr.NARX(lags=5, hidden=5),
    "NOE": pilfr.NOE(lags=5, hidden=5),
    "LFR, static network": pilfr.network_lfr(nx=5, hidden=5),
    "PI-Hammerstein": pilfr.hammerstein(5, pilfr.PrandtlIshlinskii(pilfr.Play, 5)),
    "PI-LFR": pilfr.PILFR(nx=5, element=pilfr.PrandtlIshlinskii(pilfr.Play, 5)),
}
fits = {name: pilfr.fit(model, train, starts=2) for name, model in models.items()}
errors = {name: [fit.nrmse(records[s]) for s in ("multisine", "sweep")] for name, fit in fits.items()}

for name, row in errors.items():
    print(f"{name:<20}" + "".join(f"{e:9.4f}" for e in row))
one = pilfr.one_step(fits["NARX"], train) - train.y
print(f"the NARX one step ahead {one.std() / train.y.std():.4f}")  # the error that its training minimises, not free run

assert all(errors["PI-LFR"][0] < 0.5 * row[0] for name, row in errors.items() if name != "PI-LFR")
