"""How far is every gradient from the truth, and what does it cost? See ``__main__``."""
