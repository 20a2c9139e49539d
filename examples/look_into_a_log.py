"""How well does the slave follow, and how old is what it follows?

A notebook as a script: each `# %%` is a cell in VS Code, PyCharm, Spyder or, by `jupytext`, in Jupyter. It
runs from top to bottom as it stands, makes its own log, and draws `look_into_a_log.png`.

    python examples/look_into_a_log.py            # a log from virtual time
    python examples/look_into_a_log.py run.mcap   # one of yours; several parts of a run may be named
"""

# %% A log: yours, or five seconds of the paper's experiment on a link that jitters
import sys

import matplotlib.pyplot as plt
import numpy as np

import trilat_net

files = [name for name in sys.argv[1:] if name.endswith(".mcap")]
log = trilat_net.open_log(*files) if files else trilat_net.simulate("jitter", {"duration_s": 5})
print(log)

# %% What ran: the scenario stands in the log, every value of every site and link
slave = next(
    (name for name in log.sites if log.scenario.sites[name].role == "slave"), log.sites[-1]
)
print(
    f"{log.session['driver']} session of {log.session['scenario']}, seed {log.session['seed']}"
)
for name, link in log.scenario.links.items():
    print(f"  {name}: {link.describe()}")

# %% Arrays with time: a row per tick, SI units and radians
site = log[slave]
print(site)
error_rad = np.abs(site.e)  # q - q_des, shape (K, 2)
print(
    f"largest tracking error {error_rad.max():.4f} rad, at {site.t_s[error_rad.max(axis=1).argmax()]:.3f} s"
)

# %% How old is the sample in use? Ages are NaN before the first
ages_ms = {
    peer: 1e3 * site.age_s(peer, log.scenario.sites[peer].rate_hz) for peer in site.peers
}
for peer, age_ms in ages_ms.items():
    median, worst = np.nanpercentile(age_ms, [50, 100])
    print(
        f"sample of {peer} in use at {slave}: median {median:.1f} ms old, at most {worst:.1f} ms"
    )

# %% One figure
figure, (top, middle, bottom) = plt.subplots(
    3, sharex=True, figsize=(8, 7), layout="constrained"
)
for joint in range(2):
    (line,) = top.plot(site.t_s, site.q[:, joint], label=f"q{joint + 1}")
    top.plot(
        site.t_s,
        site.q_des[:, joint],
        ":",
        color=line.get_color(),
        label=f"q{joint + 1} reference",
    )
    middle.plot(site.t_s, site.e[:, joint], label=f"joint {joint + 1}")
for peer, age_ms in ages_ms.items():
    bottom.plot(site.t_s, age_ms, label=f"from {peer}")
top.set_ylabel("angle of the joint / rad")
middle.set_ylabel("q - q_des / rad")
bottom.set_ylabel("age of the sample in use / ms")
bottom.set_xlabel("time / s")
for axes in (top, middle, bottom):
    axes.legend(loc="center left", bbox_to_anchor=(1.0, 0.5))
figure.suptitle(f"{slave} in {log.session['scenario']}")
figure.savefig("look_into_a_log.png", dpi=150)

# %% The same as a data frame, where polars is installed: pip install 'trilat-net[frames]'
try:
    import polars as pl
except ImportError:
    pl = None
    print("no polars: what follows is left out")

if pl is not None:
    frame = log.frame(slave)  # log.to_frame(slave) where you prefer pandas
    print(frame.select("t_s", "q1_rad", "q2_rad", "tau1_nm", "tau2_nm", "mode").tail(3))

# %% Per second: how large the error was, how old the samples were
if pl is not None:
    ages = [column for column in frame.columns if column.startswith("age_")]
    error1_rad = (pl.col("q1_rad") - pl.col("q_des1_rad")).abs()
    seconds = frame.group_by(pl.col("t_s").floor().alias("from_s"), maintain_order=True)
    print(seconds.agg(error1_rad.max().alias("error1_rad"), pl.col(ages).mean()))

# %% Two sites side by side: each record of one with the last one of the other before it
if pl is not None:
    peer = site.peers[0]
    theirs = log.frame(peer).select("t_s", theirs_rad="q1_rad")
    both = frame.select("t_s", "q1_rad").join_asof(theirs, on="t_s")
    apart_rad = (both["q1_rad"] - both["theirs_rad"]).abs().mean()
    print(f"{slave} and {peer}: joint 1 was {apart_rad:.4f} rad apart on average")

# %% What happened
if pl is not None:
    print(log.frame("events").select("t_s", "member", "kind", "text"))
