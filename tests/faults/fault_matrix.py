"""The fault matrix: every fault, what is required, and what shows it, in virtual time and for real.

`python -m tests.faults --write` runs all of it and writes docs/data/fault-matrix.csv.
"""

from typing import NamedTuple

LIVE = "tests/live/"
SITES = "tests/sites/"
LOG = "tests/log/"
NET = "tests/net/"


class Row(NamedTuple):
    """One fault.

    Attributes:
        mark: its number.
        fault: in words.
        required: what must hold.
        kinds: the kinds of `fault_schedule` that make it in seeds.
        virtual: tests in one process, as pytest names them.
        real: tests with real processes, sessions, disks or cables.
        gap: what is not tried; "" for nothing.
    """

    mark: str
    fault: str
    required: str
    kinds: tuple[str, ...] = ()
    virtual: tuple[str, ...] = ()
    real: tuple[str, ...] = ()
    gap: str = ""


_GUARD = "tests/core/test_safeguards.py::test_"
_ARM = SITES + "test_external_arm.py::test_"
_LEAVING = SITES + "test_leaving.py::test_"
_KEYS = NET + "test_member_keys.py::test_"
_DISK = LOG + "test_log_file.py::test_"

ROWS = (
    Row(
        "F1",
        "a site is killed and started again",
        "held within 21 ticks; followed again within 2 s of its first tick",
        ("kill",),
        (_LEAVING + "site_that_is_killed_comes_back_and_log_is_whole",),
        ("a_killed_site_started_again_follows_within_two_seconds",),
    ),
    Row(
        "F2",
        "a site is frozen and goes on",
        "held within 21 ticks; at an arm outside no missed tick is made up for",
        ("freeze",),
        (_GUARD + "missed_ticks_are_held_or_a_fault_never_repeated",),
        ("a_frozen_site_on_slow_links_loses_no_bit",),
    ),
    Row(
        "F3",
        "the recorder is killed, stopped or frozen",
        "no site notices; nothing that was flushed is lost; another one has all",
        (),
        (_LEAVING + "successive_recorders_agree_on_ticks_not_made",),
        (
            "recorder_that_is_killed_leaves_all_that_it_had_flushed",
            "a_killed_recorders_successor_has_all_records",
            "a_frozen_recorder_has_every_record_in_the_end",
        ),
    ),
    Row(
        "F4",
        "the router is killed and started again",
        "all hold; all follow again without a restart",
        ("cut all",),
        (),
        ("router_that_is_killed_and_started_again_heals_session",),
    ),
    Row(
        "F5",
        "a link is cut and mended",
        "both sides hold within 21 ticks; no sample older than one in use is used",
        ("cut",),
        (),
        ("way_that_is_cut_heals_and_loops_never_stop",),
    ),
    Row(
        "F6",
        "a link is cut in one direction",
        "who hears nothing holds within 21 ticks; both say so",
        ("cut one way",),
        (_LEAVING + "a_site_says_that_a_peer_does_not_hear_it",),
        ("a_one_way_cut_is_held_at_both_ends",),
    ),
    Row(
        "F7",
        "a delay rises for a time",
        "held when no sample comes into use for 20 ms",
        ("delay",),
        real=("sites_hold_while_a_delay_is_too_long_then_follow",),
    ),
    Row(
        "F8",
        "jitter",
        "the same records while it stays within the play-out",
        ("jitter",),
        (SITES + "test_loop.py::test_a_stall_within_the_delay_changes_no_bit",),
        ("jitter_within_the_delay_of_the_links_changes_no_record",),
    ),
    Row(
        "F9",
        "loss, single and in bursts",
        "no change below 20 samples in a row, else held",
        ("loss",),
        gap="TCP loses nothing: a delay there (F5)",
    ),
    Row(
        "F10",
        "duplicates",
        "counted, nothing else",
        ("duplicate",),
        gap="TCP doubles nothing",
    ),
    Row(
        "F11",
        "samples out of order",
        "used in the order of their ticks",
        ("jitter",),
        gap="TCP keeps the order",
    ),
    Row(
        "F12",
        "a wall clock steps by up to an hour",
        "no bit changes",
        ("wall clock",),
        (SITES + "test_clocks.py::test_a_stepping_wall_clock_changes_only_labels",),
        gap="a real clock that steps",
    ),
    Row(
        "F13",
        "clocks drift",
        "no bit changes; offsets are found",
        (),
        (SITES + "test_clocks.py::test_clocks_that_differ_and_drift_change_no_bit",),
        ("delays_are_inside_their_bound_and_clocks_are_found",),
    ),
    Row(
        "F14",
        "a loop gets too little time",
        "simulated arms make up for it; at an arm outside held beyond 20 ticks, a fault beyond 200",
        ("freeze",),
        (
            SITES + "test_loop.py::test_missed_ticks_run_back_to_back",
            SITES + "test_loop.py::test_slow_loops_skip_missed_ticks",
        ),
        gap="load on the processors",
    ),
    Row(
        "F15",
        "a pause of the interpreter",
        "as F14",
        ("freeze",),
        (),
        (),
        "a storm of allocations",
    ),
    Row(
        "F16",
        "the disk is full",
        "the log ends in order, the sites go on",
        ("full disk",),
        (_DISK + "wherever_a_disk_fills_the_log_ends_in_order",),
        ("a_full_disk_ends_recording_and_no_site_loses_samples",),
    ),
    Row(
        "F17",
        "the disk is slow",
        "memory is bounded; what is dropped is counted",
        (),
        (_DISK + "a_disk_that_takes_little_at_a_time_takes_all",),
        ("a_frozen_recorder_has_every_record_in_the_end",),
    ),
    Row(
        "F18",
        "payloads are corrupted",
        "on its way a flipped bit ends the connection, which is made again; what a member sends wrong is "
        "dropped and counted, or shows in the log",
        ("corrupt", "nonsense"),
        (SITES + "test_loop.py::test_strangers_and_their_garbage_change_no_bit",),
        (_KEYS + "a_flipped_bit_ends_the_connection_which_is_made_again",),
    ),
    Row(
        "F19",
        "payloads that are too long, cut off, empty or random",
        "refused before they are read",
        ("stranger",),
        (),
        (NET + "test_zenoh_bus.py::test_messages_without_member_are_refused",),
    ),
    Row(
        "F20",
        "another version of the program",
        "never meets; both versions are named",
        (),
        (SITES + "test_change_server.py::test_clients_of_other_versions_are_refused",),
        gap="live, with a real other version",
    ),
    Row(
        "F21",
        "numbers that are not finite, or huge",
        "dropped; at the site itself a fault in the same tick; nothing of it is published",
        ("nonsense",),
        (
            _ARM + "an_encoder_glitch_is_no_measurement_repeated_it_is_silence",
            _GUARD + "a_passed_limit_is_a_fault_until_it_is_reset",
        ),
        gap="live; the decoder is the same",
    ),
    Row(
        "F22",
        "old messages once more",
        "counted, nothing else",
        ("replay",),
        gap="live; with keys no stranger connects (F29)",
    ),
    Row(
        "F23",
        "two processes in the place of one site",
        "the second is refused while the first is there",
        ("stranger",),
        (_LEAVING + "another_start_waits_while_the_one_before_is_there",),
        gap="live",
    ),
    Row(
        "F24",
        "a listener is slow or frozen",
        "no loop waits for it",
        (),
        (),
        ("a_frozen_recorder_has_every_record_in_the_end",),
    ),
    Row(
        "F25",
        "mistakes in scenarios, options and keys",
        "refused before anything is opened, with the place and what would be right",
        (),
        ("tests/cli/test_bad_input.py",),
    ),
    Row(
        "F26",
        "SIGINT, SIGTERM, SIGHUP",
        "ends in order, says whose end it was; the others hold",
        ("end",),
        (_LEAVING + "whose_end_it_was_is_told_to_the_others",),
        (
            "ctrl_c_during_run_ends_all_and_finishes_file",
            "a_site_that_hangs_up_is_named_by_the_others",
        ),
    ),
    Row(
        "F27",
        "memory runs out",
        "every queue is bounded",
        (),
        (LOG + "test_hostile.py",),
        (),
        "a process starved of memory",
    ),
    Row(
        "F28",
        "a process lives, its connection is dead",
        "it is made again by itself",
        (),
        (),
        (NET + "test_zenoh_bus.py::test_members_meet_again_through_restarted_routers",),
        "UDP, on which it was seen: it is refused",
    ),
    Row(
        "F29",
        "keys expire, or are of another authority",
        "no key, no connection; an open link stays",
        (),
        (),
        (_KEYS + "strangers_cannot_connect", _KEYS + "open_link_outlives_its_certificate"),
    ),
    Row(
        "F30",
        "starts in any order, or of some sites alone",
        "one epoch for all; who waits says for whom",
        (),
        (_LEAVING + "site_may_come_late_where_first_one_begins_without_it",),
        (
            "three_machines_in_any_order_of_starts",
            "waiting_in_vain_names_the_missing_and_leaves_no_file",
        ),
    ),
    Row("F31", "several at once", "the invariants", ("several",), gap="live"),
)
"""Real tests without a folder are in tests/live."""
