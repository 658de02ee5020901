"""How examples are drawn where tests/mutation.py counts which faults the tests find."""

from hypothesis import Phase, settings

# The same examples each time, and none made smaller when one fails.
settings.register_profile(
    "mutation", derandomize=True, database=None, phases=[Phase.explicit, Phase.generate]
)
