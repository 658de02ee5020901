"""The generic node: loads a plugin, runs its hooks on the engine, and reports to the supervisor."""
