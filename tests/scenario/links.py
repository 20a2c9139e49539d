"""Strategies for links: every delay model that the kernel computes, with every optional key."""

from typing import Any

from hypothesis import strategies as st

from trilat_net.scenario.link_presets import PRESETS

ms = st.floats(0.01, 900.0)
share = st.floats(0.0, 1.0)


@st.composite
def _draw_losses(draw: st.DrawFn) -> dict[str, Any]:
    """Draws losses that a chain of two states can have."""
    if draw(st.booleans()):
        return draw(st.fixed_dictionaries({}, optional={"loss": share}))
    bad = draw(st.floats(0.3, 1.0))
    loss = draw(st.floats(0.0, 0.3)) * bad
    longest = 50.0 if bad == 1.0 else min(50.0, 0.99 / (1.0 - bad))
    # what is above this keeps the probability to enter a burst below 1
    burst = draw(st.floats(1.0, max(1.0, longest))) if loss < 0.4 * bad else longest
    return {"loss": loss, "loss_burst": burst, "loss_bad": bad}


@st.composite
def _draw_other_keys(draw: st.DrawFn) -> dict[str, Any]:
    others = st.fixed_dictionaries(
        {},
        optional={
            "duplicate": share,
            "order": st.sampled_from(["newest", "in_order"]),
            "playout_ms": st.floats(0, 500) | st.integers(0, 500),
            "outages_s": st.lists(
                st.tuples(st.floats(0, 10), st.floats(10.5, 99)).map(list), max_size=3
            ),
        },
    )
    return {**draw(_draw_losses()), **draw(others)}


@st.composite
def _draw_spread(draw: st.DrawFn) -> dict[str, Any]:
    mean = draw(st.floats(0.5, 900.0))
    return {"delay_ms": mean, "deviation_ms": mean * draw(st.floats(0.01, 2.0))}


@st.composite
def _draw_bounded(draw: st.DrawFn, key: str) -> dict[str, Any]:
    mean = draw(ms)
    return {"delay_ms": mean, key: mean * draw(share)}


def _draw_traces() -> st.SearchStrategy[str]:
    gaps = st.lists(st.integers(1, 10**6), max_size=5)
    delays = st.integers(0, 10**7).map(str) | st.just("lost")
    return gaps.flatmap(
        lambda g: st.lists(delays, min_size=len(g) + 1, max_size=len(g) + 1).map(
            lambda d: ", ".join(f"{sum(g[:n])} {us}" for n, us in enumerate(d))
        )
    )


_correlation = st.floats(0, 0.99)
_models: dict[str, st.SearchStrategy[dict[str, Any]]] = {
    "none": st.just({}),
    "constant": st.fixed_dictionaries({"delay_ms": ms | st.integers(0, 900)}),
    "uniform": _draw_bounded("half_width_ms"),
    "normal": _draw_spread(),
    "gamma": _draw_spread(),
    "lognormal": _draw_spread(),
    "hyperexponential": st.fixed_dictionaries(
        {"floor_ms": ms, "fast_ms": ms, "slow_ms": ms, "slow_share": share}
    ),
    "ar1": st.tuples(_draw_spread(), _correlation).map(
        lambda pair: {**pair[0], "correlation": pair[1]}
    ),
    "sine": st.tuples(
        _draw_bounded("amplitude_ms"), st.floats(0.01, 100), st.floats(-7, 7)
    ).map(lambda parts: {**parts[0], "period_s": parts[1], "phase_rad": parts[2]}),
    "trace": st.fixed_dictionaries(
        {"trace": _draw_traces()}, optional={"at_end": st.sampled_from(["hold", "loop"])}
    ),
    "measured": st.just({}),
}


@st.composite
def draw_link(draw: st.DrawFn, without: tuple[str, ...] = ()) -> dict[str, Any]:
    besides = draw(_draw_other_keys())
    if draw(st.integers(0, 5)) == 0:
        preset = draw(st.sampled_from(sorted(PRESETS)))
        if "loss" not in PRESETS[preset]:
            return {"preset": preset, **besides}
        return {"preset": preset}
    model = draw(st.sampled_from([name for name in _models if name not in without]))
    return {"model": model, **draw(_models[model]), **besides}
