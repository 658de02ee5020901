"""The rows of ``system_load.csv``, and what they come to."""

from __future__ import annotations

import tracemalloc

from neuros.recording.system_load import GroupLoad, LoadTable, MachineLoad, load_table


def machine(cores: tuple[float, ...] = (10.0, 30.0), sent_bytes: int = 0) -> MachineLoad:
    return MachineLoad(cores, 2_000_000, 40.0, sent_bytes, 2 * sent_bytes)


def table(*groups: str) -> LoadTable:
    """Begun at 5 s, with 1 s of processor time behind each group."""
    begun = LoadTable(groups, 2)
    begun.begin(5.0, machine(), {name: GroupLoad(1.0, 0, 0) for name in groups})
    return begun


def test_every_column_names_what_it_holds_and_its_unit() -> None:
    assert table("snn").header == [
        "time_s",
        "unix_time_s",
        "core0_percent",
        "core1_percent",
        "memory_used_bytes",
        "memory_percent",
        "network_sent_bytes",
        "network_received_bytes",
        "snn.cpu_percent",
        "snn.memory_bytes",
        "snn.threads",
    ]


def test_a_row_holds_what_was_spent_since_the_one_before() -> None:
    load = table("snn")
    cells = load.row(7.0, machine(sent_bytes=500), {"snn": GroupLoad(1.5, 1000, 4)})
    assert cells == ["10.0", "30.0", "2000000", "40.0", "500", "1000", "25.0", "1000", "4"]
    cells = load.row(8.0, machine(sent_bytes=600), {"snn": GroupLoad(2.5, 1000, 4)})
    assert cells[4:7] == ["100", "200", "100.0"]


def test_a_node_without_a_process_has_empty_cells_and_does_not_lower_its_own_mean() -> None:
    load = table("snn")
    load.row(6.0, machine(), {"snn": GroupLoad(1.5, 1000, 4)})
    assert load.row(7.0, machine(), {})[-3:] == ["", "", ""]
    assert load.summary()["processes"]["snn"]["cpu_percent_mean"] == 50.0


def test_time_of_a_process_that_is_gone_does_not_make_a_node_spend_less_than_nothing() -> None:
    load = table("snn")
    assert load.row(6.0, machine(), {"snn": GroupLoad(0.2, 1000, 4)})[-3] == "0.0"


def test_a_core_that_was_switched_off_leaves_its_column_empty() -> None:
    assert table().row(6.0, machine(cores=(10.0,)), {})[:2] == ["10.0", ""]


def test_the_summary_has_means_and_maxima() -> None:
    load = table("snn", "robot")
    load.row(6.0, machine((0.0, 50.0)), {"snn": GroupLoad(1.1, 1_000_000, 3)})
    load.row(7.0, machine((50.0, 50.0)), {"snn": GroupLoad(1.4, 3_000_000, 5)})
    summary = load.summary()
    assert summary["samples"] == 2
    assert summary["machine"]["cpu_percent_mean"] == 75.0
    assert summary["machine"]["cpu_percent_max"] == 100.0
    assert round(summary["processes"]["snn"]["cpu_percent_mean"]) == 20
    assert summary["processes"]["snn"]["memory_bytes_max"] == 3_000_000
    assert summary["processes"]["snn"]["threads_max"] == 5
    assert summary["processes"]["robot"] is None


def test_a_long_run_takes_no_more_memory_than_a_short_one() -> None:
    load = table("snn")
    tracemalloc.start()
    try:
        for second in range(2000):
            load.row(6.0 + second, machine(), {"snn": GroupLoad(1.1 + second, 10**6 + second, 3)})
        grown_bytes, _ = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    assert load.summary()["samples"] == 2000
    assert grown_bytes < 20_000


def test_the_text_shows_the_summary_and_where_the_rest_is() -> None:
    load = table("snn", "robot")
    load.row(6.0, machine((0.0, 50.0)), {"snn": GroupLoad(1.1, 7_000_000, 3)})
    text = load_table(load.summary())
    assert "snn" in text
    assert "7 MB" in text
    assert "robot" not in text, "it was never seen"
    assert "100% is one core of 2; 1 sample: system_load.csv" in text


def test_a_run_without_a_sample_says_so() -> None:
    assert "shorter than the first sample" in load_table(table("snn").summary())
