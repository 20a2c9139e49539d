"""The MCAP log: write, read, check and recover it. The only importer of `mcap`."""

from ..hooks import register_hooks

register_hooks(
    __name__,
    {
        "offer the views of a log": "ros2.viz_channels:offer_views",
        "read the delays of a link": "log_reader:read_link_delays",
    },
)
