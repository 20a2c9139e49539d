"""Analyses a log: how well does the slave follow, and how old are the samples in use?

This script is also a notebook: each `# %%` starts a cell in VS Code, PyCharm, Spyder or, with
`jupytext`, in Jupyter. Without arguments it simulates a run. It draws `look_into_a_log.png`.

    python examples/look_into_a_log.py            # a simulated run
    python examples/look_into_a_log.py run.mcap   # a log of yours, or all parts of one
"""

# %% Open a log, or simulate five seconds of an experiment over links with jitter
import sys

import matplotlib.pyplot as plt
import numpy as np

import trilat_net

files = [name for name in sys.argv[1:] if name.endswith(".mcap")]
log = trilat_net.open_log(*files) if files else trilat_net.simulate("jitter", {"duration_s": 5})
print(log)

# %% The log contains the scenario, with all values of all sites and links
slave = next(
    (name for name in log.sites if log.scenario.sites[name].role == "slave"), log.sites[-1]
)
print(
    f"{log.session['driver']} session of {log.session['scenario']}, seed {log.session['seed']}"
)
for name, link in log.scenario.links.items():
    print(f"  {name}: {link.describe()}")

# %% The signals of a site are arrays with a row per tick, in SI units and radians
site = log[slave]
print(site)
error_rad = np.abs(site.e)  # q - q_des, shape (K, 2)
worst_s = site.t_s[error_rad.max(axis=1).argmax()]
print(f"largest tracking error {error_rad.max():.4f} rad, at {worst_s:.3f} s")

# %% How old is the sample in use? The age is NaN before the first sample
ages_ms = {
    peer: 1e3 * site.age_s(peer, log.scenario.sites[peer].rate_hz) for peer in site.peers
}
for peer, age_ms in ages_ms.items():
    median, worst = np.nanpercentile(age_ms, [50, 100])
    print(
        f"sample of {peer} in use at {slave}: "
        f"median {median:.1f} ms old, at most {worst:.1f} ms"
    )

# %% Draw a figure
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

# %% The same signals as a data frame; this needs polars: make extras EXTRAS=frames
try:
    import polars as pl
except ImportError:
    pl = None
    print("no polars: the rest is skipped")

if pl is not None:
    frame = log.frame(slave)  # for pandas: log.to_frame(slave)
    print(frame.select("t_s", "q1_rad", "q2_rad", "tau1_nm", "tau2_nm", "mode").tail(3))

# %% Largest error and mean age of the samples in each second
if pl is not None:
    ages = [column for column in frame.columns if column.startswith("age_")]
    error1_rad = (pl.col("q1_rad") - pl.col("q_des1_rad")).abs()
    seconds = frame.group_by(pl.col("t_s").floor().alias("from_s"), maintain_order=True)
    print(seconds.agg(error1_rad.max().alias("error1_rad"), pl.col(ages).mean()))

# %% Compare two sites: join each record with the peer's latest record before it
if pl is not None:
    peer = site.peers[0]
    peer_frame = log.frame(peer).select("t_s", peer_q1_rad="q1_rad")
    both = frame.select("t_s", "q1_rad").join_asof(peer_frame, on="t_s")
    difference_rad = (both["q1_rad"] - both["peer_q1_rad"]).abs().mean()
    print(f"{slave} and {peer}: joint 1 differed by {difference_rad:.4f} rad on average")

# %% List the events
if pl is not None:
    print(log.frame("events").select("t_s", "member", "kind", "text"))
