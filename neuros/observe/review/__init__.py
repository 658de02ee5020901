"""Runs that are over, looked at: what held them up, figures, pages, comparisons."""
