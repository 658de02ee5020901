"""The decorators: they mark and do not wrap, and say at once what is declared wrongly."""

from __future__ import annotations

import functools
import re

import pytest

from neuros.errors import HookError
from neuros.hooks import (
    All,
    HookKind,
    InputSpec,
    Optional,
    OutputSpec,
    hook_specs_of,
    neuros_finalise,
    neuros_function,
    neuros_initialise,
    neuros_tick,
)

KINDS = [
    (HookKind.INITIALISE, neuros_initialise),
    (HookKind.FUNCTION, neuros_function),
    (HookKind.TICK, lambda *a, **k: neuros_tick(1.0, *a, **k)),
]


def hook(node, *inputs):
    return inputs


def spec_of(decorator):
    def function(node):
        """Fresh each time, since a function keeps its marks."""

    (spec,) = hook_specs_of({"function": decorator(function)})
    return spec


def failure(decorate) -> HookError:
    with pytest.raises(HookError) as caught:
        decorate()
    return caught.value


def test_a_decorator_returns_the_function_itself():
    def function(node, ball):
        return ball

    assert neuros_function(inputs="x", outputs="o")(function) is function
    assert function(None, 3) == 3


@pytest.mark.parametrize(("kind", "decorator"), KINDS)
def test_the_kinds_that_take_ports(kind, decorator):
    spec = spec_of(decorator(inputs="x", outputs="o"))
    assert spec.kind is kind
    assert spec.inputs == (InputSpec("x"),)
    assert spec.outputs == (OutputSpec("o"),)


def test_a_finalise_hook_has_neither_inputs_nor_outputs():
    spec = spec_of(neuros_finalise())
    assert (spec.kind, spec.inputs, spec.outputs) == (HookKind.FINALISE, (), ())
    with pytest.raises(TypeError):
        neuros_finalise(inputs="x")  # type: ignore[call-arg]


def test_a_tick_has_a_period_in_seconds():
    assert spec_of(neuros_tick(seconds=0.02, outputs="tick")).period_s == 0.02
    assert spec_of(neuros_tick(2)).period_s == 2.0
    assert spec_of(neuros_function()).period_s is None


@pytest.mark.parametrize(
    ("inputs", "expected"),
    [
        (None, ()),
        ("x", (InputSpec("x"),)),
        (["x", "y"], (InputSpec("x"), InputSpec("y"))),
        (("x", "y"), (InputSpec("x"), InputSpec("y"))),
        (Optional("x"), (InputSpec("x", is_optional=True),)),
        (All("x"), (InputSpec("x", is_all=True),)),
        (Optional(All("x")), (InputSpec("x", is_all=True, is_optional=True),)),
        (["x", Optional("y"), All("z")],
         (InputSpec("x"), InputSpec("y", is_optional=True), InputSpec("z", is_all=True))),
    ],
)  # fmt: skip
def test_inputs_may_be_wrapped_each(inputs, expected):
    assert spec_of(neuros_function(inputs=inputs)).inputs == expected


@pytest.mark.parametrize(
    ("outputs", "expected"),
    [
        ("o", (OutputSpec("o"),)),
        (Optional("o"), (OutputSpec("o", is_optional=True),)),
        (["o", Optional("p")], (OutputSpec("o"), OutputSpec("p", is_optional=True))),
    ],
)
def test_outputs_may_be_optional(outputs, expected):
    assert spec_of(neuros_function(outputs=outputs)).outputs == expected


@pytest.mark.parametrize(
    ("ports", "text"),
    [
        ({"outputs": All("o")}, "output 'o' is wrapped in All, which is for inputs only"),
        ({"outputs": Optional(All("o"))}, "output 'o' is wrapped in All"),
        ({"inputs": ["x", "y", "x"]}, "input 'x' is named twice"),
        ({"inputs": ["x", Optional("x")]}, "input 'x' is named twice"),
        ({"outputs": ["o", "o"]}, "output 'o' is named twice"),
        ({"inputs": 5}, "5 is not a port"),
        ({"inputs": [5]}, "5 is not an input"),
        ({"inputs": All(Optional("x"))}, "is not an input"),  # type: ignore[arg-type]
        ({"inputs": Optional(Optional("x"))}, "is not an input"),  # type: ignore[arg-type]
        ({"outputs": [5]}, "5 is not an output"),
    ],
)
def test_a_wrong_declaration_is_an_error_with_the_hooks_address(ports, text):
    error = failure(lambda: neuros_function(**ports)(hook))
    assert text in str(error)
    assert error.hook == "hook"
    assert re.fullmatch(r".*test_hooks\.py:\d+", error.where)


def test_one_name_may_be_an_input_and_an_output():
    assert spec_of(neuros_function("x", "x")).outputs == (OutputSpec("x"),)


@pytest.mark.parametrize("seconds", [0, -1, float("nan"), float("inf"), "0.02", True, None])
def test_a_period_that_is_no_positive_time_is_an_error(seconds):
    if seconds is None:
        assert spec_of(neuros_tick(1)).period_s == 1
    else:
        assert "seconds=" in str(failure(lambda: neuros_tick(seconds)(hook)))


@pytest.mark.parametrize("decorator", [neuros_initialise, neuros_function, neuros_tick])
def test_a_decorator_without_parentheses_is_an_error_and_not_a_hook_that_never_runs(decorator):
    error = failure(lambda: decorator(hook))
    assert f"@{decorator.__name__} needs parentheses" in str(error)
    assert error.hook == "hook"
    assert "test_hooks.py" in error.where


def test_a_mark_needs_a_function():
    assert "a function below it" in str(failure(lambda: neuros_function("x")("y")))


# ------------------------------------------------------------------ collection


def test_marks_are_collected_in_the_order_of_declaration():
    @neuros_function("x")
    def second(node, x): ...

    @neuros_initialise()
    def first(node): ...

    specs = hook_specs_of({"second": second, "first": first, "other": 3})
    assert [spec.name for spec in specs] == ["second", "first"]


def test_a_function_may_carry_several_marks_uppermost_first():
    @neuros_initialise(outputs="o")
    @neuros_tick(1.0, outputs="o")
    def function(node): ...

    kinds = [spec.kind for spec in hook_specs_of({"function": function})]
    assert kinds == [HookKind.INITIALISE, HookKind.TICK]


def test_a_function_with_two_names_is_one_hook():
    function = neuros_function()(lambda node: None)
    assert len(hook_specs_of({"a": function, "b": function})) == 1


def test_nothing_is_registered_globally():
    neuros_function()(lambda node: None)
    assert hook_specs_of({}) == ()


def test_a_decorator_above_the_mark_is_not_bypassed():
    def doubled(function):
        @functools.wraps(function)
        def wrapper(node):
            return 2 * function(node)

        return wrapper

    @doubled
    @neuros_function(outputs="o")
    def function(node):
        return 21

    (spec,) = hook_specs_of({"function": function})
    assert spec.function(None) == 42
    assert spec.where == f"{__file__}:{function.__wrapped__.__code__.co_firstlineno}"


def test_objects_that_answer_to_any_name_are_not_asked():
    """Lazy modules, for instance, would be loaded."""

    class Lazy:
        def __getattr__(self, name):
            raise AssertionError(f"asked for {name}")

    assert hook_specs_of({"lazy": Lazy()}) == ()


def test_where_is_the_file_and_line_of_the_function():
    spec = spec_of(neuros_function())
    file, line = spec.where.rsplit(":", 1)
    assert file == __file__
    assert int(line) > 1


@pytest.mark.parametrize(
    ("decorator", "sends"),
    [
        (neuros_tick(1.0, inputs="x"), True),
        (neuros_function(outputs="o"), True),
        (neuros_function(Optional("x"), "o"), True),
        (neuros_function("x", "o"), False),
        (neuros_function(["x", Optional("y")], "o"), False),
        (neuros_function(Optional("x")), False),
        (neuros_initialise(outputs="o"), True),
        (neuros_initialise("x", "o"), False),
    ],
)
def test_which_hooks_send_unasked(decorator, sends):
    assert spec_of(decorator).sends_unasked is sends
