"""``python -m kreps``: the command line."""

from __future__ import annotations

from kreps.app.cli import main

if __name__ == "__main__":
    main()
