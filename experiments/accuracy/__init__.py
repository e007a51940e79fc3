"""How accurate is every stage on its own? See ``__main__``."""
