"""Damaged and hostile files, made at random: each must be read, or refused in one line.

``seeds``: one small file of each format; ``mutators``: what is done to them; ``worker``: reads the
results in a process that may die; ``campaign``: counts what became of them.
"""
