"""Writes, reads, checks and recovers logs, the files that hold the messages of a run.

A log is an MCAP file, so general viewers for robot data can open it too. For example,
`open_log("run.mcap")["s"].q` is an array of the joint angles of the arm "s" over time.

Invariant:
    - No other package imports `mcap`.
"""

from typing import TYPE_CHECKING

from ..hooks import import_on_use, register_hooks

__all__ = [
    # Reading a log
    "Column",
    "IndexedRecords",
    "Ints",
    "Log",
    "LogFile",
    "McapReader",
    "Progress",
    "SiteLog",
    "UnwrittenLog",
    "Table",
    "compute_task_errors",
    "open_log",
    "LogContents",
    # Writing a log
    "FULL_RATE_HZ",
    "VIZ_HZ",
    "LogParts",
    "LogStorage",
    "LogWriter",
    "MakeViews",
    "McapWriter",
    "PutMessage",
    "ReceiveMessage",
    "SessionScenario",
    "Sink",
    "collect_provenance",
    "compute_virtual_boot",
    # Names in a log
    "ACTIVE_SUFFIX",
    "CHANNEL_TYPES",
    "EXECUTED_SITES_KEY",
    "MAX_TIME_NS",
    "RERUN_DRIVER",
    "SCENARIO",
    "SESSION",
    "SITE_CHANNELS",
    "VIZ_ROOT",
    "ChannelFilter",
    # Checking, signing and recovering
    "LAST",
    "MIN_COVERAGE",
    "Account",
    "CheckReport",
    "Coverage",
    "Finding",
    "Integrity",
    "LogCheckResult",
    "Recovery",
    "RecoverySurvey",
    "StartGap",
    "check_file",
    "create_signing_keys",
    "describe_unknown_ends",
    "count_skipped_ticks",
    "recover",
    "sign_log",
    # Orientations
    "MATRIX_ENTRIES",
    "QuaternionSigns",
    "RotationVectors",
    "expand_poses",
]

if TYPE_CHECKING:
    from .accounting import (
        LAST,
        MIN_COVERAGE,
        Account,
        Coverage,
        StartGap,
        count_skipped_ticks,
        describe_unknown_ends,
    )
    from .data_tables import Column, Table
    from .findings import CheckReport, Finding
    from .log_contents import LogContents
    from .log_file import LogFile
    from .log_layout import (
        ACTIVE_SUFFIX,
        CHANNEL_TYPES,
        EXECUTED_SITES_KEY,
        MAX_TIME_NS,
        RERUN_DRIVER,
        SCENARIO,
        SESSION,
        SITE_CHANNELS,
        VIZ_ROOT,
        ChannelFilter,
    )
    from .log_reader import Log, open_log
    from .log_signature import create_signing_keys, sign_log
    from .log_writer import (
        LogParts,
        LogStorage,
        LogWriter,
        MakeViews,
        PutMessage,
        ReceiveMessage,
    )
    from .mcap_reader import McapReader, Progress
    from .mcap_writer import McapWriter, Sink
    from .message_identity import compute_virtual_boot
    from .orientations import MATRIX_ENTRIES, QuaternionSigns, RotationVectors, expand_poses
    from .packed.indexed_records import IndexedRecords
    from .provenance import collect_provenance
    from .record_columns import Ints
    from .recovery import Recovery, recover
    from .recovery_survey import RecoverySurvey
    from .running_digest import Integrity
    from .session_check import LogCheckResult, check_file
    from .session_scenario import SessionScenario
    from .site_log import SiteLog, compute_task_errors
    from .unwritten_log import UnwrittenLog
    from .view_rates import FULL_RATE_HZ, VIZ_HZ
else:
    __getattr__ = import_on_use(
        __name__,
        {
            "accounting": (
                "Account Coverage LAST MIN_COVERAGE StartGap count_skipped_ticks "
                "describe_unknown_ends"
            ),
            "data_tables": "Column Table",
            "findings": "CheckReport Finding",
            "log_contents": "LogContents",
            "log_file": "LogFile",
            "log_layout": (
                "ACTIVE_SUFFIX CHANNEL_TYPES ChannelFilter EXECUTED_SITES_KEY MAX_TIME_NS "
                "RERUN_DRIVER SCENARIO SESSION SITE_CHANNELS VIZ_ROOT"
            ),
            "log_reader": "Log open_log",
            "log_signature": "create_signing_keys sign_log",
            "log_writer": "LogParts LogStorage LogWriter MakeViews PutMessage ReceiveMessage",
            "mcap_reader": "McapReader Progress",
            "mcap_writer": "McapWriter Sink",
            "message_identity": "compute_virtual_boot",
            "orientations": "MATRIX_ENTRIES QuaternionSigns RotationVectors expand_poses",
            "packed.indexed_records": "IndexedRecords",
            "provenance": "collect_provenance",
            "record_columns": "Ints",
            "recovery": "Recovery recover",
            "recovery_survey": "RecoverySurvey",
            "running_digest": "Integrity",
            "session_check": "LogCheckResult check_file",
            "session_scenario": "SessionScenario",
            "site_log": "SiteLog compute_task_errors",
            "unwritten_log": "UnwrittenLog",
            "view_rates": "FULL_RATE_HZ VIZ_HZ",
        },
    )

register_hooks(
    __name__,
    {
        "offer the views of a log": "ros2.viz_channels:offer_views",
        "read the delays of a link": "log_reader:read_link_delays",
    },
)
