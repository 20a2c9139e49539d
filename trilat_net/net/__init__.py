"""The world outside a site: clocks, messages, the bus, and how members of a session find together."""
