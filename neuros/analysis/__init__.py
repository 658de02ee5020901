"""Analysis of runs: `run.json`, differences, budgets, and the review of a past run."""
