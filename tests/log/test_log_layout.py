"""Which channels a log takes, by key expressions that mean what they mean to Zenoh."""

import io

import pytest
import zenoh
from hypothesis import assume, given
from hypothesis import strategies as st
from mcap.reader import make_reader

from trilat_net.errors import UsageError
from trilat_net.log.log_layout import RECORDER_CHANNELS, SITE_CHANNELS, ChannelFilter
from trilat_net.log.log_writer import LogWriter
from trilat_net.log.provenance import collect_provenance
from trilat_net.net.bus import matches_key
from trilat_net.scenario import load_scenario

CHUNKS = st.text("abm1", min_size=1, max_size=3)
KEYS = st.lists(CHUNKS, min_size=1, max_size=4).map("/".join)
PATTERNS = st.lists(
    st.one_of(
        CHUNKS,
        st.just("*"),
        st.just("**"),
        st.lists(st.one_of(CHUNKS, st.just("$*")), min_size=1, max_size=4).map("".join),
    ),
    min_size=1,
    max_size=4,
).map("/".join)


@given(expression=PATTERNS, key=KEYS)
def test_expressions_match_like_those_of_zenoh(expression: str, key: str) -> None:
    try:
        known = zenoh.KeyExpr(expression)
    except zenoh.ZError:  # another spelling of one that is known
        assume(False)
    assert matches_key(expression, key) == known.includes(zenoh.KeyExpr(key))


@pytest.mark.parametrize("text", ["", "a//b", "a*", "***", "a/$", "a?", "#", "*m1/**"])
def test_an_invalid_expression_is_refused(text: str) -> None:
    with pytest.raises(UsageError, match="must be a key expression such as"):
        ChannelFilter.parse([text], [])
    with pytest.raises(UsageError, match="exclude must be"):
        ChannelFilter.parse([], [text])


def test_a_leading_slash_is_fine() -> None:
    assert ChannelFilter.parse(["/trilat/**"], ["/**/m$*/link"]) == ChannelFilter(
        ("trilat/**",), ("**/m$*/link",)
    )


def test_absent_channels_are_declared_in_the_file() -> None:
    stream = io.BytesIO()
    chosen = ChannelFilter(("trilat/*/m$*/**",), ("**/link",))
    writer = LogWriter(
        stream, load_scenario("paper"), "lab", "live", 0, collect_provenance(), choice=chosen
    )
    kept = [
        f"trilat/lab/{site}/{channel}"
        for site in ("m1", "m2")
        for channel in ("state", "event")
    ]
    every = [
        f"trilat/lab/{site}/{channel}"
        for site in ("m1", "m2", "s")
        for channel in SITE_CHANNELS
    ]
    every += [f"trilat/lab/recorder/{channel}" for channel in RECORDER_CHANNELS]
    for key in every:
        writer.add(key, b"\x80", 0, 0, 0)
    writer.finish({f"/{key}": "received 1" for key in every} | {"dropped: stranger": "3"})
    reader = make_reader(io.BytesIO(stream.getvalue()))
    metadata = {entry.name: entry.metadata for entry in reader.iter_metadata()}
    assert metadata["trilat.session"]["include"] == "trilat/*/m$*/**"
    assert metadata["trilat.session"]["exclude"] == "**/link"
    assert set(metadata["trilat.accounts"]) == {f"/{key}" for key in kept} | {
        "dropped: stranger"
    }
    topics = {channel.topic for _, channel, _ in reader.iter_messages()}
    assert topics == {f"/{key}" for key in kept}
    summary = reader.get_summary()
    assert summary is not None
    assert {channel.topic for channel in summary.channels.values()} == topics
