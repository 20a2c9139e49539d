"""The fault matrix: every fault, what is required, and what shows it, in virtual time and for real.

`python -m tests.faults` runs all of it and writes docs/faults.md.
"""

from typing import NamedTuple

LIVE, SITES, LOG, NET = "tests/live/", "tests/sites/", "tests/log/", "tests/net/"


class Row(NamedTuple):
    """One fault.

    Attributes:
        mark: its number.
        fault: in words.
        required: what must hold.
        kinds: the kinds of `fault_schedule` that make it in seeds.
        virtual: tests in one process, as pytest names them.
        real: tests with real processes, sessions, disks or cables.
        gap: what is not tried, and why; "" for nothing.
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
        (_LEAVING + "a_site_that_is_killed_comes_back_and_the_log_is_whole",),
        ("a_killed_site_started_again_follows_within_two_seconds",),
    ),
    Row(
        "F2",
        "a site is frozen and goes on",
        "held within 21 ticks; at an arm outside no missed tick is made up for",
        ("freeze",),
        (_GUARD + "ticks_that_were_not_made_are_held_or_a_fault_and_nothing_is_made_up_for",),
        ("a_site_stopped_for_a_second_on_links_of_two_loses_nothing_and_no_bit",),
    ),
    Row(
        "F3",
        "the recorder is killed, stopped or frozen",
        "no site notices; nothing that was flushed is lost; another one has all",
        (),
        (_LEAVING + "recorders_that_follow_each_other_agree_on_what_was_not_made",),
        (
            "a_recorder_that_is_killed_leaves_all_that_it_had_flushed",
            "a_recorder_that_is_killed_is_followed_by_another_that_has_all_from_the_start",
            "a_recorder_that_stands_still_for_four_seconds_has_every_record_in_the_end",
        ),
    ),
    Row(
        "F4",
        "the router is killed and started again",
        "all hold; all follow again without a restart",
        ("cut all",),
        (),
        ("a_router_that_is_killed_and_started_again_heals_the_session",),
    ),
    Row(
        "F5",
        "a link is cut and mended",
        "both sides hold within 21 ticks; no sample older than one in use is used",
        ("cut",),
        (),
        ("a_way_that_is_cut_heals_and_the_loops_never_stop",),
    ),
    Row(
        "F6",
        "a link is cut in one direction",
        "who hears nothing holds within 21 ticks; both say so",
        ("cut one way",),
        (_LEAVING + "a_site_says_that_a_peer_that_it_hears_does_not_hear_it",),
        ("a_way_that_is_cut_in_one_direction_is_held_at_both_ends",),
    ),
    Row(
        "F7",
        "a delay rises for a time",
        "held when no sample comes into use for 20 ms",
        ("delay",),
        real=("sites_hold_while_a_delay_is_longer_than_the_links_and_then_follow_again",),
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
        gap="Zenoh's TCP and TLS lose nothing: for real it is a delay (F5)",
    ),
    Row(
        "F10",
        "duplicates",
        "counted, nothing else",
        ("duplicate",),
        gap="Zenoh's TCP and TLS double nothing",
    ),
    Row(
        "F11",
        "samples out of order",
        "used in the order of their ticks",
        ("jitter",),
        gap="Zenoh's TCP and TLS keep the order",
    ),
    Row(
        "F12",
        "a wall clock steps by up to an hour",
        "no bit changes",
        ("wall clock",),
        (SITES + "test_clocks.py::test_a_stepping_wall_clock_changes_only_labels",),
        gap="for real it takes a machine whose clock may be set",
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
            SITES + "test_loop.py::test_missed_ticks_run_back_to_back_and_are_counted",
            SITES + "test_loop.py::test_a_loop_that_cannot_catch_up_skips_missed_ticks",
        ),
        gap="for real by a process that is stopped (F2); no load is put on the processors",
    ),
    Row(
        "F15",
        "a pause of the interpreter",
        "as F14",
        ("freeze",),
        (),
        (),
        "the loop runs without its collector; no storm of allocations is tried",
    ),
    Row(
        "F16",
        "the disk is full",
        "the log ends in order, the sites go on",
        ("full disk",),
        (_DISK + "wherever_a_disk_is_full_the_log_ends_in_order_with_all_that_it_was_given",),
        ("a_full_disk_ends_the_recording_in_order_and_no_site_loses_a_sample",),
    ),
    Row(
        "F17",
        "the disk is slow",
        "memory is bounded; what is dropped is counted",
        (),
        (_DISK + "a_disk_that_takes_little_at_a_time_takes_all",),
        ("a_recorder_that_stands_still_for_four_seconds_has_every_record_in_the_end",),
    ),
    Row(
        "F18",
        "payloads are corrupted",
        "on its way a flipped bit ends the connection, which is made again; what a member sends wrong is "
        "dropped and counted, or shows in the log",
        ("corrupt", "nonsense"),
        (
            SITES
            + "test_loop.py::test_strangers_and_their_garbage_change_no_bit_and_are_counted",
        ),
        (_KEYS + "a_bit_that_flips_on_its_way_ends_the_connection_which_is_made_again",),
    ),
    Row(
        "F19",
        "payloads that are too long, cut off, empty or random",
        "refused before they are read",
        ("stranger",),
        (),
        (NET + "test_zenoh_bus.py::test_a_message_of_no_member_is_not_taken_in",),
    ),
    Row(
        "F20",
        "another version of the program",
        "never meets; both versions are named",
        (),
        (
            SITES
            + "test_change_server.py::test_a_client_of_another_version_is_refused_with_both_versions",
        ),
        gap="the other version is a made-up one, in one process",
    ),
    Row(
        "F21",
        "numbers that are not finite, or huge",
        "dropped; at the site itself a fault in the same tick; nothing of it is published",
        ("nonsense",),
        (
            _ARM + "a_glitch_of_an_encoder_is_no_measurement_and_repeated_it_is_silence",
            _GUARD + "a_passed_limit_is_a_fault_until_it_is_reset",
        ),
        gap="in one process: live members decode by the same code",
    ),
    Row(
        "F22",
        "old messages once more",
        "counted, nothing else",
        ("replay",),
        gap="in one process; with keys nobody who could replay connects (F29)",
    ),
    Row(
        "F23",
        "two processes in the place of one site",
        "the second is refused while the first is there",
        ("stranger",),
        (_LEAVING + "another_start_waits_while_the_one_before_is_there",),
        gap="in one process",
    ),
    Row(
        "F24",
        "a listener is slow or frozen",
        "no loop waits for it",
        (),
        (),
        ("a_recorder_that_stands_still_for_four_seconds_has_every_record_in_the_end",),
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
        (_LEAVING + "whose_end_it_was_is_said_to_the_others_who_go_on",),
        (
            "ctrl_c_during_the_run_ends_all_and_finishes_the_file",
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
        "no process is starved of memory; endurance: docs/benchmarks.md",
    ),
    Row(
        "F28",
        "a process lives, its connection is dead",
        "it is made again by itself",
        (),
        (),
        (
            NET
            + "test_zenoh_bus.py::test_members_meet_again_through_a_router_that_was_started_again",
        ),
        "UDP, on which it was seen, is refused",
    ),
    Row(
        "F29",
        "keys expire, or are of another authority",
        "who has none does not connect",
        (),
        (),
        (_KEYS + "strangers_cannot_connect",),
        "an expiry during a session is left to Zenoh (close_link_on_expiration) and not waited for",
    ),
    Row(
        "F30",
        "starts in any order, or of some sites alone",
        "one epoch for all; who waits says for whom",
        (),
        (_LEAVING + "a_site_may_come_late_where_the_first_one_begins_without_it",),
        (
            "three_machines_in_any_order_of_starts",
            "who_waits_in_vain_says_for_whom_and_leaves_no_file",
        ),
    ),
    Row("F31", "several at once", "the invariants", ("several",), gap="in virtual time alone"),
)
"""Real tests without a folder are in tests/live."""
