"""Places of nodes and connections in a picture."""

from __future__ import annotations

import pytest
from neuros_analysis.graph_picture import Layout, lay_out
from run_folders import wires


def places_are_apart(layout: Layout) -> bool:
    places = [*layout.nodes.values(), *layout.boxes.values()]
    return len({*places}) == len(places)


def test_a_chain_goes_from_left_to_right() -> None:
    layout = lay_out(["c", "b", "a"], wires(a_b=0, b_c=0), "a")
    assert [layout.nodes[node].column for node in "abc"] == [0, 2, 4]
    assert [place.column for place in layout.boxes.values()] == [1, 3]
    assert places_are_apart(layout)


def test_a_loop_comes_back_through_a_box_of_its_own() -> None:
    layout = lay_out(["a", "b"], wires(a_b=0, b_a=0), "a")
    assert [layout.nodes[node].column for node in "ab"] == [0, 2]
    back = layout.routes["b.out -> a.in_b"]
    assert [place.column for place in back] == [2, 1, 0]
    assert places_are_apart(layout)


def test_what_passes_a_column_has_a_place_there() -> None:
    layout = lay_out(["a", "b", "c"], wires(a_b=0, b_c=0, a_c=None), "a")
    route = layout.routes["a.out -> c.in_a"]
    assert [place.column for place in route] == [0, 1, 2, 3, 4]
    assert route[2] != layout.nodes["b"]
    assert route[3] != layout.boxes["b.out -> c.in_b"]


def test_a_node_that_sends_to_itself_has_a_box_beside_it() -> None:
    layout = lay_out(["a"], wires(a_a=0), "a")
    assert [place.column for place in layout.routes["a.out -> a.in_a"]] == [0, 1, 0]


@pytest.mark.parametrize("count", [1, 64])
def test_many_nodes_are_apart(count: int) -> None:
    names = [f"n{i}" for i in range(count)]
    pairs = {f"n{i}_n{(i * 7 + 1) % count}": 0 for i in range(count)}
    assert places_are_apart(lay_out(names, wires(**pairs), "n0"))
