"""Losses, regularizer, optimiser, schedules, and the loop."""
