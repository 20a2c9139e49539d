"""Network communication between the processes of a running session.

Several processes of a session each control one robot arm; others record the messages or let
people take part. For example, the process of a slave arm receives the positions of two master
arms, typically a thousand times per second. The package contains:

- the network connection: `bus`, `zenoh_bus`, `connection`, `default_endpoints`,
  `member_keys`;
- the messages and their encoding: `messages`, `requests`, `wire`, `topics`;
- clocks, and the measurement of offsets between them: `clock`, `pinging`, `offset`, `timing`;
- the synchronised start of all processes: `membership`, `session`, `session_members`;
- access for programs outside the session: `arm_client`, `known_sites`, `ros2`.
"""

from typing import TYPE_CHECKING

from ..hooks import import_on_use

__all__ = [
    # Connections
    "BRIDGE",
    "ENCRYPTED",
    "ENDS_SOON",
    "OPERATOR",
    "ROLES",
    "ROUTER",
    "SITE_ROLE",
    "Bus",
    "Connection",
    "DefaultEndpoints",
    "Endpoint",
    "Inbox",
    "Query",
    "QueryInbox",
    "StampedInbox",
    "check_hosts",
    "make_site_known",
    "matches_key",
    "open_zenoh",
    "share_threads",
    "stop_at_once",
    # Keys of members
    "AUTHORITY",
    "CERTIFICATE",
    "HERE",
    "MEMBERS",
    "PRIVATE_KEY",
    "add_keys",
    "create_keys",
    "MemberKeys",
    "read_member_keys",
    "renew_keys",
    # Messages and their encoding
    "BACKFILL_BYTES",
    "BACKFILL_MESSAGES",
    "HALTED_MODES",
    "MAX_BYTES",
    "MODES",
    "MODE_WORDS",
    "READABLE",
    "RECORDER",
    "RESTING_MODES",
    "SENT_TIME_SINCE",
    "STATE_VECTORS",
    "STATS_PER_SECOND",
    "TASK_VECTORS",
    "VERSION",
    "ArmEnable",
    "ArmMeasurement",
    "Backfill",
    "BackfillRequest",
    "ChangeReply",
    "ChangeRequest",
    "Event",
    "HandMessage",
    "HandSender",
    "HandViewMessage",
    "Info",
    "LinkStats",
    "ModeMeaning",
    "OrderName",
    "PeerSample",
    "PeerSeen",
    "RecorderStats",
    "Stamp",
    "State",
    "TickNumber",
    "count_messages",
    "count_under_way",
    "decode",
    "encode",
    "encode_sample",
    "encode_state",
    "join_states",
    "json_schema",
    "make_decoder",
    "make_sample_reader",
    "messages",
    "number_message",
    "read_messages",
    "skipped_numbers",
    "split_states",
    "topics",
    # Clocks and timing
    "PING_PACE_NS",
    "Clock",
    "LinkTimingMonitor",
    "LoopStats",
    "OffsetEstimator",
    "OffsetLimit",
    "PeerClock",
    "Pinger",
    "SiteTiming",
    "SystemClock",
    "SiteStandIn",
    "answer_backfill",
    "find_turn_ns",
    # Joining and finding a session
    "REPLY_TIMEOUT_S",
    "Epoch",
    "EventPublisher",
    "LateSites",
    "SessionJoin",
    "describe_member",
    "SessionMembers",
    "new_boot",
    # Programs outside a session
    "ArmClient",
    "Hand",
    "SiteClient",
    "SwitchClient",
]

if TYPE_CHECKING:
    from . import messages, topics
    from .arm_client import ArmClient, Hand, HandSender, SiteClient, SwitchClient
    from .bus import Bus, Inbox, Query, QueryInbox, StampedInbox, matches_key
    from .clock import Clock, SystemClock
    from .connection import ENCRYPTED, ENDS_SOON, Connection
    from .default_endpoints import DefaultEndpoints
    from .host_names import check_hosts
    from .known_sites import make_site_known, stop_at_once
    from .member_keys import (
        AUTHORITY,
        CERTIFICATE,
        HERE,
        MEMBERS,
        PRIVATE_KEY,
        MemberKeys,
        add_keys,
        create_keys,
        read_member_keys,
        renew_keys,
    )
    from .membership import Epoch, EventPublisher, LateSites, describe_member, new_boot
    from .messages import (
        HALTED_MODES,
        MODE_WORDS,
        MODES,
        READABLE,
        RESTING_MODES,
        SENT_TIME_SINCE,
        STATE_VECTORS,
        TASK_VECTORS,
        VERSION,
        Event,
        Info,
        LinkStats,
        ModeMeaning,
        PeerSample,
        RecorderStats,
        Stamp,
        State,
        TickNumber,
        json_schema,
    )
    from .offset import OffsetEstimator, OffsetLimit
    from .pinging import PING_PACE_NS, Pinger, answer_backfill
    from .requests import (
        BACKFILL_BYTES,
        BACKFILL_MESSAGES,
        ArmEnable,
        ArmMeasurement,
        Backfill,
        BackfillRequest,
        ChangeReply,
        ChangeRequest,
        HandMessage,
        HandViewMessage,
        OrderName,
        PeerSeen,
    )
    from .session import SessionJoin
    from .session_members import REPLY_TIMEOUT_S, SessionMembers
    from .site_stand_in import SiteStandIn
    from .timing import LinkTimingMonitor, LoopStats, PeerClock, SiteTiming, find_turn_ns
    from .topics import (
        RECORDER,
        STATS_PER_SECOND,
        count_messages,
        count_under_way,
        number_message,
        skipped_numbers,
    )
    from .wire import (
        MAX_BYTES,
        decode,
        encode,
        encode_sample,
        encode_state,
        join_states,
        make_decoder,
        make_sample_reader,
        read_messages,
        split_states,
    )
    from .zenoh_bus import open_zenoh, share_threads
    from .zenoh_config import BRIDGE, OPERATOR, ROLES, ROUTER, SITE_ROLE, Endpoint
else:
    __getattr__ = import_on_use(
        __name__,
        {
            "arm_client": "ArmClient Hand HandSender SiteClient SwitchClient",
            "bus": "Bus Inbox Query QueryInbox StampedInbox matches_key",
            "clock": "Clock SystemClock",
            "connection": "Connection ENCRYPTED ENDS_SOON",
            "default_endpoints": "DefaultEndpoints",
            "host_names": "check_hosts",
            "known_sites": "make_site_known stop_at_once",
            "member_keys": (
                "AUTHORITY CERTIFICATE HERE MEMBERS MemberKeys PRIVATE_KEY add_keys "
                "create_keys read_member_keys renew_keys"
            ),
            "membership": "Epoch EventPublisher LateSites describe_member new_boot",
            "messages": (
                "Event HALTED_MODES Info LinkStats MODES MODE_WORDS ModeMeaning PeerSample "
                "READABLE RESTING_MODES RecorderStats SENT_TIME_SINCE STATE_VECTORS Stamp "
                "State TASK_VECTORS TickNumber VERSION json_schema messages"
            ),
            "offset": "OffsetEstimator OffsetLimit",
            "pinging": "PING_PACE_NS Pinger answer_backfill",
            "requests": (
                "ArmEnable ArmMeasurement BACKFILL_BYTES BACKFILL_MESSAGES Backfill "
                "BackfillRequest ChangeReply ChangeRequest HandMessage HandViewMessage "
                "OrderName PeerSeen"
            ),
            "session": "SessionJoin",
            "session_members": "REPLY_TIMEOUT_S SessionMembers",
            "site_stand_in": "SiteStandIn",
            "timing": "LinkTimingMonitor LoopStats PeerClock SiteTiming find_turn_ns",
            "topics": (
                "RECORDER STATS_PER_SECOND count_messages count_under_way number_message "
                "skipped_numbers topics"
            ),
            "wire": (
                "MAX_BYTES decode encode encode_sample encode_state join_states "
                "make_decoder make_sample_reader read_messages split_states"
            ),
            "zenoh_bus": "open_zenoh share_threads",
            "zenoh_config": "BRIDGE Endpoint OPERATOR ROLES ROUTER SITE_ROLE",
        },
    )
