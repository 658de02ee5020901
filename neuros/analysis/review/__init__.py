"""Review of runs: findings, figures, pages, comparisons."""
