"""Analysis of runs: `run.json`, differences, budgets, reports and comparisons."""
