"""Metrics on held-out views, pictures and reports."""
