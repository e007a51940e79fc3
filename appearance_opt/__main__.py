"""``python -m appearance_opt``."""

from appearance_opt.cli import main

if __name__ == "__main__":
    main()
